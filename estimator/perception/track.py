"""The measurement of the particles in one frame, which every tracker returns and the filter takes."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Array, Bool, Float

from jiggle_mj.errors import PerceptionError

from .cloud_surface import Cloud

UNSEEN_VARIANCE = 1.0
"""Variance of a coordinate of an unseen particle [m^2]: far above the size of any sheet."""
SYMMETRY_TOLERANCE = 1e-6
"""Largest relative difference between a covariance and its transpose: rounding of the products that made it."""


@dataclass(frozen=True, kw_only=True)
class Track:
    """Measurement of the particles in one frame."""

    positions: Float[np.ndarray, "n 3"]
    """World positions [m]; NaN where unseen."""
    covariance: Float[np.ndarray, "n 3 3"]
    """Covariance of each position [m^2]; `UNSEEN_VARIANCE` on the diagonal where unseen."""
    visible: Bool[np.ndarray, " n"]
    """Which particles are seen."""
    fields: Float[Array, "n modes"] | None = None
    """The part of the noise that neighbours share, as fields of unit amplitude, the same for each coordinate [m]; the
    covariance holds it too. One array serves all frames of a recording. None where none is known."""
    cloud: Cloud | None = None
    """A cloud that the filter matches to its own state, which alone says which particles are seen; None for none."""
    uvd: Float[np.ndarray, "n 3"] | None = None
    """Left rectified pixel and disparity [px], an estimate where unseen; None without images."""

    @classmethod
    def of_nothing(cls, n: int, cloud: Cloud | None = None) -> "Track":
        """Return the track of a frame in which no particle is seen, or none yet."""
        covariance = np.broadcast_to(UNSEEN_VARIANCE * np.eye(3), (n, 3, 3))
        return cls(positions=np.full((n, 3), np.nan), covariance=covariance, visible=np.zeros(n, bool), cloud=cloud)

    @cached_property
    def precision(self) -> Float[np.ndarray, "n 3 3"]:
        """Return the inverse covariances, 0 where unseen [1/m^2]."""
        return np.where(self.visible[:, None, None], np.linalg.inv(self.covariance), 0.0)

    @cached_property
    def white_precision(self) -> Float[np.ndarray, "n 3 3"]:
        """Return the inverse covariances without the noise that neighbours share, 0 where unseen [1/m^2]."""
        if self.fields is None:
            return self.precision
        shared = np.sum(np.asarray(self.fields) ** 2, axis=1)[:, None, None] * np.eye(3)
        shared = np.where(self.visible[:, None, None], shared, 0.0)
        return np.where(self.visible[:, None, None], np.linalg.inv(self.covariance - shared), 0.0)

    def __post_init__(self) -> None:
        """Check that the covariances are symmetric and positive definite."""
        transposed = self.covariance.transpose(0, 2, 1)
        symmetric = np.isclose(self.covariance, transposed, rtol=SYMMETRY_TOLERANCE, atol=0).all(axis=(1, 2))
        definite = np.linalg.eigvalsh(self.covariance)[:, 0] > 0
        if not (symmetric & definite).all():
            bad = int(np.argmin(symmetric & definite))
            raise PerceptionError(
                f"the covariance of particle {bad} is not positive definite, or not symmetric: "
                f"{self.covariance[bad].tolist()} m^2."
            )
