"""Likelihood of one frame's observed positions, linearised at its predicted state.

Let e = y - h(x) be the residual of the positions, with x the predicted equilibrium. Errors of a frame persist in the
next one of the grasp, as an autoregressive process of order 1 [Box, Jenkins & Reinsel, Time Series Analysis, 4th
edition 2008, section 3.2]. With rho the autocorrelation of a particle's error and of its last one, or of rest, where
e = 0, and kappa the variance of all errors over the assumed one (`persistence`), the forces of the innovation are

    i = H (e_k - rho e_last) / sqrt(kappa (1 - rho^2)).

Let N be the covariance of the model's force errors and of the noise of observed positions, mapped to forces by H. Then

    i + H F a + Q c = n,    n ~ N(0, N),  a ~ N(0, I),  c ~ N(0, amplitude^2 I)

with F the smooth fields of the noise, and Q smooth force fields that stand for any other error of the model and drive
all frames of a grasp alike. So the log density of the positions is, given those before and for c = 0,

    -1/2 [i^T (N + H F F^T H^T)^-1 i + ln |N + H F F^T H^T| - 2 ln |H| + sum ln (kappa (1 - rho^2))]

up to a constant, with the sum over observed coordinates. A model that yields more has a wider density, so a
comparison of models needs both determinants. c is eliminated grasp by grasp (`normal_equations.common`).
"""

from dataclasses import replace
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
from ..physics.block_tridiagonal import BlockCholesky, log_det, normal_cholesky
from ..physics.membrane import TriangleMembrane
from .bed_contact import left_out_contact, with_contact
from .grasped_frames import ClosedFrame
from .persistence import Persistence
from .sheet import PredictedSheet, mean_of_held
from .tool_pull import adjoint, pull_slope

WAVES = 4
"""Cosines along each side of the sheet in the smooth force fields."""
N_FIELDS = 3 * WAVES**2
"""Number of smooth force fields: each product of cosines in three directions."""
HELD_STATE_PRECISION = 1e12
"""Precision of the state of what is held, which follows the grip exactly [1/m^2]."""


