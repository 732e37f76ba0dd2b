"""The noise of positions, and how far it is the same for neighbours, from frames in which all is still.

White noise on each point, and a smooth field of it over the sheet,

    cov(n_i, n_j) = sd^2 [i = j] + smooth_sd^2 exp(-|a_i - a_j|^2 / 2 length^2)

for each coordinate alike. From one frame to the next, so that what drifts or jumps does not count; and never from what
a fit leaves over: that holds the effects that are looked for.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

PAIRS = 20_000
"""Pairs of points whose covariance is looked at."""
LENGTHS = np.geomspace(2e-3, 5e-2, 40)
"""Ranges that are tried [m]."""
MOST_SMOOTH = 0.95
"""Largest share of the variance that the smooth part may be."""
MODES = 45
"""Most smooth fields that the smooth part is made of."""
KEPT = 0.97
"""Share of the smooth part's variance that they hold; the rest counts as white."""
FEWEST = 5
"""Still frames from which noise is measured."""
JUMP = 4.0
"""Times the usual square of a difference, beyond which something else has happened between two frames."""


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
        m = min(int(np.searchsorted(np.cumsum(values), KEPT * values.sum())) + 1, MODES, len(rest))
        left = 1 - values[:m].sum() / values.sum()
        fields = np.zeros((len(rest), MODES))
        fields[:, :m] = self.smooth_sd * vectors[:, :m] * np.sqrt(values[:m])
        return fields, float(np.sqrt(self.sd**2 + left * self.smooth_sd**2))


def measure(
    positions: Float[np.ndarray, "frames n 3"], rest: Float[np.ndarray, "n 3"], *, seed: int = 0
) -> StillNoise | None:
    """From the same points in frames in which nothing moves; NaN where one is not seen. None if there are too few."""
    seen = np.isfinite(positions).all(axis=(0, 2))
    frames = len(positions)
    if frames < FEWEST or seen.sum() < 3:
        return None
    off = np.diff(positions[:, seen], axis=0) / np.sqrt(2)
    squares = np.mean(off**2, axis=(1, 2))
    off = off[squares <= JUMP * np.median(squares)]
    total = float(np.mean(off**2))
    i, j = np.random.default_rng(seed).integers(0, int(seen.sum()), (2, PAIRS))
    i, j = i[i != j], j[i != j]
    apart = np.sum((rest[seen][i] - rest[seen][j]) ** 2, axis=1)
    together = np.mean(off[:, i] * off[:, j], axis=(0, 2))
    best = (np.inf, 0.0, float(LENGTHS[0]))
    for length in LENGTHS:
        kernel = np.exp(-0.5 * apart / length**2)
        amplitude = max(float(kernel @ together / (kernel @ kernel)), 0.0)
        best = min(best, (float(np.sum((together - amplitude * kernel) ** 2)), amplitude, float(length)))
    smooth = min(best[1], MOST_SMOOTH * total)
    return StillNoise(sd=np.sqrt(total - smooth), smooth_sd=np.sqrt(smooth), length=best[2], frames=frames)
