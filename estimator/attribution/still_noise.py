"""The noise of positions, and how far it is the same for neighbours, from frames in which all is still.

White noise on each point, and a smooth field of it over the sheet,

    cov(n_i, n_j) = sd^2 [i = j] + smooth_sd^2 exp(-|a_i - a_j|^2 / 2 length^2)

for each coordinate alike. From one frame to the next, so that what drifts or jumps does not count; and never from what
a fit leaves over: that holds the effects that are looked for.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..perception.point_tracker import usual

PAIRS = 20_000
"""Pairs of points whose covariance is looked at."""
LENGTHS = np.geomspace(0.02, 0.5, 40)
"""Ranges that are tried, in extents of the sheet."""
MOST_SMOOTH = 0.95
"""Largest share of the variance that the smooth part may be."""
MODES, STEP = 45, 15
"""Most smooth fields that the smooth part is made of; filled up with zeros to a multiple, so that most recordings are
compiled for alike."""
KEPT, MATTERS = 0.97, 0.5
"""Share of the smooth part's variance that they hold, and the least variance along one, in units of the white part's;
the rest counts as white."""
FEWEST = 5
"""Still frames from which noise is measured."""
USUALLY = 0.9
"""Share of the frames in which a point must be seen."""
JUMP, RARELY = 4.0, 0.1
"""Times the usual square of a difference, beyond which something else has happened between two frames, and the largest
share of them for which that holds: what happens more often is noise."""


@dataclass(frozen=True, kw_only=True)
class StillNoise:
    """Of one coordinate of one point."""

    sd: float
    """White part [m]."""
    smooth_sd: float
    """Smooth part [m]."""
    length: float
    """Its range [m]."""
    frames: int
    """From how many frames; 0 if it was assumed."""

    def fields(self, rest: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n modes"], float]:
        """The smooth part as fields of unit amplitude [m], and the white part's sd with what they leave [m]."""
        squared = np.sum((rest[:, None] - rest[None]) ** 2, axis=2)
        values, vectors = np.linalg.eigh(np.exp(-0.5 * squared / self.length**2))
        values, vectors = np.maximum(values[::-1], 0), vectors[:, ::-1]
        enough = int(np.searchsorted(np.cumsum(values), KEPT * values.sum())) + 1
        matter = int(np.sum(values * self.smooth_sd**2 > MATTERS * self.sd**2))
        m = min(enough, matter, MODES)
        left = 1 - values[:m].sum() / values.sum()
        fields = np.zeros((len(rest), -(-m // STEP) * STEP))
        fields[:, :m] = self.smooth_sd * vectors[:, :m] * np.sqrt(values[:m])
        return fields, float(np.sqrt(self.sd**2 + left * self.smooth_sd**2))


def measure(
    series: list[Float[np.ndarray, "frames n 3"]], rest: Float[np.ndarray, "n 3"], *, seed: int = 0
) -> StillNoise | None:
    """From the same points in series of frames in which nothing moves; None if there are too few.

    NaN where one is not seen.
    """
    off = np.concatenate([np.zeros((0, *rest.shape)), *(np.diff(one, axis=0) for one in series)]) / np.sqrt(2)
    frames = len(off) + sum(len(one) > 1 for one in series)
    if frames < FEWEST:
        return None
    seen = np.isfinite(off).mean(axis=(0, 2)) > USUALLY
    off = off[np.isfinite(off[:, seen]).all(axis=(1, 2))][:, seen]
    if not len(off) or seen.sum() < 3:
        return None
    off = off[usual(np.mean(off**2, axis=(1, 2)), times=JUMP, rarely=RARELY)]
    total = float(np.mean(off**2))
    i, j = np.random.default_rng(seed).integers(0, int(seen.sum()), (2, PAIRS))
    i, j = i[i != j], j[i != j]
    apart = np.sum((rest[seen][i] - rest[seen][j]) ** 2, axis=1)
    together = np.mean(off[:, i] * off[:, j], axis=(0, 2))
    lengths = float(np.ptp(rest, axis=0).max()) * LENGTHS
    best = (np.inf, 0.0, float(lengths[0]))
    for length in lengths:
        kernel = np.exp(-0.5 * apart / length**2)
        amplitude = max(float(kernel @ together / (kernel @ kernel)), 0.0)
        best = min(best, (float(np.sum((together - amplitude * kernel) ** 2)), amplitude, float(length)))
    smooth = min(best[1], MOST_SMOOTH * total)
    return StillNoise(sd=np.sqrt(total - smooth), smooth_sd=np.sqrt(smooth), length=best[2], frames=frames)
