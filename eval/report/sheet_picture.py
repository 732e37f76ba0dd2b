"""One picture of a closed loop for the docs: the reported part on the sheet and the error of all frames over time.

Each row is a frame of the part that chose no effect, the median and the worst: observed positions, then predicted ones,
in the plane of the sheet at rest, coloured by their distance from rest. A line leads from each predicted position to
the observed one. Where nothing is named, there is one prediction by the physics and not two.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jiggle_mj.errors import RecordingError

from ..metrics.flat_map import plane_of
from .canvas import Canvas
from .discrepancy_page import AFTER, BEFORE, TRIVIAL, WITHOUT_MODEL

WIDTH, SHEET_ROW, SHEET_HEIGHT, TIME_ROW, TOP = 1000, 200, 140, 240, 44
"""Width of the picture; heights of a row of sheets, of a sheet, of the errors over time and of the title [px]."""
LEFT, RIGHT = 46, 60
"""Margins beside the panels; the right one holds the scale of colours [px]."""
GAP = 12
"""Gap between the panels of a row [px]."""
PANELS = {
    "observed": "observed",
    "before": "declared",
    "after": "with what is named",
    "with_remainder": "and the remainder",
}
"""Panels of a row, by the keys of positions in discrepancy.json."""
INK, FAINT, FITTED = "#1d2733", "#dfe4e9", "#f3f5f7"
"""Colours of text, of grid lines and of the ground behind fitted frames."""
DASHES = {"unmoved": 1.5, "last_frame": 7.0, "in_proportion": 3.5}
"""Length of the dashes of predictions without a model [px]."""
SMALLEST = 0.5
"""Smallest error on the axis [standard deviations of the noise]; smaller ones are drawn at its end."""
THIN, WIDE = 1.5, 3.0
"""Width of a curve, and of the one that another may cover [px]."""
SHORT = {"in_proportion": "in proportion"}
"""Shorter words for them."""
TICKS = (1, 2, 5)
"""First digits of the marks on an axis."""


def write_sheet_picture(folder: Path, path: Path, *, title: str) -> None:
    """Draw the result of close-loop in a folder as WebP; the same result gives the same bytes.

    Raises:
        RecordingError: the folder holds no result, or one without a part that chose no effect.
        OutputError: the file cannot be written.
    """
    source = folder / "discrepancy.json"
    try:
        found = json.loads(source.read_text())
    except (OSError, ValueError) as error:
        raise RecordingError(f"{source} cannot be read; give a folder that close-loop wrote.") from error
    shown = found["held_out"]["shown"]
    if not shown:
        raise RecordingError(
            f"{source} reports no part that chose no effect, so there is nothing to show on the sheet."
        )
    names = [name for name in PANELS if name != "after" or found["effects"]]
    canvas = Canvas(WIDTH, TOP + SHEET_ROW * len(shown) + TIME_ROW)
    canvas.text((LEFT, 24), f"{title}: {found['verdict']}", size=17)
    _draw_sheets(canvas, shown, names, np.array(found["localisation"]["particles"]["rest_m"]))
    smallest = 1e3 * SMALLEST * found["noise"]["sd_m"]
    _draw_times(canvas, _curves(found, names), smallest, TOP + SHEET_ROW * len(shown))
    canvas.write(path)


def _draw_sheets(
    canvas: Canvas, shown: Sequence[Mapping[str, Any]], names: Sequence[str], rest: Float[np.ndarray, "n 3"]
) -> None:
    """Draw a row of sheets for each shown frame, all to one scale of lengths and one of colours."""
    rows = [{name: _positions(frame[f"{name}_m"]) for name in names} for frame in shown]
    every = np.concatenate([rest[None], *[np.stack([*row.values()]) for row in rows]])
    most = float(np.nanmax(np.linalg.norm(every[1:] - rest, axis=2)))
    width = (WIDTH - LEFT - RIGHT - GAP * (len(names) - 1)) // len(names)
    plane = plane_of(rest)
    flat = plane.flatten(every.reshape(-1, 3))
    low, high = np.nanmin(flat, axis=0), np.nanmax(flat, axis=0)
    scale = float(min(width / (high - low)[0], SHEET_HEIGHT / (high - low)[1]))
    area = np.prod(np.ptp(plane.flatten(rest), axis=0)) / len(rest)
    radius = 0.45 * scale * float(np.sqrt(area))
    for row, (frame, panels) in enumerate(zip(shown, rows, strict=True)):
        top = TOP + row * SHEET_ROW
        words = "median error" if len(shown) > 1 and row == 0 else "largest error"
        canvas.text((LEFT, top + 12), f"frame {frame['index']}, {frame['time_s']:.3g} s ({words})", size=12)
        for column, name in enumerate(names):
            middle = np.array([LEFT + column * (width + GAP) + width / 2, top + 44 + SHEET_HEIGHT / 2])
            error = np.sqrt(np.nanmean(np.sum((panels[name] - panels["observed"]) ** 2, axis=1)))
            title = PANELS[name] if column == 0 else f"{PANELS[name]}: {1e3 * error:.2f} mm"
            canvas.text((middle[0], top + 30), title, size=13, anchor=0.5)
            at, seen = (middle + scale * np.array([1, -1]) * (plane.flatten(x) - (low + high) / 2)
                        for x in (panels[name], panels["observed"]))  # fmt: skip
            away = np.linalg.norm(panels[name] - rest, axis=1) / most
            known = np.flatnonzero(np.isfinite(away))
            upwards = known[np.argsort(panels[name][known, 2], kind="stable")]
            for place, colour in zip(at[upwards].tolist(), _viridis(away[upwards]), strict=True):
                canvas.disc(place, radius, colour=colour)
            for k in np.flatnonzero(np.linalg.norm(seen - at, axis=1) > 1):
                canvas.line([at[k].tolist(), seen[k].tolist()], colour=INK)
    bar = _viridis(np.linspace(1, 0, SHEET_HEIGHT))[:, None].repeat(12, axis=1)
    canvas.paste((WIDTH - RIGHT + 12, TOP + 44), bar)
    for share, y in ((1.0, TOP + 50), (0.0, TOP + 44 + SHEET_HEIGHT)):
        canvas.text((WIDTH - RIGHT + 28, y), f"{1e3 * most * share:.2g}", size=11)
    for line, words in enumerate(("distance", "from rest", "[mm]")):
        canvas.text((WIDTH - RIGHT + 4, TOP + 4 + 12 * line), words, size=10)


@dataclass(frozen=True, kw_only=True)
class _Curve:
    """An error over time."""

    words: str
    colour: str
    width: float
    dash: float
    fitted: list[tuple[float, float]]
    """Time [s] and error [mm] in fitted frames."""
    reported: list[tuple[float, float]]
    """The same in frames that chose nothing."""


def _draw_times(canvas: Canvas, curves: Sequence[_Curve], smallest: float, top: float) -> None:
    """Draw the error of each frame over time, on a logarithmic axis from the smallest error [mm] on."""
    values = np.array([error for one in curves for _, error in one.fitted + one.reported])
    times = np.array([time for one in curves for time, _ in one.fitted + one.reported])
    low, high = np.log(0.8 * max(values.min(), smallest)), np.log(1.25 * values.max())
    left, right, upper, lower = LEFT, WIDTH - 215, top + 26, top + TIME_ROW - 34
    first, last = times.min(), times.max()

    def place(time: float, error: float) -> tuple[float, float]:
        share = (time - first) / max(last - first, np.finfo(float).tiny)
        return left + 8 + (right - left - 16) * share, lower - (lower - upper) * max(np.log(error) - low, 0) / (
            high - low
        )

    begin = min(time for one in curves for time, _ in one.reported)
    before = [time for one in curves for time, _ in one.fitted if time < begin]
    border, _ = place((max(before) + begin) / 2 if before else begin, 1.0)
    canvas.rectangle((left, upper), (border, lower), colour=FITTED)
    canvas.text((left, top + 16), "RMS error of each frame [mm]; grey ground: fitted", size=12)
    canvas.text((right, top + 16), "predicted from the tool's reports", size=12, anchor=1)
    for error in _marks(np.exp(low), np.exp(high)):
        _, y = place(first, error)
        canvas.line([(left, y), (right, y)], colour=FAINT)
        canvas.text((left - 6, y + 4), f"{error:g}", size=11, anchor=1)
    for time in _even_marks(first, last):
        x, _ = place(time, 1.0)
        canvas.line([(x, lower), (x, lower + 4)], colour=INK)
        canvas.text((x, lower + 18), f"{time:g}", size=11, anchor=0.5)
    canvas.text(((left + right) / 2, lower + 31), "time [s]", size=11, anchor=0.5)
    for row, one in enumerate(curves):
        for points in filter(None, (one.fitted, one.reported)):
            places = [place(*point) for point in points]
            canvas.line(places, colour=one.colour, width=one.width, dash=one.dash)
            for at in places if not one.dash else ():
                canvas.disc(at, one.width + 1, colour=one.colour)
        y = upper + 14 + 22 * row
        canvas.line([(right + 14, y - 4), (right + 38, y - 4)], colour=one.colour, width=one.width, dash=one.dash)
        canvas.text((right + 44, y), one.words, size=12)


def _curves(found: Mapping[str, Any], names: Sequence[str]) -> list[_Curve]:
    """Return the errors of the fits and of all predictions; frames without an observed particle are left out."""
    lines = {"before": ("declared", BEFORE), "after": ("with what is named", AFTER),
             "with_remainder": ("and the remainder", "#000000"),
             **{name: (SHORT.get(name, words), WITHOUT_MODEL) for name, words in TRIVIAL.items()}}  # fmt: skip
    of_fit = {"before": found["localisation"]["frames"], "after": found["localisation_after"]["frames"]}
    return [
        _Curve(
            words=words,
            colour=colour,
            width=WIDE if name == "after" else THIN,
            dash=DASHES.get(name, 0.0),
            fitted=_errors(of_fit.get(name, []), "rms_m"),
            reported=_errors(found["held_out"]["frames"], f"{name}_rms_m"),
        )
        for name, (words, colour) in lines.items()
        if name in names or name in TRIVIAL
    ]


def _errors(frames: Sequence[Mapping[str, Any]], key: str) -> list[tuple[float, float]]:
    """Return times [s] and errors [mm] where there is an error."""
    return [(frame["time_s"], 1e3 * frame[key]) for frame in frames if frame[key]]


def _marks(low: float, high: float) -> list[float]:
    """Return round numbers between two positive numbers."""
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    return [digit * 10.0**power for power in powers for digit in TICKS if low <= digit * 10.0**power <= high]


def _even_marks(low: float, high: float) -> list[float]:
    """Return about six round numbers in even steps between two numbers."""
    step = next(one for one in _marks((high - low) / 6, 10 * (high - low)))
    return [k * step for k in range(int(np.ceil(low / step)), int(np.floor(high / step)) + 1)]


def _positions(values: Sequence[Sequence[float] | None]) -> Float[np.ndarray, "n 3"]:
    """Return positions [m]; NaN where there is none."""
    return np.array([[np.nan] * 3 if one is None else one for one in values])


def _viridis(share: Float[np.ndarray, " k"]) -> UInt8[np.ndarray, "k 3"]:
    """Return blue, green and red for numbers from 0 to 1."""
    level = np.round(255 * np.clip(share, 0, 1)).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(level[:, None], cv2.COLORMAP_VIRIDIS))[:, 0]
