"""One frame linearised at its predicted state: normal equations of attachments and effects together.

Let e = H (y - h(x)) + r, with x the predicted equilibrium (so that r = 0 but for rounding). Let N be the covariance of
the model's force errors and of the noise of observed positions, mapped to forces by H. Then

    e + D ds + G dtheta + Q c + H F a = n,    n ~ N(0, N),  a ~ N(0, I),  c ~ N(0, amplitude^2 I)

with s the bounded stiffnesses, F the smooth fields of the noise, independent in every frame, and Q smooth force fields
that stand for any other error of the model and are the same in all frames of a grasp. a is eliminated frame by frame, c
grasp by grasp. At a noisy state instead of the predicted one this would be an errors-in-variables problem, with false
effects.
"""

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
from ..filters.smooth_noise import each
from ..physics.membrane import TriangleMembrane
from .grasped_frames import ClosedFrame
from .sheet import PredictedSheet, look, mean_of_held, tool_residual

WAVES = 4
"""Cosines along each side of the sheet in the smooth force fields."""
N_FIELDS = 3 * WAVES**2
"""Number of smooth force fields: each product of cosines in three directions."""
TOOL_SD = 2.5e-4
"""Standard deviation of the mean of the held particles about the tool, from frame to frame [m]."""
GRASP_SD = 5e-4
"""Standard deviation of its offset in a grasp, because it is not known exactly where the jaws closed [m]."""
HELD_STATE_PRECISION = 1e12
"""Precision of the state of what is held, which follows the grip exactly [1/m^2]."""