class FrameLikelihood(eqx.Module):
    """Likelihood of a frame's observed positions near its predicted state."""

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
    """Smooth force fields Q, times the factor of what drives the errors of all frames alike."""
    white: Float[Array, "n 3 q"]
    """Smooth force fields, whitened: N^-1 Q."""
    among: Float[Array, "q q"]
    """Inner products of Q under (N + H F F^T H^T)^-1."""
    log_square: Float[Array, ""]
    """ln |H^T H| over the particles with a force equation."""
    persistence: Persistence
    """How its errors follow those of the frames before."""
    contact: Float[Array, " n"]
    """Share of the bed's contact with each particle that counts; see `bed_contact`."""
    adjoint: Float[Array, "n 3 3"] | None = None
    """By how much the tool's force falls with a force on each particle [1]; None where no frame has a measured one."""

    def dot(
        self, left: Float[Array, "n 3 l"], right: Float[Array, "n 3 r"], white: Float[Array, "n 3 r"]
    ) -> Float[Array, "l r"]:
        """Return left^T (N + H F F^T H^T)^-1 right, given `white` = N^-1 right."""
        a = jnp.einsum("nic,nik->ck", self.noise, left)
        return jnp.einsum("nil,nir->lr", left, white) - a.T @ self.smooth_amplitudes(right)

    def smooth_amplitudes(self, columns: Float[Array, "n 3 k"]) -> Float[Array, "c k"]:
        """Return (H F)^T (N + H F F^T H^T)^-1 columns: minus the likeliest a for each."""
        return jax.scipy.linalg.cho_solve((self.spread, True), jnp.einsum("nic,nik->ck", self.noise, columns))

    def solved(self, forces: Float[Array, "n 3"]) -> tuple[Float[Array, "n 3"], Float[Array, " c"]]:
        """Return (N + H F F^T H^T)^-1 forces, and their `smooth_amplitudes`."""
        column = forces[:, :, None]
        a = self.smooth_amplitudes(column)[:, 0]
        return self.whitened(column)[:, :, 0] - self.noise @ a, a

    def whitened(self, columns: Float[Array, "n 3 k"]) -> Float[Array, "n 3 k"]:
        """Return N^-1 times each column."""
        return each(partial(self.balance.whitened, self.frame), columns)

    @eqx.filter_jit
    def forces(self, residual: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Return the forces H e of a residual e of positions [m]."""
        return self.balance.apply(self.frame.dr_dx, residual)

    @property
    def force_share(self) -> Float[Array, " n"]:
        """Return the share that the force error of the model has in the variance of each force."""
        return ((1 - self.frame.s) * self.frame.error) ** 2 * self.frame.weight

    @eqx.filter_jit
    def log_determinant(self) -> Float[Array, ""]:
        """Return ln |C| of the observed positions' covariance C, up to the precision of their white noise.

        It is ln |N + H F F^T H^T| - 2 ln |H| + sum ln (kappa (1 - rho^2)). Rows without a force equation are those of
        inputs, and do not count.
        """
        w, known = self.frame.weight, self.frame.weight > 0
        log_weights = jnp.sum(jnp.where(known, 3 * jnp.log(jnp.where(known, w, 1.0)), 0.0))
        smooth = 2 * jnp.sum(jnp.log(jnp.diagonal(self.spread)))
        new = 3 * jnp.sum(self.seen * jnp.log(self.persistence.new))
        return log_det(self.frame.factor) - log_weights + smooth - self.log_square + new

    def inner(self, rows: Float[Array, "n p 3 3"]) -> Float[Array, "n p 3 3"]:
        """Return rows of H with nothing but what couples particles with a force equation."""
        known = self.frame.weight > 0
        both = known[:, None] & jnp.append(known, False)[self.balance.neighbours]
        return jnp.where(both[:, :, None, None], rows, 0.0)

    def square_factor(self) -> BlockCholesky:
        """Return the factor of H^T H over the particles with a force equation, with an identity for the others."""
        balance, known, rows = self.balance, self.frame.weight > 0, self.inner(self.frame.dr_dx)
        inputs = jnp.where(known[:, None, None], 0.0, jnp.eye(3)[None])
        return normal_cholesky(balance.layout, balance.places, rows, known.astype(float), inputs)


def frame_likelihood(
    sheet: PredictedSheet,
    theta: Float[Array, " p"],
    s: Float[Array, " n"],
    frame: ClosedFrame,
    context: FrameContext,
    x: Float[Array, "n 3"],
    noise: Float[Array, "n modes"],
    persistence: Persistence,
    contact: Float[Array, " n"],
) -> FrameLikelihood:
    """Return a frame's likelihood at its predicted state x; `noise` are the smooth noise's fields [m].

    `contact` is the share of the bed's contact that counts; see `bed_contact`.

    It is two programs, like `normal_equations`: as one, XLA lays the factor out so that a solve takes 1.5 times as
    long.
    """
    balance, linear, fields = around(sheet, theta, s, frame, context, x, contact)
    likelihood = _likelihood(balance, linear, persistence.drive * fields, frame, noise, persistence, contact)
    likelihood = replace(likelihood, log_square=_log_square(likelihood))
    if frame.pull is None:
        return likelihood
    return replace(likelihood, adjoint=_pull_adjoint(sheet, likelihood, theta, frame, context))


def with_force_sd(
    likelihood: FrameLikelihood, force_sd: Float[Array, ""], frame: ClosedFrame, noise: Float[Array, "n modes"]
) -> FrameLikelihood:
    """Return a frame's likelihood with another standard deviation of force errors, the field of `ForceBalance` [N]."""
    found = _likelihood(*_with_force_sd(likelihood, force_sd), frame, noise, likelihood.persistence, likelihood.contact)
    return replace(found, log_square=likelihood.log_square, adjoint=likelihood.adjoint)


@eqx.filter_jit
def with_noise(likelihood: FrameLikelihood, factor: Float[Array, ""], persistence: Persistence) -> FrameLikelihood:
    """Return a frame's likelihood with errors that follow others as given, and with so many times the smooth noise."""
    eye, driven = jnp.eye(len(likelihood.spread)), persistence.drive / likelihood.persistence.drive
    spread = eye + factor**2 * (likelihood.spread @ likelihood.spread.T - eye)
    changed = replace(
        likelihood,
        noise=factor * likelihood.noise,
        spread=jnp.linalg.cholesky(spread),
        fields=driven * likelihood.fields,
        white=driven * likelihood.white,
        persistence=persistence,
    )
    return replace(changed, among=changed.dot(changed.fields, changed.fields, changed.white))


@eqx.filter_jit
def _with_force_sd(
    likelihood: FrameLikelihood, force_sd: Float[Array, ""]
) -> tuple[ForceBalance, Frame, Float[Array, "n 3 q"]]:
    factor = force_sd / likelihood.balance.force_sd
    balance, linear = replace(likelihood.balance, force_sd=force_sd), likelihood.frame
    error = factor * linear.error
    weight = balance.weight(error, linear.s, linear.evidence)
    precision = balance.position_precision(linear.evidence)
    root = normal_cholesky(balance.layout, balance.places, linear.dr_dx, weight, precision)
    return balance, replace(linear, error=error, weight=weight, factor=root), factor * likelihood.fields


@eqx.filter_jit
def around(
    sheet: PredictedSheet,
    theta: Float[Array, " p"],
    s: Float[Array, " n"],
    frame: ClosedFrame,
    context: FrameContext,
    x: Float[Array, "n 3"],
    contact: Float[Array, " n"],
) -> tuple[ForceBalance, Frame, Float[Array, "n 3 q"]]:
    """Return the force balance with a share of the bed's contact, its linearisation at x, and Q."""
    model = with_contact(sheet.model(theta, context, frame.displacement), contact)
    balance = sheet.balance.with_energy(model.energy)
    precision = jnp.where(frame.held[:, None, None], HELD_STATE_PRECISION * jnp.eye(3)[None], frame.precision)
    linear = balance.linearise(
        x, s, Evidence(y=x, precision=precision, held=frame.held, force_unknown=frame.force_unknown)
    )
    return balance, linear, _fields(model.term(TriangleMembrane), sheet.balance.energy.rest, linear.error)


@eqx.filter_jit
def _likelihood(
    balance: ForceBalance,
    linear: Frame,
    fields: Float[Array, "n 3 q"],
    frame: ClosedFrame,
    noise: Float[Array, "n modes"],
    persistence: Persistence,
    contact: Float[Array, " n"],
) -> FrameLikelihood:
    smooth = each(partial(balance.apply, linear.dr_dx), seen_noise(frame, noise))
    white = each(partial(balance.whitened, linear), smooth)
    likelihood = FrameLikelihood(
        balance=balance,
        frame=linear,
        seen=frame.counted.astype(float),
        noise=white,
        spread=jnp.linalg.cholesky(jnp.eye(smooth.shape[2]) + jnp.einsum("nia,nib->ab", smooth, white)),
        fields=fields,
        white=each(partial(balance.whitened, linear), fields),
        among=jnp.zeros((N_FIELDS, N_FIELDS)),
        log_square=jnp.zeros(()),
        persistence=persistence,
        contact=contact,
    )
    return replace(likelihood, among=likelihood.dot(fields, fields, likelihood.white))


@eqx.filter_jit
def _log_square(likelihood: FrameLikelihood) -> Float[Array, ""]:
    return log_det(likelihood.square_factor())


@eqx.filter_jit
def _pull_adjoint(
    sheet: PredictedSheet,
    likelihood: FrameLikelihood,
    theta: Float[Array, " p"],
    frame: ClosedFrame,
    context: FrameContext,
) -> Float[Array, "n 3 3"]:
    balance, linear = likelihood.balance, likelihood.frame
    model = sheet.model(theta, context, frame.displacement)
    left_out = left_out_contact(model, linear.x, likelihood.contact)
    return adjoint(balance, linear, pull_slope(balance, model, frame, linear.s, linear.x), left_out)


def seen_noise(frame: ClosedFrame, noise: Float[Array, "n modes"]) -> Float[Array, "n 3 k"]:
    """Return the observed shift F of each field of the smooth noise in each direction [m]."""
    smooth = noise[:, None, :, None] * jnp.eye(3)[None, :, None, :]
    return seen_shift(frame, smooth.reshape(len(noise), 3, -1))


def seen_shift(frame: ClosedFrame, shift: Float[Array, "n 3 k"]) -> Float[Array, "n 3 k"]:
    """Return the observed shift of positions: of each counted particle itself, and the mean of those that are held."""
    counted = frame.counted
    held = jnp.where(frame.held[:, None, None], mean_of_held(frame, shift)[None], 0.0)
    return jnp.where(counted[:, None, None], shift, held)


def _fields(
    membrane: TriangleMembrane, rest: Float[Array, "n 3"], error: Float[Array, " n"]
) -> Float[Array, "n 3 fields"]:
    """Return the smooth force fields Q: cosines over the sheet in each direction, scaled by the force error."""
    waves = cosines(flat(membrane, rest, rest), WAVES)
    along = error[:, None, None, None] * waves[:, None, :, None] * jnp.eye(3)[None, :, None, :]
    return along.reshape(len(rest), 3, N_FIELDS)
