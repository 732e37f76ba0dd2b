"""What the estimator says: one `Estimate` a frame over a fixed set of particles, and the belief at the end."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """The estimator's own particles, fixed after the first observation."""

    rest: Float[np.ndarray, "n 3"]
    """Rest positions [m]."""
    faces: Int[np.ndarray, "f 3"]


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """The belief after one observation."""

    index: int
    """The observation's index."""
    time: int
    """[ns]."""
    positions: Float[np.ndarray, "n 3"]
    """Where the particles are believed to be [m]."""
    observed: Float[np.ndarray, "n 3"]
    """Where perception saw them [m]; NaN where it did not."""
    mean: Float[np.ndarray, " n"]
    """Mean attachment stiffness, constrained to be non-negative [N/m]."""
    sd: Float[np.ndarray, " n"]
    """Its standard deviation [N/m]; NaN from an estimator that states none."""
    probability: Float[np.ndarray, " n"]
    """P(attached); NaN from an estimator that states none."""
    held: Bool[np.ndarray, " n"]
    """Which particles are in the grip."""
    entropy: float
    """Differential entropy of the belief [nat]."""
    nis: float
    """Normalised innovation squared per degree of freedom, before the update."""
    boundary_energy: float
    """Mean energy in the attachments per particle, at the mean [J]."""
    update_s: float
    """Wall time of the filter's update [s]."""
    perception_s: float
    """Wall time of perception [s]."""
    converged: bool = True
    """Whether the search for the positions came to an end; if not, trust the frame less."""


@dataclass(frozen=True, kw_only=True)
class Belief:
    """Gaussian over all attachments: over their stiffness b [N/m], or bounded, over s = b / (b + reference)."""

    mean: Float[np.ndarray, " n"]
    """Of b, before the constraint b >= 0 [N/m], or of s."""
    covariance: Float[np.ndarray, "n n"]
    """Of b [N^2/m^2], or of s."""
    reference: float | None = None
    """The stiffness that s = 1/2 stands for [N/m]; None where the Gaussian is over b."""
    lower: Float[np.ndarray, " n"] | None = None
    """Lower end of each particle's own 90 % interval of b [N/m]: 0 where being free cannot be excluded. None where not
    stated, as for a Gaussian over b."""
    upper: Float[np.ndarray, " n"] | None = None
    """Its upper end [N/m]; infinite where only a lower end is known."""

    def coordinate(self, b: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Stiffnesses [N/m] in the Gaussian's own variable; infinity is a weld."""
        if self.reference is None:
            return b
        finite = np.where(np.isinf(b), 0.0, b)
        return np.where(np.isinf(b), 1.0, finite / (finite + self.reference))

    def deviation_of_sum(self, b: Float[np.ndarray, " n"], chosen: Bool[np.ndarray, " n"]) -> float:
        """Standard deviation of the sum of b over the chosen particles [N/m], around the estimate b."""
        slope = np.ones_like(b) if self.reference is None else (b + self.reference) ** 2 / self.reference
        return float(np.sqrt(slope[chosen] @ self.covariance[np.ix_(chosen, chosen)] @ slope[chosen]))


@dataclass(frozen=True, kw_only=True)
class Detection:
    """Which particles are called attached, and by what rule."""

    attached: Bool[np.ndarray, " n"]
    score: Float[np.ndarray, " n"]
    """Ranks the particles, for the average precision; a probability of being attached where `probabilistic`."""
    stiffness: Float[np.ndarray, " n"]
    """The estimate of b that belongs to it [N/m]."""
    stiffness_sd: Float[np.ndarray, " n"]
    """Its standard deviation [N/m]; NaN where none is stated."""
    probabilistic: bool = False
    rule: str
    """In words, with its numbers; never depends on the scene's true stiffness."""
    converged: bool = True
    """Whether both halves of the samples that the belief was judged by agree; where they do not, more of them would say
    something else. True where nothing was sampled."""
    force_sd_ratio: float | None = None
    """How many times the typed standard deviation of the model's force error the observations ask for, from 1 on; None
    where it is not learned."""
    position_sd_ratio: float | None = None
    """The same for the stated noise of the positions."""
