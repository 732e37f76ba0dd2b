"""Noise of observed positions, and its correlation between neighbours, from frames in which nothing moves.

It is white noise on each point, and a smooth field over the sheet,

    cov(n_i, n_j) = sd^2 [i = j] + smooth_sd^2 exp(-(|a_i - a_j| / length)^p / p)

the same for each coordinate, with p = 2 where it is measured. It is measured from differences of consecutive frames, so
that drifts and jumps do not count; and never from the residual of a fit, which holds the effects that are searched for.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from .robust import usual
from .smooth_modes import smooth_modes

N_PAIRS = 20_000
"""Random pairs of points from which the covariance is measured."""
LENGTHS = np.geomspace(0.02, 0.5, 40)
"""Ranges that are tried [extents of the sheet]."""
MAX_SMOOTH_SHARE = 0.95
"""Largest share of the variance that the smooth part may have."""
MAX_MODES = 45
"""Largest number of fields that represent the smooth part."""
MODE_MULTIPLE = 15
"""Fields are padded with zeros to a multiple of this number, so that one compilation serves most recordings."""
KEPT_VARIANCE = 0.97
"""Share of the smooth part's variance that the fields hold; the rest counts as white."""
MIN_MODE_VARIANCE = 0.5
"""Smallest variance of a field [variances of the white part]; the others count as white."""
SIGNIFICANT = 6.0
"""Variance of the smooth part above which it is one [standard errors of white noise, over the ranges that are tried]:
of white noise it is up to 5."""
MIN_FRAMES = 5
"""Smallest number of still frames from which noise is measured."""
MIN_OBSERVED = 0.9
"""Smallest share of the frames in which a point is observed, for it to be used."""
JUMP = 4.0
"""Mean squared difference of two frames, over the usual one, beyond which something else happened between them."""
MAX_JUMPS = 0.1
"""Largest share of such differences; what happens more often is noise."""
MIN_POINTS = 3
"""Smallest number of points from which noise is measured."""


@dataclass(frozen=True, kw_only=True)
class StillNoise:
    """Noise of one coordinate of one point."""

    sd: float
    """Standard deviation of the white part [m]."""
    smooth_sd: float
    """Standard deviation of the smooth part [m]."""
    length: float
    """Range of the smooth part [m]."""
    frames: int
    """Number of still frames; 0 if the noise is assumed."""
    exponent: float = 2.0
    """p of the smooth part's covariance: 2 for one range alone, 1 for all ranges down from `length`."""

    @property
    def total_sd(self) -> float:
        """Return the standard deviation of both parts together [m]."""
        return float(np.hypot(self.sd, self.smooth_sd))

    def fields(
        self, rest: Float[np.ndarray, "n 3"], measured: Bool[np.ndarray, " n"] | None = None, *, every: bool = False
    ) -> tuple[Float[np.ndarray, "n modes"], float]:
        """Return the smooth part as fields of unit amplitude [m], and the sd of the rest, white part included [m].

        Args:
            rest: rest positions of all particles [m].
            measured: particles at which anything is measured, all if None; the fields are 0 at the others.
            every: whether fields of less than `MIN_MODE_VARIANCE` are kept, as positions may drift along them.
        """
        measured = np.ones(len(rest), dtype=bool) if measured is None else measured
        if not self.smooth_sd or not measured.any():
            return np.zeros((len(rest), 0)), self.total_sd
        modes = smooth_modes(rest[measured], self.length, MAX_MODES, exponent=self.exponent)
        values = np.sum(modes**2, axis=0)
        enough = int(np.searchsorted(np.cumsum(values), KEPT_VARIANCE * len(modes))) + 1
        matter = int(np.sum(values * self.smooth_sd**2 > MIN_MODE_VARIANCE * self.sd**2))
        m = min(enough, len(values) if every else matter, len(values))
        rest_share = max(0.0, 1 - values[:m].sum() / len(modes))
        fields = np.zeros((len(rest), -(-m // MODE_MULTIPLE) * MODE_MULTIPLE))
        fields[measured, :m] = self.smooth_sd * modes[:, :m]
        return fields, float(np.sqrt(self.sd**2 + rest_share * self.smooth_sd**2))


def measure(
    series: list[Float[np.ndarray, "frames n 3"]], rest: Float[np.ndarray, "n 3"], *, seed: int = 0
) -> StillNoise | None:
    """Return the noise of points in series of frames without motion; None if there are too few.

    Args:
        series: positions [m], the same points in all; NaN where one is not observed.
        rest: rest shape [m].
        seed: of the random pairs.
    """
    difference = np.concatenate([np.zeros((0, *rest.shape)), *(np.diff(one, axis=0) for one in series)]) / np.sqrt(2)
    frames = len(difference) + sum(len(one) > 1 for one in series)
    if frames < MIN_FRAMES:
        return None
    seen = np.isfinite(difference).mean(axis=(0, 2)) > MIN_OBSERVED
    difference = difference[:, seen]
    difference = difference[np.isfinite(difference).any(axis=(1, 2))]
    if len(difference) + 1 < MIN_FRAMES or seen.sum() < MIN_POINTS:
        return None
    difference = difference[usual(np.nanmean(difference**2, axis=(1, 2)), times=JUMP, rarely=MAX_JUMPS)]
    total = float(np.nanmean(difference**2))
    i, j = _pairs(int(seen.sum()), seed)
    squared_distance = np.sum((rest[seen][i] - rest[seen][j]) ** 2, axis=1)
    covariance = np.nanmean(difference[:, i] * difference[:, j], axis=(0, 2))
    pair_error = total / np.sqrt(3 * len(difference))
    lengths = float(np.ptp(rest[seen], axis=0).max()) * LENGTHS
    best = (np.inf, 0.0, float(lengths[0]))
    for length in lengths:
        kernel = np.exp(-0.5 * squared_distance / length**2)
        if kernel @ kernel == 0:
            continue
        amplitude, error = float(kernel @ covariance / (kernel @ kernel)), pair_error / float(np.sqrt(kernel @ kernel))
        amplitude = amplitude if amplitude > SIGNIFICANT * error else 0.0
        best = min(best, (float(np.sum((covariance - amplitude * kernel) ** 2)), amplitude, float(length)))
    smooth = min(best[1], MAX_SMOOTH_SHARE * total)
    white, smooth = math.sqrt(total - smooth), math.sqrt(smooth)
    return StillNoise(sd=white, smooth_sd=smooth, length=best[2], frames=frames)


def _pairs(n: int, seed: int) -> tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]:
    """Return all pairs of n points, or `N_PAIRS` random ones if there are more."""
    if n * (n - 1) // 2 <= N_PAIRS:
        return np.triu_indices(n, 1)
    i, j = np.random.default_rng(seed).integers(0, n, (2, N_PAIRS))
    return i[i != j], j[i != j]
