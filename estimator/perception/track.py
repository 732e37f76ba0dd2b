"""What any way of seeing hands to the filter: one frame's measurement of the particles."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from jiggle_mj.errors import PerceptionError

UNSEEN_VARIANCE = 1.0
"""Variance of a coordinate of a particle that was not seen: as good as unknown [m^2]."""


@dataclass(frozen=True, kw_only=True)
class Track:
    """One frame's measurement of the particles."""

    positions: Float[np.ndarray, "n 3"]
    """World [m]; NaN where unseen."""
    covariance: Float[np.ndarray, "n 3 3"]
    """[m^2]; `UNSEEN_VARIANCE` on the diagonal where unseen."""
    visible: Bool[np.ndarray, " n"]
    uvd: Float[np.ndarray, "n 3"] | None = None
    """Left rectified pixel and disparity [px], the best guess where unseen; None without images."""

    @classmethod
    def of_nothing(cls, n: int) -> "Track":
        """Of a frame in which no particle was seen."""
        covariance = np.broadcast_to(UNSEEN_VARIANCE * np.eye(3), (n, 3, 3))
        return cls(positions=np.full((n, 3), np.nan), covariance=covariance, visible=np.zeros(n, bool))

    @cached_property
    def precision(self) -> Float[np.ndarray, "n 3 3"]:
        """Inverse covariance, 0 where unseen [1/m^2]."""
        return np.where(self.visible[:, None, None], np.linalg.inv(self.covariance), 0.0)

    def __post_init__(self) -> None:
        """Check the covariances."""
        rotated = self.covariance.transpose(0, 2, 1)
        symmetric = np.isclose(self.covariance, rotated, rtol=1e-6, atol=0).all(axis=(1, 2))
        definite = np.linalg.eigvalsh(self.covariance)[:, 0] > 0
        if not (symmetric & definite).all():
            bad = int(np.argmin(symmetric & definite))
            raise PerceptionError(
                f"the covariance of particle {bad} is not positive definite: {self.covariance[bad].tolist()} m^2."
            )
