"""Normal equations of one frame, linearised at its predicted state: attachments and effects together.

With the terms of `frame_likelihood`, at the bounded stiffnesses s and the parameters theta,

    H e + r + D ds + G dtheta

are the forces, where r is what the prediction leaves off balance. What counts are their innovations. In these H is that
of the frame itself for what moves the view of both; what moves the state of the frame before counts as if its H were
the same. The amplitudes a are eliminated frame by frame, c grasp by grasp. At a noisy state
instead of the predicted one this would be an errors-in-variables problem, with false effects.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..effects.sheet_model import FrameContext, look
from ..filters.smooth_noise import each
from .bed_contact import with_contact
from .frame_likelihood import FrameLikelihood, seen_shift
from .grasped_frames import ClosedFrame
from .sheet import PredictedSheet, gripped_forces, tool_residual
from .tool_pull import off_balance, predicted_pull

TOOL_SD = 2.5e-4
"""Standard deviation of the mean of the held particles about the tool, from frame to frame [m]."""
GRASP_SD = 5e-4
"""Standard deviation of its offset in a grasp, because it is not known exactly where the jaws closed [m]."""


class NormalEquations(eqx.Module):
    """One frame's normal equations over s, then theta in given directions, then c, then -1 for e itself."""

    square: Float[Array, "k k"]
    """Normal equations, k = n + directions + fields + 1."""
    tool: Float[Array, "3 j"]
    """Rows of the tool's residual, over theta, c (zero) and e, in units of `tool_sd`."""
    pull: Float[Array, "3 k"] | None = None
    """Rows of the residual of the tool's force, in units of its sd; None where no frame has a measured one."""


class SheetResiduals(NamedTuple):
    """The residuals of a sheet's particles."""

    positions: Float[Array, "n 3"]
    """Residuals e of the positions of particles that are seen, 0 of the others [m]."""
    unbalanced: Float[Array, "n 3"]
    """Forces r that do not balance [N]."""


class Residuals(eqx.Module):
    """A frame's residuals at a predicted state."""

    sheet: SheetResiduals
    """Those of the sheet."""
    tool: Float[Array, " 3"]
    """Residual of the tool, in units of `tool_sd`."""
    pull: Float[Array, " 3"] | None = None
    """Residual of the tool's force, in units of its sd; None where no frame has a measured one."""


class WeightedResiduals(eqx.Module):
    """A frame's residuals under given weights."""

    own: Residuals
    """The residuals."""
    before: SheetResiduals
    """Those of each particle in the frame that its error follows; 0 where there is none."""
    innovation: Float[Array, "n 3"]
    """Innovation of the forces H e + r [N]."""
    squared: Float[Array, ""]
    """Squared norm of the innovation under the weights."""
    common: Float[Array, " q"]
    """Inner products of the innovation with the smooth force fields."""


def tool_sd(frame: ClosedFrame) -> Float[Array, ""]:
    """Return the sd of the observed mean of the held particles about the tool, from frame to frame [m]."""
    return jnp.hypot(TOOL_SD, frame.held_sd)


def grasp_sd(frame: ClosedFrame) -> Float[Array, ""]:
    """Return the sd of its offset in a whole grasp [m]."""
    return jnp.hypot(GRASP_SD, frame.held_sd)


class SheetColumns(NamedTuple):
    """By what the residuals of a sheet's particles change."""

    of_s: Float[Array, "n 3"]
    """D, the change of the forces on each particle with its own s [N]."""
    of_state: Float[Array, "n 3 d"]
    """Change of all forces with the parameters in some directions, where these move the sheet [N]."""
    of_view: Float[Array, "n 3 d"]
    """By how much they move what is seen of the sheet where it is [m]."""

    def of_theta(self, likelihood: FrameLikelihood) -> Float[Array, "n 3 d"]:
        """Return G, the change of all forces with the parameters [N]."""
        return self.of_state - each(likelihood.forces, self.of_view)


class Columns(eqx.Module):
    """By what a frame's residuals change at the state where its weights were computed."""

    sheet: SheetColumns
    """Change of the sheet's residuals."""
    tool: Float[Array, "3 d"]
    """Change of the tool's residual, in units of `tool_sd`."""
    pull: Float[Array, "3 k"] | None = None
    """Rows of the residual of the tool's force, over s, theta, c (zero) and e, in units of its sd."""


