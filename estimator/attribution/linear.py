"""Normal equations of one frame, linearised at its predicted state: attachments and effects together.

With the terms of `frame_likelihood`, at the bounded stiffnesses s and the parameters theta,

    e + r + D ds + G dtheta + Q c + H F (w + a) = n

where r = 0 but for rounding. a is eliminated frame by frame, w and c grasp by grasp. At a noisy state instead of the
predicted one this would be an errors-in-variables problem, with false effects.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..effects.sheet_model import FrameContext, look
from ..filters.smooth_noise import each
from .frame_likelihood import FrameLikelihood, seen_shift
from .grasped_frames import ClosedFrame
from .sheet import PredictedSheet, gripped_forces, tool_residual
from .tool_pull import off_balance, predicted_pull

TOOL_SD = 2.5e-4
"""Standard deviation of the mean of the held particles about the tool, from frame to frame [m]."""
GRASP_SD = 5e-4
"""Standard deviation of its offset in a grasp, because it is not known exactly where the jaws closed [m]."""


class NormalEquations(eqx.Module):
    """One frame's normal equations over s, then theta in given directions, then c, then w, then -1 for e itself."""

    square: Float[Array, "k k"]
    """Normal equations, k = n + directions + fields + shifts + 1."""
    tool: Float[Array, "3 j"]
    """Rows of the tool's residual, over theta, c and w (zero) and e, in units of `tool_sd`."""
    pull: Float[Array, "3 k"] | None = None
    """Rows of the residual of the tool's force, in units of its sd; None where no frame has a measured one."""


class WeightedResiduals(eqx.Module):
    """A frame's residuals under given weights."""

    forces: Float[Array, "n 3"]
    """e itself [N]."""
    squared: Float[Array, ""]
    """Squared norm of e under the weights."""
    common: Float[Array, " k"]
    """Inner products of e with the columns that frames have in common; see `FrameLikelihood.among`."""
    tool: Float[Array, " 3"]
    """Residual of the tool, in units of `tool_sd`."""
    pull: Float[Array, " 3"] | None = None
    """Residual of the tool's force, in units of its sd; None where no frame has a measured one."""


def tool_sd(frame: ClosedFrame) -> Float[Array, ""]:
    """Return the sd of the observed mean of the held particles about the tool, from frame to frame [m]."""
    return jnp.hypot(TOOL_SD, frame.held_sd)


def grasp_sd(frame: ClosedFrame) -> Float[Array, ""]:
    """Return the sd of its offset in a whole grasp [m]."""
    return jnp.hypot(GRASP_SD, frame.held_sd)


def normal_equations(
    sheet: PredictedSheet,
    likelihood: FrameLikelihood,
    theta: Float[Array, " p"],
    directions: Float[Array, "p d"],
    frame: ClosedFrame,
    context: FrameContext,
) -> NormalEquations:
    """Return a frame's normal equations at the state where its weights were computed."""
    columns, tool = _columns(sheet, likelihood, theta, directions, frame, context)
    pull = None
    if frame.pull is not None:
        pull = _pull_rows(sheet, likelihood, theta, directions, frame, context)
    return NormalEquations(square=_inner_products(likelihood, columns), tool=tool, pull=pull)


@eqx.filter_jit
def misfit(
    sheet: PredictedSheet,
    likelihood: FrameLikelihood,
    theta: Float[Array, " p"],
    s: Float[Array, " n"],
    frame: ClosedFrame,
    context: FrameContext,
    x: Float[Array, "n 3"],
) -> WeightedResiduals:
    """Return the weighted residuals of another prediction x of the same frame.

    Forces that do not balance there count too: where a material is unstable, no equilibrium is found.
    """
    model = sheet.model(theta, context, frame.displacement)
    unbalanced = sheet.balance.with_energy(model.energy).unbalanced(x, s)
    forces = likelihood.forces(frame.y - look(model, x)) + unbalanced
    e = forces[:, :, None]
    products = likelihood.dot(jnp.concatenate([likelihood.fields, e], axis=2), e, likelihood.whitened(e))[:, 0]
    tool = tool_residual(sheet, model, theta, frame, context, x) / tool_sd(frame)
    pull = None
    if frame.pull is not None and likelihood.adjoint is not None:
        predicted = predicted_pull(sheet.balance, model, frame, s, x)
        off = jnp.where(frame.held[:, None], 0.0, unbalanced)
        predicted = predicted - jnp.einsum("nic,ni->c", likelihood.adjoint, off)
        pull = frame.pull.weight * (predicted - frame.pull.force)
    common = jnp.concatenate([products[:-1], likelihood.shift_products(e)[:, 0]])
    return WeightedResiduals(forces=forces, squared=products[-1], common=common, tool=tool, pull=pull)


