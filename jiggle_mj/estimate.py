"""Results of the estimator: one `Estimate` per frame over a fixed set of particles, and the final belief."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """The particles of the estimator, fixed after the first observation."""

    rest: Float[np.ndarray, "n 3"]
    """Rest positions of the particles [m]."""
    faces: Int[np.ndarray, "f 3"]
    """Particle numbers of each triangle, from 0."""


@dataclass(frozen=True, kw_only=True)
class PointNoise:
    """The noise of a coordinate of a measured point that the estimator counts with."""

    sd: float
    """Standard deviation of the part that is independent from point to point [m]."""
    smooth_sd: float
    """Standard deviation of the part that neighbours share [m]; 0 for none."""
    smooth_length: float | None
    """Distance at rest over which that part correlates by exp(-1/2) [m]; None for none."""
    source: Literal["stated", "measured", "assumed"]
    """Whether the recording states it, frames at rest show more than it states, or nothing is known."""
    stated_sd: float | None
    """Standard deviation of both parts together as the recording states it [m]; None where it states none."""
    still_frames: int
    """Frames at rest from which it is measured; 0 where it is not."""

    @property
    def total_sd(self) -> float:
        """Return the standard deviation of both parts together [m]."""
        return math.hypot(self.sd, self.smooth_sd)


@dataclass(frozen=True, kw_only=True)
class ForceCheck:
    """The force on the tool as it was measured, beside what the sheet's shape predicts."""

    index: Int[np.ndarray, " t"]
    """Index of the observation of each row."""
    measured: Float[np.ndarray, "t 3"]
    """Measured force on the tool in the world, less what the sensor shows with open jaws [N]."""
    predicted: Float[np.ndarray, "t 3"]
    """The same by the shape and the declared membrane stiffness, from no measured force [N]."""
    sd: Float[np.ndarray, "t 3"]
    """Standard deviation of their difference [N]."""
    nis: float
    """Normalised innovation squared per component, at the declared stiffness; 1 where all is right."""
    scaled_nis: float
    """The same at the factor on all stiffnesses that fits best; see stiffness_factor."""
    used: bool
    """Whether the force is part of the estimate."""
    why_not: str | None
    """Why it is not; None where it is."""
    stiffness_factor: float | None
    """True over declared membrane stiffness, by which every b is multiplied [1]; None where the force does not
    determine it, and b is relative to the declared one."""
    stiffness_factor_log_sd: float | None
    """Standard deviation of its logarithm [nat]."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """The belief after one observation."""

    index: int
    """Index of the observation."""
    time: int
    """Time of the observation [ns]."""
    positions: Float[np.ndarray, "n 3"]
    """Estimated positions of the particles in the world [m]."""
    observed: Float[np.ndarray, "n 3"]
    """Positions that perception measured [m]; NaN for a particle that is not seen."""
    mean: Float[np.ndarray, " n"]
    """Mean attachment stiffness b of each particle, constrained to be non-negative [N/m]."""
    sd: Float[np.ndarray, " n"]
    """Standard deviation of b [N/m]; NaN from a filter that computes none."""
    probability: Float[np.ndarray, " n"]
    """P(attached) of each particle; NaN from a filter that computes none."""
    held: Bool[np.ndarray, " n"]
    """Which particles the jaws hold."""
    entropy: float
    """Differential entropy of the belief [nat]."""
    nis: float
    """Normalised innovation squared per degree of freedom, before the update; 1 where the model is right."""
    boundary_energy: float
    """Mean energy in the attachments per particle, at the mean [J]."""
    update_s: float
    """Wall time of the filter update [s]."""
    perception_s: float
    """Wall time of perception [s]."""
    converged: bool = True
    """Whether the search for the positions converged; if not, trust the frame less."""


@dataclass(frozen=True, kw_only=True)
class KeptFrames:
    """What the filter keeps of its frames, so that they can be linearised again without the recording."""

    grasp: Int[np.ndarray, " f"]
    """Number of each frame's grasp, from 0 and rising."""
    x: Float[np.ndarray, "f n 3"]
    """Positions that were found [m]."""
    y: Float[np.ndarray, "f n 3"]
    """Positions by perception and grip together [m]; anything finite where there is no observation."""
    precision: Float[np.ndarray, "f n 3 3"]
    """Inverse covariance of each position, with all its noise [1/m^2]; zero where a particle is missing."""
    held: Bool[np.ndarray, "f n"]
    """Particles in the grip."""
    force_unknown: Bool[np.ndarray, "f n"]
    """Particles that the grip may pull at, the held ones included."""
    fields: Float[np.ndarray, "n m"] | None = None
    """The noise that neighbours share as fields, the same in all frames [m]; None where no noise is shared."""
    force_index: Int[np.ndarray, " p"]
    """Which of the frames have a measured force, rising."""
    pull: Float[np.ndarray, "p 3"]
    """Measured force of the tool on the tissue in these [N]."""
    pull_covariance: Float[np.ndarray, "p 3 3"]
    """Covariance of its noise [N^2]; NaN where it is not known."""
    offset_sd: Float[np.ndarray, " p"]
    """Standard deviation of each component of the sensor's offset [N]; NaN where it is not known."""
    offset_number: Int[np.ndarray, " p"]
    """Number of that offset, whose error those of the same number share."""

    @property
    def nbytes(self) -> int:
        """Return the memory of the arrays [byte]."""
        return sum(array.nbytes for array in vars(self).values() if array is not None)