class Metric(eqx.Module):
    """Weights of a frame's residuals, which are fixed while a fit searches for a better state."""

    balance: ForceBalance
    """Force balance of the frame."""
    frame: Frame
    """The force balance linearised at the predicted state."""
    seen: Float[Array, " n"]
    """1 for particles whose position is used, 0 for the others."""
    noise: Float[Array, "n 3 c"]
    """Smooth noise, whitened: N^-1 H F."""
    spread: Float[Array, "c c"]
    """Lower Cholesky factor of I + F^T H^T N^-1 H F."""
    fields: Float[Array, "n 3 q"]
    """Smooth force fields Q."""
    white: Float[Array, "n 3 q"]
    """Smooth force fields, whitened: N^-1 Q."""
    among: Float[Array, "q q"]
    """Inner products of the fields: Q^T (N + H F F^T H^T)^-1 Q."""

    def dot(
        self, left: Float[Array, "n 3 l"], right: Float[Array, "n 3 r"], white: Float[Array, "n 3 r"]
    ) -> Float[Array, "l r"]:
        """Return left^T (N + H F F^T H^T)^-1 right, given `white` = N^-1 right."""
        a, b = (jnp.einsum("nic,nik->ck", self.noise, side) for side in (left, right))
        solved = jax.scipy.linalg.cho_solve((self.spread, True), b)
        return jnp.einsum("nil,nir->lr", left, white) - a.T @ solved

    def whitened(self, columns: Float[Array, "n 3 k"]) -> Float[Array, "n 3 k"]:
        """Return N^-1 times each column."""
        return each(partial(self.balance.whitened, self.frame), columns)

    def forces(self, residual: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Return the forces H (y - h(x)) of a residual of positions y - h(x) [m]."""
        return self.balance.apply(self.frame.dr_dx, self.seen[:, None] * residual)

    def log_determinant(self) -> Float[Array, ""]:
        """Return ln |N + H F F^T H^T|, up to a constant for a given H and precision of observed positions."""
        w, factor = self.frame.weight, self.frame.factor
        diagonals = [jnp.diagonal(part, axis1=-2, axis2=-1) for part in (factor.inverse, factor.middle)]
        roots = [jnp.sum(jnp.log(jnp.abs(one))) for one in diagonals]
        force = jnp.sum(jnp.where(w > 0, 3 * jnp.log(jnp.where(w > 0, w, 1.0)), 0.0))
        return -2 * (roots[0] + roots[1]) - force + 2 * jnp.sum(jnp.log(jnp.diagonal(self.spread)))


class NormalEquations(eqx.Module):
    """One frame's normal equations over s, then theta in given directions, then the fields Q, then -1 for e itself."""

    square: Float[Array, "k k"]
    """Normal equations, k = n + directions + fields + 1."""
    tool: Float[Array, "3 j"]
    """Rows of the tool's residual, over theta, fields (zero) and e, in units of `tool_sd`."""


class WeightedResiduals(eqx.Module):
    """A frame's residuals under given weights."""

    squared: Float[Array, ""]
    """Squared norm of e under the weights."""
    fields: Float[Array, " q"]
    """Inner products of the fields with e: Q^T N^-1 e."""
    tool: Float[Array, " 3"]
    """Residual of the tool, in units of `tool_sd`."""


def tool_sd(frame: ClosedFrame) -> Float[Array, ""]:
    """Return the sd of the observed mean of the held particles about the tool, from frame to frame [m]."""
    return jnp.hypot(TOOL_SD, frame.held_sd)


def grasp_sd(frame: ClosedFrame) -> Float[Array, ""]:
    """Return the sd of its offset in a whole grasp [m]."""
    return jnp.hypot(GRASP_SD, frame.held_sd)


def weigh(
    sheet: PredictedSheet,
    theta: Float[Array, " p"],
    s: Float[Array, " n"],
    frame: ClosedFrame,
    context: FrameContext,
    x: Float[Array, "n 3"],
    noise: Float[Array, "n modes"],
) -> Metric:
    """Return the weights of a frame's residuals at its predicted state x; `noise` are the smooth noise's fields [m].

    It is two programs, like `normal_equations`: as one, XLA lays the factor out so that a solve takes 1.5 times as
    long.
    """
    return _metric(*_around(sheet, theta, s, frame, context, x), frame, noise)


def normal_equations(
    sheet: PredictedSheet,
    metric: Metric,
    theta: Float[Array, " p"],
    directions: Float[Array, "p d"],
    frame: ClosedFrame,
    context: FrameContext,
) -> NormalEquations:
    """Return a frame's normal equations at the state where its weights were computed."""
    columns, tool = _columns(sheet, metric, theta, directions, frame, context)
    return NormalEquations(square=_inner_products(metric, columns), tool=tool)


@eqx.filter_jit
def misfit(
    sheet: PredictedSheet,
    metric: Metric,
    theta: Float[Array, " p"],
    frame: ClosedFrame,
    context: FrameContext,
    x: Float[Array, "n 3"],
) -> WeightedResiduals:
    """Return the weighted residuals of another prediction x of the same frame."""
    model = sheet.model(theta, context, frame.displacement)
    e = metric.forces(frame.y - look(model, x))[:, :, None]
    products = metric.dot(jnp.concatenate([metric.fields, e], axis=2), e, metric.whitened(e))[:, 0]
    tool = tool_residual(sheet, model, theta, frame, context, x) / tool_sd(frame)
    return WeightedResiduals(squared=products[-1], fields=products[:-1], tool=tool)


@eqx.filter_jit
def _around(
    sheet: PredictedSheet,
    theta: Float[Array, " p"],
    s: Float[Array, " n"],
    frame: ClosedFrame,
    context: FrameContext,
    x: Float[Array, "n 3"],
) -> tuple[ForceBalance, Frame, Float[Array, "n 3 q"]]:
    """Return the force balance, its linearisation at x, and Q."""
    model = sheet.model(theta, context, frame.displacement)
    balance = sheet.balance_of(model.energy)
    precision = jnp.where(frame.held[:, None, None], HELD_STATE_PRECISION * jnp.eye(3)[None], frame.precision)
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
    smooth = each(partial(balance.apply, linear.dr_dx), _observed(frame, smooth.reshape(len(noise), 3, -1)))
    white = each(partial(balance.whitened, linear), smooth)
    metric = Metric(
        balance=balance,
        frame=linear,
        seen=frame.counted.astype(float),
        noise=white,
        spread=jnp.linalg.cholesky(jnp.eye(smooth.shape[2]) + jnp.einsum("nia,nib->ab", smooth, white)),
        fields=fields,
        white=each(partial(balance.whitened, linear), fields),
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
    context: FrameContext,
) -> tuple[Float[Array, "n 3 j"], Float[Array, "3 k"]]:
    """Return G along some directions and e as columns, and the rows of the tool's residual for G, Q and e."""
    balance, linear = metric.balance, metric.frame
    x, s = linear.x, linear.s

    def along(u):
        to = theta + directions @ u
        changed = sheet.model(to, context, frame.displacement)
        unbalanced = sheet.balance_of(changed.energy).unbalanced(x, s)
        return unbalanced, look(changed, x), tool_residual(sheet, changed, to, frame, context, x)

    dforce, dview, dtool = jax.jacfwd(along)(jnp.zeros(directions.shape[1]))
    model = sheet.model(theta, context, frame.displacement)
    e = metric.forces(frame.y - look(model, x)) + linear.unbalanced
    seen = each(partial(balance.apply, linear.dr_dx), _observed(frame, dview))
    tool = jnp.concatenate(
        [dtool, jnp.zeros((3, N_FIELDS)), tool_residual(sheet, model, theta, frame, context, x)[:, None]], axis=1
    )
    return jnp.concatenate([dforce - seen, e[:, :, None]], axis=2), tool / tool_sd(frame)


def _observed(frame: ClosedFrame, shift: Float[Array, "n 3 k"]) -> Float[Array, "n 3 k"]:
    """Return the observed shift of positions: of each counted particle itself, and the mean of those that are held."""
    counted = frame.counted
    held = jnp.where(frame.held[:, None, None], mean_of_held(frame, shift)[None], 0.0)
    return jnp.where(counted[:, None, None], shift, held)


@eqx.filter_jit
def _inner_products(metric: Metric, beyond: Float[Array, "n 3 j"]) -> Float[Array, "_k _k"]:
    """Return the inner products of the columns of D (one a particle), G, Q and e; `beyond` holds those of G and e."""
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
    square = jnp.zeros((n + k, n + k)).at[:n, :n].set(own).at[:n, n:].set(between)
    return square.at[n:, :n].set(between.T).at[n:, n:].set(among)


def _beside(beyond: Float[Array, "n 3 j"], fields: Float[Array, "n 3 q"]) -> Float[Array, "n 3 k"]:
    """Return columns with those of the smooth fields inserted before the last one, which is e."""
    return jnp.concatenate([beyond[:, :, :-1], fields, beyond[:, :, -1:]], axis=2)


def _fields(
    membrane: TriangleMembrane, rest: Float[Array, "n 3"], error: Float[Array, " n"]
) -> Float[Array, "n 3 fields"]:
    """Return the smooth force fields Q: cosines over the sheet in each direction, scaled by the force error."""
    waves = cosines(flat(membrane, rest, rest), WAVES)
    along = error[:, None, None, None] * waves[:, None, :, None] * jnp.eye(3)[None, :, None, :]
    return along.reshape(len(rest), 3, N_FIELDS)
