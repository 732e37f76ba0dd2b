"""Times of frames and of the tool's reports: exact integers in nanoseconds, checked for plausibility.

Times are subtracted as integers, so that nanoseconds since 1970 lose nothing.
"""

import itertools
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from jaxtyping import Shaped

from ..errors import RecordingError
from ..recording.schemas import NS_PER_S
from .units import TIME_UNITS

MIN_PERIOD, MAX_PERIOD = 1e-4, 3600.0
"""Median time from frame to frame that is accepted [s]: 10 kHz cameras, and one frame an hour."""
USUAL_PERIOD = (2e-4, 10.0)
"""The same where `time_unit` is not stated [s]: outside it, ms or us called s are likelier than slow frames."""
LIKELY_PERIOD = (5e-4, 10.0)
"""The same in which a unit is offered as a cure [s]: cameras of 2 kHz to one frame in ten seconds."""
MAX_SPAN = 366 * 86400.0
"""Longest recording [s]: a year. A longer one has a wrong stamp, such as one frame at 0 and the next since 1970."""
GAP_PERIODS = 5
"""A gap is said where a frame comes later than so many median periods after the one before."""


@dataclass(frozen=True, kw_only=True)
class FrameClock:
    """Times and runs of the frames."""

    times: list[int]
    """Time of each frame, from the first one [ns]."""
    runs: list[int]
    """Number of each frame's run, from 1."""
    run_values: list[int]
    """Value of each frame in the array of runs; 0 without one."""
    began: list[int]
    """Time at which each frame's run began [ns]."""
    origin: int
    """Time of the first frame on the clock of the data [ns]; 0 where the data have no times."""
    notes: list[str]
    """Gaps, a line each."""

    @property
    def names_runs(self) -> str:
        """Return the values of the runs, for errors."""
        return ", ".join(str(value) for value in dict.fromkeys(self.run_values))


def frame_clock(
    *,
    count: int,
    period: int | None,
    times: Shaped[np.ndarray, "..."] | None,
    unit: int | None,
    runs: Shaped[np.ndarray, "..."] | None,
) -> FrameClock:
    """Return the clock of the frames.

    Args:
        count: number of frames.
        period: time from frame to frame [ns]; None where there are times.
        times: the array of times; None for a constant period.
        unit: nanoseconds in one unit of the times; None where recording.toml does not state it, which means seconds.
        runs: the array of runs; None for one run.

    Raises:
        RecordingError: an array has another shape, times do not increase, or they are implausible in their unit.
    """
    for name, array in (("times", times), ("runs", runs)):
        if array is not None and array.shape != (count,):
            raise RecordingError(
                f"[points] {name} must have one entry for each of the {count} frames; it has shape {array.shape}."
            )
    if times is None:
        assert period is not None
        absolute = [number * period for number in range(count)]
    else:
        absolute = absolute_times(times, unit or NS_PER_S, "[points] times")
        _refuse_implausible(times, absolute, unit)
    values = [0] * count if runs is None else _run_values(runs)
    first = np.append(True, np.diff(values) != 0)
    started = np.maximum.accumulate(np.where(first, np.arange(count), 0))
    relative = [time - absolute[0] for time in absolute]
    return FrameClock(
        times=relative,
        runs=np.cumsum(first).tolist(),
        run_values=values,
        began=[relative[number] for number in started],
        origin=0 if times is None else absolute[0],
        notes=_gaps(relative, first.tolist()),
    )


def absolute_times(times: Shaped[np.ndarray, " t"], unit: int, name: str) -> list[int]:
    """Return times as whole nanoseconds on their own clock.

    Raises:
        RecordingError: they are not finite, or do not increase.
    """
    if times.dtype.kind == "b" or not np.isfinite(times.astype(float)).all():
        raise RecordingError(f"{name} must be finite numbers.")
    if times.dtype.kind in "iu":
        absolute = [int(time) * unit for time in times]
    else:
        absolute = [round(Fraction(float(time)) * unit) for time in times]
    for number, (before, after) in enumerate(itertools.pairwise(absolute), start=1):
        if not before < after:
            short = times.dtype.kind == "f" and times.dtype.itemsize < 8
            cure = f"; {times.dtype} is too short for such times: store 64 bits" if short else ""
            raise RecordingError(
                f"{name} must increase; entry {number} is {times[number]!s} after {times[number - 1]!s}{cure}."
            )
    return absolute


def _refuse_implausible(times: Shaped[np.ndarray, " t"], absolute: list[int], unit: int | None) -> None:
    if len(absolute) < 2:
        return
    factor = unit or NS_PER_S
    stated = next(name for name, each in TIME_UNITS.items() if each == factor)
    periods = [after - before for before, after in itertools.pairwise(absolute)]
    median = sorted(periods)[len(periods) // 2] / NS_PER_S
    low, high = USUAL_PERIOD if unit is None else (MIN_PERIOD, MAX_PERIOD)
    span = (absolute[-1] - absolute[0]) / NS_PER_S
    if low <= median <= high and span <= MAX_SPAN:
        return
    if low <= median <= high:
        at = max(range(len(periods)), key=periods.__getitem__)
        raise RecordingError(
            f"[points] times span {span / MAX_SPAN:.3g} years; from frame {at} to frame {at + 1} they go from "
            f"{times[at]!s} to {times[at + 1]!s}: correct that stamp."
        )
    in_unit = median * NS_PER_S / factor
    fitting = [
        name
        for name, each in TIME_UNITS.items()
        if name != stated and LIKELY_PERIOD[0] <= in_unit * each / NS_PER_S <= LIKELY_PERIOD[1]
    ]
    cures = [f'time_unit = "{name}"' for name in fitting]
    if unit is None and MIN_PERIOD <= median <= MAX_PERIOD:
        cures.append(f'time_unit = "{stated}" if it is right')
    raise RecordingError(
        f"[points] times in {stated} give a frame every {median:.4g} s; {low:g} to {high:g} s is expected: give "
        f"{' or '.join(cures) or 'times in s, ms, us or ns, and time_unit'}."
    )


def _run_values(runs: Shaped[np.ndarray, " t"]) -> list[int]:
    if not np.isfinite(runs.astype(float)).all() or not np.array_equal(runs, np.round(runs.astype(float))):
        raise RecordingError("[points] runs must hold whole numbers.")
    return [int(value) for value in runs]


def _gaps(times: list[int], first: list[bool]) -> list[str]:
    """Return a line that names the largest gap within a run, where there is one."""
    periods = [after - before for before, after in itertools.pairwise(times)]
    inside = {number: period for number, period in enumerate(periods) if not first[number + 1]}
    if not inside:
        return []
    median = sorted(inside.values())[len(inside) // 2]
    gaps = {number: period for number, period in inside.items() if period > GAP_PERIODS * median}
    if not gaps:
        return []
    at = max(gaps, key=gaps.__getitem__)
    return [
        f"{len(gaps)} gap{'s' if len(gaps) > 1 else ''} in the frames: the longest, {gaps[at] / NS_PER_S:.3g} s, comes "
        f"after frame {at} (median period {median / NS_PER_S:.3g} s)"
    ]
