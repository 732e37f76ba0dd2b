"""Displacements that may be those from the frame before, and not from rest, by how they change over the frames.

Positions of a pull are continuous: no step is as large as the whole displacement. Differences of positions are not:
they begin at their full size, and their noise alternates; it is their sum that is continuous. A sheet that is shown at
rest and then held, or one that swings within few frames, looks the same, so this is a reason to doubt, not to refuse.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

MIN_FRAMES = 8
"""Frames from which displacements are judged: fewer may hold a pull in two steps."""
MIN_POINTS = 12
"""Points seen throughout from which neighbours tell noise from motion."""
LEADING_SHARE, MIN_LEADING = 0.1, 4
"""Share of the points that lead, those that go farthest, and their least number."""
JUMPS = 0.8
"""Largest step of the leading points, over their largest displacement, from which they jump. Measured from rest: 0.03
to 0.37; differences of the same: 0.56 to 1.8."""
SUM_MOVES = 0.4
"""The same of the sums of displacements, up to which these are continuous."""
N_NEIGHBOURS = 6
"""Neighbours whose mean displacement is taken off to leave noise: those around a point in a lattice."""
CLEAR = 5.0
"""Displacement of the leading points above which it is motion [standard deviations of a step of the noise]."""
ALTERNATES = -0.55
"""Correlation of steps of the noise with the next ones, below which these are differences of differences: -1/2 for
independent noise, more where it lasts, -2/3 for differences of independent noise."""
SAMPLING = 4.0
"""How far below -1/2 it must be as well, times the root of the number of products: five standard deviations."""
MAD_TO_SD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


def doubt_increments(positions: Float[np.ndarray, "t n 3"]) -> list[str]:
    """Return a line where positions, to which displacements were added, move as those from frame to frame would.

    Args:
        positions: of all frames in any unit, NaN where unseen.
    """
    moved = positions - positions[0]
    seen = np.isfinite(moved).all(axis=(0, 2))
    if len(positions) < MIN_FRAMES or seen.sum() < MIN_POINTS:
        return []
    moved = moved[:, seen]
    leading = _leading(moved)
    jump = _jump(leading)
    if jump < JUMPS or _jump(_leading(np.cumsum(moved, axis=0))) > SUM_MOVES:
        return []
    near = np.asarray(KDTree(positions[0][seen]).query(positions[0][seen], k=N_NEIGHBOURS + 1)[1])[:, 1:]
    noise_steps = np.diff((moved - moved[:, near].mean(axis=2))[1:], axis=0)
    size = MAD_TO_SD * float(np.median(np.abs(noise_steps)))
    if np.linalg.norm(leading, axis=1).max() <= CLEAR * size and not _alternates(noise_steps):
        return []
    return [
        "WARNING: are the displacements those from the frame before? In one frame the points that move most go "
        f"{jump:.0%} of their largest displacement, and the sums over the frames move steadily: then sum them up, or "
        "export them relative to the reference"
    ]


def _leading(moved: Float[np.ndarray, "t m 3"]) -> Float[np.ndarray, "t 3"]:
    """Return the mean displacement of the points that go farthest."""
    farthest = np.linalg.norm(moved, axis=2).max(axis=0)
    n_leading = max(int(LEADING_SHARE * len(farthest)), MIN_LEADING)
    return moved[:, np.argsort(farthest)[-n_leading:]].mean(axis=1)


def _jump(moved: Float[np.ndarray, "t 3"]) -> float:
    """Return the largest step away from rest over the largest displacement; 0 where nothing moves.

    Where the jaws let go, a sheet returns in one step.
    """
    away = np.linalg.norm(moved, axis=1)
    largest = float(away.max())
    steps = np.where(np.diff(away) > 0, np.linalg.norm(np.diff(moved, axis=0), axis=1), 0.0)
    return float(steps.max()) / largest if largest else 0.0


def _alternates(steps: Float[np.ndarray, "s m 3"]) -> bool:
    """Return whether steps are followed by opposite ones more than those of independent noise are."""
    before, after = steps[:-1], steps[1:]
    size = float(np.sqrt(np.square(before).sum() * np.square(after).sum()))
    limit = min(ALTERNATES, -0.5 - SAMPLING / before.size**0.5)
    return size > 0 and float((before * after).sum()) < limit * size