@dataclass(frozen=True, kw_only=True)
class Belief:
    """Gaussian over all attachments: over their stiffness b [N/m], or over the bounded s = b / (b + reference)."""

    mean: Float[np.ndarray, " n"]
    """Mean of b, before the constraint b >= 0 [N/m], or of s."""
    covariance: Float[np.ndarray, "n n"]
    """Covariance of b [N^2/m^2], or of s."""
    reference: float | None = None
    """Stiffness b at which s = 1/2 [N/m]; None where the Gaussian is over b."""
    lower: Float[np.ndarray, " n"] | None = None
    """Lower end of each particle's marginal 90 % credible interval of b [N/m]: 0 where b = 0 cannot be excluded. None
    where it is not computed, as for a Gaussian over b. Where P(attached) is small the mean of b may lie above the
    interval: most of the probability is at 0, and the mean is pulled up by the stiffnesses that are unlikely."""
    upper: Float[np.ndarray, " n"] | None = None
    """Upper end of that interval [N/m]; infinite where only a lower end is known."""

    def coordinate(self, b: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return stiffnesses b [N/m] in the variable of the Gaussian, b or s; infinity is a weld."""
        if self.reference is None:
            return b
        finite = np.where(np.isinf(b), 0.0, b)
        return np.where(np.isinf(b), 1.0, finite / (finite + self.reference))

    def deviation_of_sum(self, b: Float[np.ndarray, " n"], chosen: Bool[np.ndarray, " n"]) -> float:
        """Return the standard deviation of the sum of b over the chosen particles, linearised at b [N/m]."""
        db_ds = np.ones_like(b) if self.reference is None else (b + self.reference) ** 2 / self.reference
        return float(np.sqrt(db_ds[chosen] @ self.covariance[np.ix_(chosen, chosen)] @ db_ds[chosen]))


@dataclass(frozen=True, kw_only=True)
class Detection:
    """The particles that are reported attached, and the rule that decides it."""

    attached: Bool[np.ndarray, " n"]
    """Which particles are reported attached."""
    score: Float[np.ndarray, " n"]
    """Score that ranks the particles, for the average precision; P(attached) where `probabilistic`."""
    stiffness: Float[np.ndarray, " n"]
    """Estimate of b that belongs to the score [N/m]."""
    stiffness_sd: Float[np.ndarray, " n"]
    """Standard deviation of that estimate [N/m]; NaN where none is computed."""
    probabilistic: bool = False
    """Whether the score is P(attached)."""
    rule: str
    """The rule in words, with its numbers; it never depends on the scene's true stiffness."""
    converged: bool = True
    """Whether both halves of the samples of the belief agree; where they do not, more samples would give other
    probabilities. True where nothing was sampled."""
    force_sd_ratio: float | None = None
    """Learned standard deviation of the model's force error over the configured one, at least 1; None where it is not
    learned."""
    position_sd_ratio: float | None = None
    """Learned standard deviation of the positions over the given one, at least 1; None where it is not learned."""