def parameter_forces(
    sheet: PredictedSheet,
    likelihood: FrameLikelihood,
    theta: Float[Array, " p"],
    directions: Float[Array, "p d"],
    frame: ClosedFrame,
    context: FrameContext,
) -> Float[Array, "n 3 d"]:
    """Return G, the forces by which a change of the parameters moves what is observed, at the likelihood's state."""
    return _columns(sheet, likelihood, theta, directions, frame, context)[0][:, :, :-1]


@eqx.filter_jit
def _columns(
    sheet: PredictedSheet,
    likelihood: FrameLikelihood,
    theta: Float[Array, " p"],
    directions: Float[Array, "p d"],
    frame: ClosedFrame,
    context: FrameContext,
) -> tuple[Float[Array, "n 3 j"], Float[Array, "3 k"]]:
    """Return G along some directions and e as columns, and the rows of the tool's residual for G, Q, H F and e."""
    balance, linear = likelihood.balance, likelihood.frame
    x, s = linear.x, linear.s

    def along(u):
        to = theta + directions @ u
        changed = sheet.model(to, context, frame.displacement)
        unbalanced = sheet.balance.with_energy(changed.energy).unbalanced(x, s)
        return unbalanced, look(changed, x), tool_residual(sheet, changed, to, frame, context, x)

    dforce, dview, dtool = jax.jacfwd(along)(jnp.zeros(directions.shape[1]))
    model = sheet.model(theta, context, frame.displacement)
    e = likelihood.forces(frame.y - look(model, x)) + linear.unbalanced
    seen = each(partial(balance.apply, linear.dr_dx), seen_shift(frame, dview))
    tool = jnp.concatenate(
        [dtool, _no_common(likelihood), tool_residual(sheet, model, theta, frame, context, x)[:, None]], axis=1
    )
    return jnp.concatenate([dforce - seen, e[:, :, None]], axis=2), tool / tool_sd(frame)


@eqx.filter_jit
def _pull_rows(
    sheet: PredictedSheet,
    likelihood: FrameLikelihood,
    theta: Float[Array, " p"],
    directions: Float[Array, "p d"],
    frame: ClosedFrame,
    context: FrameContext,
) -> Float[Array, "3 k"]:
    """Return the rows of the residual of the tool's force, over s, theta in directions, c and w (zero) and e."""
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
def _inner_products(likelihood: FrameLikelihood, beyond: Float[Array, "n 3 j"]) -> Float[Array, "_k _k"]:
    """Return the inner products of the columns of D (one a particle), G, Q, H F and e; `beyond` holds G and e."""
    frame, d = likelihood.frame, beyond.shape[2] - 1
    slope, white = frame.dr_ds, likelihood.whitened(beyond)
    shared = jnp.einsum("ni,nic->cn", slope, likelihood.noise)
    solved = jax.scipy.linalg.cho_solve((likelihood.spread, True), shared)
    own = likelihood.balance.precision_along(frame, slope) - shared.T @ solved

    def of_slope(columns: Float[Array, "n 3 k"], white: Float[Array, "n 3 k"]) -> Float[Array, "n k"]:
        return jnp.einsum("ni,nik->nk", slope, white) - solved.T @ jnp.einsum("nic,nik->ck", likelihood.noise, columns)

    def joined(of_beyond: Float[Array, "r j"], of_common: Float[Array, "r k"]) -> Float[Array, "r _j"]:
        return jnp.concatenate([of_beyond[:, :d], of_common, of_beyond[:, d:]], axis=1)

    fields = likelihood.fields
    common = jnp.concatenate([likelihood.dot(fields, beyond, white), likelihood.shift_products(beyond)])
    whole = joined(likelihood.dot(beyond, beyond, white), common.T)
    among = jnp.concatenate([whole[:d], joined(common, likelihood.among), whole[d:]])
    between = joined(of_slope(beyond, white), jnp.concatenate([of_slope(fields, likelihood.white), solved.T], axis=1))
    return jnp.block([[own, between], [between.T, among]])
