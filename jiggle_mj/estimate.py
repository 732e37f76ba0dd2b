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
    """Its standard deviation [N/m]."""
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


@dataclass(frozen=True, kw_only=True)
class Belief:
    """Gaussian over the attachment stiffnesses, before the non-negativity constraint."""

    mean: Float[np.ndarray, " n"]
    """[N/m]."""
    covariance: Float[np.ndarray, "n n"]
    """[N^2/m^2]."""


@dataclass(frozen=True, kw_only=True)
class Detection:
    """Which particles are called attached, and by what rule."""

    attached: Bool[np.ndarray, " n"]
    score: Float[np.ndarray, " n"]
    """Ranks the particles, for the average precision."""
    rule: str
    """In words, with its numbers; never depends on the scene's true stiffness."""
