"""What joins the tool's motion to that of the points that it holds: other axes, another unit, another clock.

The jaws carry the held points, so the same motion is measured twice. Within a grasp both move alike; over several
grasps the tool is, to a few millimetres, where the held points are. A wrong frame, unit or clock fits both far better
than what was recorded.
"""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from .held_motion import HeldMotion, centred, rms

APART = 0.5
"""Difference of tool and held points, over their motion, that is doubted and deserves an explanation. A rotation by 29
degrees gives it. Above 1 they do not move together: a tool that turns or slips still pulls its own way."""
EXPLAINED = 0.25
"""Share of the difference, and of the motion, that an explanation may leave."""
UNIT_FACTORS = (1e3, 1e2, 10.0, 25.4, 0.1, 1e-2, 1e-3, 1 / 25.4)
"""Held over reported motion where the tool has another unit: between um, mm, cm, dm, m, and inch."""
LEAST_FRAMES = 8
"""Frames with held points below which no clock is fitted: a fit of two numbers to fewer says little."""
CLOCK_EXPLAINED = 0.5
"""Share of the difference that another clock may leave. With 8 frames, a quarter of the squares is left by chance
with a probability below 1e-6."""
BEYOND_LINEAR = 0.7
"""The same, of what the best linear map of the motion leaves: a scale, a turn or a slip is no clock."""
LEAST_SHIFT_S = 0.02
"""Shift that is named [s]: images and tool are paired within 5 ms, and exposure takes some more."""
LEAST_DRIFT = 3e-3
"""Drift that is named: quartz clocks differ by less than 1e-4, frame rates of 29.97 and 30 by 1e-3."""
SEARCHED_S, SEARCHED_PERIODS, SEARCHED_DRIFT = 2.0, 3.0, 0.1
"""Largest shift that is tried [s, median periods], and largest drift."""
N_SHIFTS, N_DRIFTS = 100, 20
"""Steps of the search on each side of 0: of a shift alone, and of shift and drift together; it is then refined three
times around the best. A shift of 2 s is searched in steps of 20 ms, since tools move fast from grasp to grasp."""


@dataclass(frozen=True, kw_only=True)
class FrameFit:
    """The tool's motion in other axes, or in another unit, that is the held points'."""

    axes: Float[np.ndarray, "3 3"]
    """Rotation or reflection from the tool's axes to those of the points."""
    factor: float
    """Held over reported motion."""
    before: float
    """Difference of tool and held points as they are [m]."""
    after: float
    """Difference once axes and unit are changed [m]."""


@dataclass(frozen=True, kw_only=True)
class ClockFit:
    """The tool's clock at which tool and held points move together."""

    late: float
    """By how much the tool's reports come late at the first closed frame [s]; negative: early."""
    drift: float
    """Seconds that the tool's clock gains in a second of the frames'."""
    before: float
    """Difference of tool and held points as they are [m]."""
    after: float
    """Difference with that clock [m]."""


def frame_fit(track: HeldMotion, *, noise: float) -> FrameFit | None:
    """Return axes and unit that explain how tool and held points differ; None where none clearly does.

    Args:
        track: tool and held points.
        noise: motion that is noise [m].
    """
    tool, held, grasps = track.tool, track.held, track.grasps
    if len(tool) < 2:
        return None
    centrings = [(centred(tool, groups), centred(held, groups)) for groups in (grasps, np.zeros_like(grasps))]
    centrings = [(p, q) for p, q in centrings if rms(q) > noise]
    if not centrings:
        return None

    def residual(axes: Float[np.ndarray, "3 3"], factor: float) -> list[float]:
        return [rms(q - factor * p @ axes.T) for p, q in centrings]

    signals, before = [rms(q) for _, q in centrings], residual(np.eye(3), 1.0)
    candidates = [(axes, factor, residual(axes, factor)) for axes, factor in _candidates(centrings)]
    costs = [sum((after / signal) ** 2 for after, signal in zip(each[2], signals, strict=True)) for each in candidates]
    # The first is the simplest one; of pure lifts, say, all rotations about the vertical are equally good.
    chosen = next(each for each, cost in zip(candidates, costs, strict=True) if cost <= 2 * min(costs) + EXPLAINED**3)
    if any(after > max(was, EXPLAINED * signal) for was, after, signal in zip(before, chosen[2], signals, strict=True)):
        return None  # what makes motion within a grasp alike may not carry the tool away from what it holds
    for was, after, signal in zip(before, chosen[2], signals, strict=True):
        if was >= APART * signal and after <= EXPLAINED * min(was, signal):
            return FrameFit(axes=chosen[0], factor=chosen[1], before=was, after=after)
    return None