def normal_equations(
    likelihood: FrameLikelihood, columns: Columns, before: SheetColumns, residuals: WeightedResiduals
) -> NormalEquations:
    """Return a frame's normal equations.

    Args:
        likelihood: its weights.
        columns: by what its residuals change.
        before: the same of each particle in the frame that its error follows; 0 where there is none.
        residuals: its weighted residuals.
    """
    tool = jnp.concatenate([columns.tool, _no_common(likelihood), residuals.own.tool[:, None]], axis=1)
    square = _inner_products(likelihood, *_innovations(likelihood, columns.sheet, before, residuals.innovation))
    return NormalEquations(square=square, tool=tool, pull=columns.pull)


@eqx.filter_jit
def _innovations(
    likelihood: FrameLikelihood, columns: SheetColumns, before: SheetColumns, of_forces: Float[Array, "n 3"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3 j"]]:
    """Return the innovations of D, and of G and of the forces together."""
    new = SheetColumns(*map(likelihood.persistence.innovation, columns, before))
    return new.of_s, jnp.concatenate([new.of_theta(likelihood), of_forces[:, :, None]], axis=2)


def columns_of(
    sheet: PredictedSheet,
    likelihood: FrameLikelihood,
    theta: Float[Array, " p"],
    directions: Float[Array, "p d"],
    frame: ClosedFrame,
    context: FrameContext,
) -> Columns:
    """Return by what a frame's residuals change at the state where its weights were computed."""
    of_state, of_view, tool = _parameter_columns(sheet, likelihood, theta, directions, frame, context)
    pull = None
    if frame.pull is not None:
        pull = _pull_rows(sheet, likelihood, theta, directions, frame, context)
    moved = SheetColumns(of_s=likelihood.frame.dr_ds, of_state=of_state, of_view=of_view)
    return Columns(sheet=moved, tool=tool, pull=pull)


@eqx.filter_jit
def residuals_of(
    sheet: PredictedSheet,
    likelihood: FrameLikelihood,
    theta: Float[Array, " p"],
    s: Float[Array, " n"],
    frame: ClosedFrame,
    context: FrameContext,
    x: Float[Array, "n 3"],
) -> Residuals:
    """Return the residuals of another prediction x of the same frame.

    Forces that do not balance there count too: where a material is unstable, no equilibrium is found.
    """
    model = sheet.model(theta, context, frame.displacement)
    energy = with_contact(model, likelihood.contact).energy
    unbalanced = sheet.balance.with_energy(energy).unbalanced(x, s)
    positions = likelihood.seen[:, None] * (frame.y - look(model, x))
    tool = tool_residual(sheet, model, theta, frame, context, x) / tool_sd(frame)
    pull = None
    if frame.pull is not None and likelihood.adjoint is not None:
        predicted = predicted_pull(sheet.balance, model, frame, s, x)
        off = jnp.where(frame.held[:, None], 0.0, unbalanced)
        predicted = predicted - jnp.einsum("nic,ni->c", likelihood.adjoint, off)
        pull = frame.pull.weight * (predicted - frame.pull.force)
    return Residuals(sheet=SheetResiduals(positions, unbalanced), tool=tool, pull=pull)


@eqx.filter_jit
def weighted_residuals(likelihood: FrameLikelihood, own: Residuals, before: SheetResiduals) -> WeightedResiduals:
    """Return weighted residuals, from those of the frame and those that its errors follow."""
    innovation = likelihood.persistence.innovation
    positions, unbalanced = map(innovation, own.sheet, before)
    i = (likelihood.forces(positions) + unbalanced)[:, :, None]
    products = likelihood.dot(jnp.concatenate([likelihood.fields, i], axis=2), i, likelihood.whitened(i))[:, 0]
    return WeightedResiduals(own=own, before=before, innovation=i[:, :, 0], squared=products[-1], common=products[:-1])


@eqx.filter_jit
def _parameter_columns(
    sheet: PredictedSheet,
    likelihood: FrameLikelihood,
    theta: Float[Array, " p"],
    directions: Float[Array, "p d"],
    frame: ClosedFrame,
    context: FrameContext,
) -> tuple[Float[Array, "n 3 d"], Float[Array, "n 3 d"], Float[Array, "3 d"]]:
    """Return the two parts of G along some directions, and the change of the tool's residual.

    What is held is where it is seen, so that the sheet moves where the view of it does.
    """
    x, s = likelihood.frame.x, likelihood.frame.s

    def along(u):
        to = theta + directions @ u
        changed = sheet.model(to, context, frame.displacement)
        energy = with_contact(changed, likelihood.contact).energy
        unbalanced = sheet.balance.with_energy(energy).unbalanced(x, s)
        return unbalanced, look(changed, x), tool_residual(sheet, changed, to, frame, context, x)

    dforce, dview, dtool = jax.jacfwd(along)(jnp.zeros(directions.shape[1]))
    seen = seen_shift(frame, dview)
    view = jnp.where(frame.counted[:, None, None], seen, 0.0)
    return dforce - each(likelihood.forces, seen - view), view, dtool / tool_sd(frame)


@eqx.filter_jit
def _pull_rows(
    sheet: PredictedSheet,
    likelihood: FrameLikelihood,
    theta: Float[Array, " p"],
    directions: Float[Array, "p d"],
    frame: ClosedFrame,
    context: FrameContext,
) -> Float[Array, "3 k"]:
    """Return the rows of the residual of the tool's force, over s, theta in directions, c (zero) and e."""
    assert frame.pull is not None and likelihood.adjoint is not None
    balance, linear, adjoint = likelihood.balance, likelihood.frame, likelihood.adjoint
    x, s = linear.x, linear.s
    model = sheet.model(theta, context, frame.displacement)

    def along(u):
        to = theta + directions @ u
        pull = predicted_pull(sheet.balance, sheet.model(to, context, frame.displacement), frame, s, x)
        return gripped_forces(sheet, to, s, frame, context, x), pull

    dforce, dpull = jax.jacfwd(along)(jnp.zeros(directions.shape[1]))
    dtheta = dpull - jnp.einsum("nic,nid->cd", adjoint, dforce)
    held, pulled = frame.held[:, None], (balance.reference / (1 - s))[:, None] * (x - balance.energy.rest)
    own = jnp.where(held, model.force_factor * pulled / (1 - s)[:, None], 0.0)
    ds = own.T - jnp.einsum("nic,ni->cn", adjoint, jnp.where(held, pulled, linear.dr_ds))
    predicted = predicted_pull(sheet.balance, model, frame, s, x)
    e = predicted - jnp.einsum("nic,ni->c", adjoint, off_balance(linear)) - frame.pull.force
    return frame.pull.weight * jnp.concatenate([ds, dtheta, _no_common(likelihood), e[:, None]], axis=1)


def _no_common(likelihood: FrameLikelihood) -> Float[Array, "3 k"]:
    return jnp.zeros((3, len(likelihood.among)))


@eqx.filter_jit
def _inner_products(
    likelihood: FrameLikelihood, slope: Float[Array, "n 3"], beyond: Float[Array, "n 3 j"]
) -> Float[Array, "_k _k"]:
    """Return the inner products of the columns of D (one a particle), G, Q and e; `beyond` holds G and e."""
    frame, d, white = likelihood.frame, beyond.shape[2] - 1, likelihood.whitened(beyond)
    shared = jnp.einsum("ni,nic->cn", slope, likelihood.noise)
    solved = jax.scipy.linalg.cho_solve((likelihood.spread, True), shared)
    own = likelihood.balance.precision_along(frame, slope) - shared.T @ solved

    def of_slope(columns: Float[Array, "n 3 k"], white: Float[Array, "n 3 k"]) -> Float[Array, "n k"]:
        return jnp.einsum("ni,nik->nk", slope, white) - solved.T @ jnp.einsum("nic,nik->ck", likelihood.noise, columns)

    def joined(of_beyond: Float[Array, "r j"], of_common: Float[Array, "r k"]) -> Float[Array, "r _j"]:
        return jnp.concatenate([of_beyond[:, :d], of_common, of_beyond[:, d:]], axis=1)

    fields = likelihood.fields
    common = likelihood.dot(fields, beyond, white)
    whole = joined(likelihood.dot(beyond, beyond, white), common.T)
    among = jnp.concatenate([whole[:d], joined(common, likelihood.among), whole[d:]])
    between = joined(of_slope(beyond, white), of_slope(fields, likelihood.white))
    return jnp.block([[own, between], [between.T, among]])
