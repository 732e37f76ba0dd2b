"""The tool's force in all frames: the stiffnesses in N/m, and how far the declared membrane stiffness is off.

Positions give stiffnesses relative to the declared membrane stiffness. Where that is off by a factor c, so are all
elastic forces and every b. With `FrameForce` for the other symbols,

    L = P - loads = c E(s) + o + n,    n ~ N(0, V_L + c^2 V),    o ~ N(0, sd_o^2),    log c ~ N(mean, sd^2).

The error o of the sensor's offset is the same in all frames from one opening of the jaws to the next, and does not
average out over them.
E is the expected force given what was seen, so its error does not bias c, which that of L as a regressor would [Berkson
1950, doi:10.1080/01621459.1950.10483349]. Linearised at s and log c, frames add up in information form over both.
Log c is marginalised for the belief over s; given s it is normal.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ..belief.gaussian_information import GaussianInformation
from .tool_force import FrameForce

STEPS = 8
"""Gauss-Newton steps of log c and s; from off by ten it takes five."""
MAX_STEP = 1.0
"""Longest step of log c [nat]."""
MAX_LOG_FACTOR = 5.0
"""Largest size of log c [nat]: a factor of 150, where `force_axes` doubts the unit long before."""


@dataclass(frozen=True, kw_only=True)
class StackedForces:
    """The forces of several frames."""

    dE_ds: Float[np.ndarray, "t 3 n"]
    """Derivative of E by s [N]."""
    offset: Float[np.ndarray, "t 3"]
    """Value of E at s = 0 [N]."""
    pull: Float[np.ndarray, "t 3"]
    """Measured force of the tool on the tissue [N]."""
    loads: Float[np.ndarray, "t 3"]
    """The part of it that lifts the weight and presses on the bed [N]."""
    model_covariance: Float[np.ndarray, "t 3 3"]
    """Covariance of E given s [N^2]."""
    load_covariance: Float[np.ndarray, "t 3 3"]
    """Covariance of L without o [N^2]."""
    offset_sd: Float[np.ndarray, " t"]
    """Standard deviation of each component of o [N]."""
    offset_number: Int[np.ndarray, " t"]
    """Number of o, which frames have in common."""

    @classmethod
    def of(cls, frames: Sequence[FrameForce]) -> "StackedForces":
        """Stack frames, at least one."""
        columns = ("dE_ds", "pull", "loads", "model_covariance", "load_covariance", "offset_sd", "offset_number")
        return cls(
            offset=np.array([frame.elastic - frame.dE_ds @ frame.at for frame in frames]),
            **{name: np.array([getattr(frame, name) for frame in frames]) for name in columns},
        )

    def elastic(self, s: Float[np.ndarray, " n"]) -> Float[np.ndarray, "t 3"]:
        """Return E(s) [N]."""
        return self.offset + self.dE_ds @ s

    def covariance(self, factor: float) -> Float[np.ndarray, "t 3 3"]:
        """Return the covariance of n for a factor c [N^2]."""
        return self.load_covariance + factor**2 * self.model_covariance

    def total_covariance(self, factor: float) -> Float[np.ndarray, "t 3 3"]:
        """Return the covariance of o + n in each frame for a factor c [N^2]."""
        return self.covariance(factor) + self.offset_sd[:, None, None] ** 2 * np.eye(3)

    def offsets(self) -> Float[np.ndarray, "t 3 k"]:
        """Return o of each frame by standard normal variables, three for each offset [N]."""
        which = self.offset_number[:, None] == np.unique(self.offset_number)
        return np.kron((self.offset_sd[:, None] * which)[:, None], np.eye(3)[None])


class LogFactor(eqx.Module):
    """Normal distribution of log c."""

    sd: float
    """Standard deviation [nat]."""
    mean: float = 0.0
    """Mean [nat]; 0 is as declared."""


@dataclass(frozen=True, kw_only=True)
class ForceEvidence:
    """Evidence about (s, log c) in information form."""

    precision: Float[np.ndarray, "n n"]
    """Precision of s."""
    cross: Float[np.ndarray, " n"]
    """Precision between s and log c."""
    own: float
    """Precision of log c, with its prior."""
    shift: Float[np.ndarray, " n"]
    """Information vector of s."""
    own_shift: float
    """Information of log c."""

    @classmethod
    def of(
        cls, forces: StackedForces, s: Float[np.ndarray, " n"], log_factor: float, *, before: "LogFactor"
    ) -> "ForceEvidence":
        """Linearise the forces at s and log c.

        Args:
            forces: of all frames.
            s: bounded stiffnesses [1].
            log_factor: log c [nat].
            before: log c before these forces.
        """
        factor = np.exp(log_factor)
        root = np.linalg.inv(np.linalg.cholesky(forces.covariance(factor)))
        elastic = factor * forces.elastic(s)
        target = forces.pull - forces.loads - elastic + factor * forces.dE_ds @ s + elastic * log_factor
        columns = np.concatenate([factor * forces.dE_ds, elastic[..., None], target[..., None]], axis=2)
        whitened, shared = (np.concatenate(root @ part) for part in (columns, forces.offsets()))
        among = np.linalg.cholesky(np.eye(shared.shape[1]) + shared.T @ shared)
        explained = np.linalg.solve(among, shared.T @ whitened)
        products = whitened.T @ whitened - explained.T @ explained
        return cls(
            precision=products[:-2, :-2],
            cross=products[:-2, -2],
            own=float(products[-2, -2]) + before.sd**-2,
            shift=products[:-2, -1],
            own_shift=float(products[-2, -1]) + before.mean * before.sd**-2,
        )

    @classmethod
    def of_factor(cls, known: LogFactor, n: int) -> "ForceEvidence":
        """Return evidence about log c alone, and nothing about n stiffnesses."""
        nothing, own = np.zeros(n), known.sd**-2
        return cls(precision=np.zeros((n, n)), cross=nothing, own=own, shift=nothing, own_shift=known.mean * own)

    @property
    def marginal(self) -> GaussianInformation:
        """Evidence about s alone."""
        return GaussianInformation(
            precision=self.precision - np.outer(self.cross, self.cross) / self.own,
            shift=self.shift - self.cross * self.own_shift / self.own,
        )

    def given(
        self, mean: Float[np.ndarray, " n"], covariance: Float[np.ndarray, "n n"]
    ) -> tuple[float, float, Float[np.ndarray, " n"]]:
        """Return mean and standard deviation of log c and its covariance with s, for a posterior that holds this."""
        slope = -self.cross / self.own
        with_s = covariance @ slope
        return float(self.own_shift / self.own + slope @ mean), float((1 / self.own + slope @ with_s) ** 0.5), with_s


def fitted(
    forces: StackedForces, precision: Float[np.ndarray, "n n"], shift: Float[np.ndarray, " n"], *, before: LogFactor
) -> tuple[ForceEvidence, float]:
    """Return the evidence of forces, linearised where it and all else agree best, and log c there.

    Args:
        forces: of all frames.
        precision: precision of s by all else.
        shift: information vector of s by all else.
        before: log c before these forces.
    """
    s, log_factor = np.linalg.solve(precision, shift), before.mean
    evidence = ForceEvidence.of(forces, s, log_factor, before=before)
    for _ in range(STEPS):
        marginal = evidence.marginal
        s = np.linalg.solve(precision + marginal.precision, shift + marginal.shift)
        found = (evidence.own_shift - evidence.cross @ s) / evidence.own
        step = np.clip(found - log_factor, -MAX_STEP, MAX_STEP)
        log_factor = float(np.clip(log_factor + step, -MAX_LOG_FACTOR, MAX_LOG_FACTOR))
        evidence = ForceEvidence.of(forces, s, log_factor, before=before)
    return evidence, log_factor


def innovations(
    forces: StackedForces, mean: Float[np.ndarray, " n"], covariance: Float[np.ndarray, "n n"], *, factor: float
) -> tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, "t 3 3"]]:
    """Return the measured less the predicted forces of frames on the tissue [N], and their covariances [N^2].

    Args:
        forces: of all frames.
        mean: mean of s.
        covariance: covariance of s.
        factor: c [1].
    """
    spread = factor**2 * forces.dE_ds @ covariance @ np.swapaxes(forces.dE_ds, 1, 2)
    return forces.pull - forces.loads - factor * forces.elastic(mean), forces.total_covariance(factor) + spread