def signed_axes() -> list[Float[np.ndarray, "3 3"]]:
    """Return all 48 ways to swap and reverse axes, the identity first and those that move fewer axes before others."""
    ways = [
        np.diag(np.array(signs, float))[list(order)]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1, -1), repeat=3)
    ]
    return sorted(ways, key=lambda axes: (np.sum(np.diag(axes) == 0), np.sum(axes < 0)))


def _candidates(
    centrings: list[tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]],
) -> Iterator[tuple[Float[np.ndarray, "3 3"], float]]:
    """Yield axes and factors, the simplest ones first: another unit, other axes, both, any rotation."""
    ways = signed_axes()
    yield from ((ways[0], factor) for factor in (1.0, *UNIT_FACTORS))
    yield from ((axes, 1.0) for axes in ways[1:])
    yield from itertools.product(ways[1:], UNIT_FACTORS)
    for tool, held in centrings:
        if np.linalg.matrix_rank(tool, tol=EXPLAINED * np.linalg.norm(tool)) >= 2:
            yield Rotation.align_vectors(held, tool)[0].as_matrix(), 1.0


def clock_fit(track: HeldMotion, *, noise: float) -> ClockFit | None:
    """Return the clock of the tool at which tool and held points move together; None where none is clearly better.

    Args:
        track: tool and held points.
        noise: difference that is noise [m].
    """
    times, grasps, held = track.times, track.grasps, centred(track.held, track.grasps)
    if len(times) < LEAST_FRAMES:
        return None
    path_times, path = track.path()

    def residual(late: float, drift: float) -> float:
        at = times + late + drift * (times - times[0])
        tool = np.stack([np.interp(at, path_times, path[:, k]) for k in range(3)], axis=1)
        return rms(held - centred(tool, grasps))

    before = residual(0.0, 0.0)
    if before <= noise:
        return None
    span = max(SEARCHED_S, SEARCHED_PERIODS * float(np.median(np.diff(times))))
    late, drift = _search(residual, span, 0.0)
    after = residual(late, drift)
    drifted = _search(residual, span, SEARCHED_DRIFT) if after > noise else (late, drift)
    if residual(*drifted) <= CLOCK_EXPLAINED * after and abs(drifted[1]) >= LEAST_DRIFT:
        late, drift = drifted
        after = residual(late, drift)
    elif abs(late) < LEAST_SHIFT_S:
        return None
    linear = np.linalg.lstsq(centred(track.tool, grasps), held, rcond=1e-6)[0]
    unexplained = rms(held - centred(track.tool, grasps) @ linear)
    if after > min(CLOCK_EXPLAINED * before, BEYOND_LINEAR * unexplained):
        return None
    return ClockFit(late=late, drift=drift, before=before, after=after)


def _search(residual: Callable[[float, float], float], span: float, drift_span: float) -> tuple[float, float]:
    """Return shift [s] and drift with the least difference, on grids that become finer."""
    late, drift = 0.0, 0.0
    n_shifts, n_drifts = (N_DRIFTS, N_DRIFTS) if drift_span else (N_SHIFTS, 0)
    for _ in range(4):
        shifts = late + span * np.arange(-n_shifts, n_shifts + 1) / n_shifts
        drifts = drift + drift_span * np.arange(-n_drifts, n_drifts + 1) / max(n_drifts, 1)
        late, drift = min(itertools.product(shifts.tolist(), drifts.tolist()), key=lambda each: residual(*each))
        span, drift_span = 2 * span / n_shifts, 2 * drift_span / max(n_drifts, 1)
    return late, drift
