"""One frame linearised at its predicted state, and what is said there of attachments and effects together.

With e = H (y - h(x)) + r, x the predicted equilibrium (so that r = 0 but for rounding), N the covariance of the forces
that the model gets wrong and of the noise of what is seen, brought to forces by H,

    e + D ds + G dtheta + Q c + H F a = n,    n ~ N(0, N),  a ~ N(0, I),  c ~ N(0, amplitude^2 I)

with s the bounded stiffnesses, F the smooth fields of the noise, new in every frame, and Q smooth force fields in which
anything might hide, the same in all frames of a grasp. a is eliminated frame by frame, c grasp by grasp. At a noisy
state instead of the predicted one this would be an errors-in-variables problem, and invent effects.
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..effects.mechanical import cosines, flat
from ..effects.sheet_model import FrameContext
from ..filters.evidence import Evidence
from ..filters.force_balance import ForceBalance
from ..filters.frame import Frame
from ..physics.membrane import TriangleMembrane
from .closed_frames import ClosedFrame
from .sheet import PredictedSheet, beyond_tool, look, mean_of_held

WAVES = 4
"""Cosines along each side of the sheet in the smooth force fields."""
N_FIELDS = 3 * WAVES**2
"""Smooth force fields, one for each direction of a cosine."""
TOOL_SD = 2.5e-4
"""How well the mean of the held particles follows the tool from frame to frame [m]."""
GRASP_SD = 5e-4
"""How well within a grasp as a whole: where exactly the jaws closed is not known [m]."""
CARRIED = 1e12
"""Precision of the state of what is held, which follows the grip exactly [1/m^2]."""


class Metric(eqx.Module):
    """How a frame's misfit is weighed: fixed while a fit looks for a better state."""

    balance: ForceBalance
    frame: Frame
    seen: Float[Array, " n"]
    """1 where a particle's position counts, 0 elsewhere."""
    noise: Float[Array, "n 3 c"]
    """N^-1 H F."""
    spread: Float[Array, "c c"]
    """I + F^T H^T N^-1 H F, its lower Cholesky factor."""
    fields: Float[Array, "n 3 q"]
    """Q."""
    white: Float[Array, "n 3 q"]
    """N^-1 Q."""
    among: Float[Array, "q q"]
    """Q^T (N + H F F^T H^T)^-1 Q."""

    def dot(
        self, left: Float[Array, "n 3 l"], right: Float[Array, "n 3 r"], white: Float[Array, "n 3 r"]
    ) -> Float[Array, "l r"]:
        """left^T (N + H F F^T H^T)^-1 right, with N^-1 right."""
        a, b = (jnp.einsum("nic,nik->ck", self.noise, side) for side in (left, right))
        solved = jax.scipy.linalg.cho_solve((self.spread, True), b)
        return jnp.einsum("nil,nir->lr", left, white) - a.T @ solved

    def whitened(self, columns: Float[Array, "n 3 k"]) -> Float[Array, "n 3 k"]:
        """N^-1 of each column."""
        return _each(partial(self.balance.whitened, self.frame), columns)

    def forces(self, off: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """H (y - h(x)) for what is seen off the prediction."""
        return self.balance.apply(self.frame.dr_dx, self.seen[:, None] * off)

    def log_determinant(self) -> Float[Array, ""]:
        """Ln |N + H F F^T H^T| for a given H and precision of what is seen, up to a constant."""
        w, factor = self.frame.weight, self.frame.factor
        diagonals = [jnp.diagonal(part, axis1=-2, axis2=-1) for part in (factor.inverse, factor.middle)]
        roots = [jnp.sum(jnp.log(jnp.abs(one))) for one in diagonals]
        force = jnp.sum(jnp.where(w > 0, 3 * jnp.log(jnp.where(w > 0, w, 1.0)), 0.0))
        return -2 * (roots[0] + roots[1]) - force + 2 * jnp.sum(jnp.log(jnp.diagonal(self.spread)))


class NormalEquations(eqx.Module):
    """One frame's normal equations: over s, then theta in given directions, then Q's fields, then -1 for e itself."""

    square: Float[Array, "k k"]
    """(n + directions + fields + 1) squared."""
    tool: Float[Array, "3 j"]
    """Rows of what the tool says of the held particles, over theta, fields (zero) and e, in units of `tool_sd`."""


class WeightedResiduals(eqx.Module):
    """How a frame's prediction misses what was seen, under a metric."""

    squared: Float[Array, ""]
    fields: Float[Array, " q"]
    """Q^T N^-1 e."""
    tool: Float[Array, " 3"]
    """In units of `tool_sd`."""


def tool_sd(frame: ClosedFrame) -> Float[Array, ""]:
    """Of what the mean of the held particles is seen to do, from frame to frame [m]."""
    return jnp.hypot(TOOL_SD, frame.held_sd)


def grasp_sd(frame: ClosedFrame) -> Float[Array, ""]:
    """The same, of a whole grasp [m]."""
    return jnp.hypot(GRASP_SD, frame.held_sd)


def weigh(
    sheet: PredictedSheet,
    theta: Float[Array, " p"],
    s: Float[Array, " n"],
    frame: ClosedFrame,
    moment: FrameContext,
    x: Float[Array, "n 3"],
    noise: Float[Array, "n modes"],
) -> Metric:
    """How misfits of a frame weigh at its predicted state x; `noise` are the smooth fields of what is seen [m].

    Two programs, as `normal_equations` is: as one, XLA lays the factor out so that a solve takes half as long again.
    """
    return _metric(*_around(sheet, theta, s, frame, moment, x), frame, noise)


def normal_equations(
    sheet: PredictedSheet,
    metric: Metric,
    theta: Float[Array, " p"],
    directions: Float[Array, "p d"],
    frame: ClosedFrame,
    moment: FrameContext,
) -> NormalEquations:
    """A frame's normal equations where it was weighed."""
    columns, tool = _columns(sheet, metric, theta, directions, frame, moment)
    return NormalEquations(square=_whole(metric, columns), tool=tool)


@eqx.filter_jit
def misfit(
    sheet: PredictedSheet,
    metric: Metric,
    theta: Float[Array, " p"],
    frame: ClosedFrame,
    moment: FrameContext,
    x: Float[Array, "n 3"],
) -> WeightedResiduals:
    """Of another prediction x of the same frame."""
    model = sheet.model(theta, moment, frame.way)
    e = metric.forces(frame.y - look(model, x))[:, :, None]
    against = metric.dot(jnp.concatenate([metric.fields, e], axis=2), e, metric.whitened(e))[:, 0]
    tool = beyond_tool(sheet, model, theta, frame, moment, x) / tool_sd(frame)
    return WeightedResiduals(squared=against[-1], fields=against[:-1], tool=tool)


@eqx.filter_jit
def _around(
    sheet: PredictedSheet,
    theta: Float[Array, " p"],
    s: Float[Array, " n"],
    frame: ClosedFrame,
    moment: FrameContext,
    x: Float[Array, "n 3"],
) -> tuple[ForceBalance, Frame, Float[Array, "n 3 q"]]:
    """The balance of forces, that linearised at x, and Q."""
    model = sheet.model(theta, moment, frame.way)
    balance = sheet.balance_of(model.energy)
    precision = jnp.where(frame.held[:, None, None], CARRIED * jnp.eye(3)[None], frame.precision)
    linear = balance.linearise(
        x, s, Evidence(y=x, precision=precision, held=frame.held, force_unknown=frame.force_unknown)
    )
    return balance, linear, _fields(model.term(TriangleMembrane), sheet.balance.energy.rest, linear.error)


@eqx.filter_jit
def _metric(
    balance: ForceBalance,
    linear: Frame,
    fields: Float[Array, "n 3 q"],
    frame: ClosedFrame,
    noise: Float[Array, "n modes"],
) -> Metric:
    smooth = noise[:, None, :, None] * jnp.eye(3)[None, :, None, :]
    smooth = _each(partial(balance.apply, linear.dr_dx), _as_seen(frame, smooth.reshape(len(noise), 3, -1)))
    white = _each(partial(balance.whitened, linear), smooth)
    metric = Metric(
        balance=balance,
        frame=linear,
        seen=frame.counted.astype(float),
        noise=white,
        spread=jnp.linalg.cholesky(jnp.eye(smooth.shape[2]) + jnp.einsum("nia,nib->ab", smooth, white)),
        fields=fields,
        white=_each(partial(balance.whitened, linear), fields),
        among=jnp.zeros((N_FIELDS, N_FIELDS)),
    )
    return eqx.tree_at(lambda one: one.among, metric, metric.dot(fields, fields, metric.white))


@eqx.filter_jit
def _columns(
    sheet: PredictedSheet,
    metric: Metric,
    theta: Float[Array, " p"],
    directions: Float[Array, "p d"],
    frame: ClosedFrame,
    moment: FrameContext,
) -> tuple[Float[Array, "n 3 j"], Float[Array, "3 k"]]:
    """G along some directions, and e; and what the tool says of G, Q and e."""
    balance, linear = metric.balance, metric.frame
    x, s = linear.x, linear.s

    def along(u):
        to = theta + directions @ u
        changed = sheet.model(to, moment, frame.way)
        unbalanced = sheet.balance_of(changed.energy).unbalanced(x, s)
        return unbalanced, look(changed, x), beyond_tool(sheet, changed, to, frame, moment, x)

    push, shown, taken = jax.jacfwd(along)(jnp.zeros(directions.shape[1]))
    model = sheet.model(theta, moment, frame.way)
    e = metric.forces(frame.y - look(model, x)) + linear.unbalanced
    seen = _each(partial(balance.apply, linear.dr_dx), _as_seen(frame, shown))
    tool = jnp.concatenate(
        [taken, jnp.zeros((3, N_FIELDS)), beyond_tool(sheet, model, theta, frame, moment, x)[:, None]], axis=1
    )
    return jnp.concatenate([push - seen, e[:, :, None]], axis=2), tool / tool_sd(frame)


def _each(of: Callable[[Array], Array], columns: Float[Array, "n 3 k"]) -> Float[Array, "n 3 k"]:
    """A linear map of each column."""
    return jax.vmap(of, in_axes=2, out_axes=2)(columns)


def _as_seen(frame: ClosedFrame, off: Float[Array, "n 3 k"]) -> Float[Array, "n 3 k"]:
    """What is off where positions are seen: of each particle that counts, and together of those that are held."""
    counted = frame.counted
    held = jnp.where(frame.held[:, None, None], mean_of_held(frame, off)[None], 0.0)
    return jnp.where(counted[:, None, None], off, held)


@eqx.filter_jit
def _whole(metric: Metric, beyond: Float[Array, "n 3 j"]) -> Float[Array, "_k _k"]:
    """Inner products of D's columns, one a particle, of G's, Q's and e, G and e given."""
    balance, frame = metric.balance, metric.frame
    slope, n = frame.dr_ds, len(frame.s)
    own = balance.precision_along(frame, slope)
    shared = jnp.einsum("ni,nic->cn", slope, metric.noise)
    own = own - shared.T @ jax.scipy.linalg.cho_solve((metric.spread, True), shared)
    columns, white = _beside(beyond, metric.fields), _beside(metric.whitened(beyond), metric.white)
    others = jnp.einsum("nic,nik->ck", metric.noise, columns)
    solved = jax.scipy.linalg.cho_solve((metric.spread, True), others)
    between = jnp.einsum("ni,nik->nk", slope, white) - shared.T @ solved
    among = jnp.einsum("nij,nik->jk", columns, white) - others.T @ solved
    k = columns.shape[2]
    whole = jnp.zeros((n + k, n + k)).at[:n, :n].set(own).at[:n, n:].set(between)
    return whole.at[n:, :n].set(between.T).at[n:, n:].set(among)


def _beside(beyond: Float[Array, "n 3 j"], fields: Float[Array, "n 3 q"]) -> Float[Array, "n 3 k"]:
    """With the smooth fields' columns before the last, which is e's."""
    return jnp.concatenate([beyond[:, :, :-1], fields, beyond[:, :, -1:]], axis=2)


def _fields(
    membrane: TriangleMembrane, rest: Float[Array, "n 3"], error: Float[Array, " n"]
) -> Float[Array, "n 3 fields"]:
    """Cosines over the sheet in each direction, of the force error's size."""
    waves = cosines(flat(membrane, rest, rest), WAVES)
    along = error[:, None, None, None] * waves[:, None, :, None] * jnp.eye(3)[None, :, None, :]
    return along.reshape(len(rest), 3, N_FIELDS)
