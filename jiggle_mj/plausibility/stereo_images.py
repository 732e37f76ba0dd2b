"""What a few stereo pairs show of each other: images of one colour, rows that do not fit, and another moment.

A feature lies in the same row of both rectified images, and further right in the left one. One that moves between two
frames tells a late camera: in the late image it is where it was in the frame before. Features that move along the rows
alone tell nothing.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from ..camera import StereoCamera
from ..observation import StereoPair
from .stereo_matches import Features, find_features, match_features

Side = Literal["left", "right"]
"""Which camera of the pair."""
SIDES: tuple[Side, Side] = ("left", "right")
"""Both cameras."""
MIN_CONTRAST = 6.0
"""Range of the grey levels, 1st to 99th percentile, below which an image is of one colour. Noise of 10 levels, more
than any camera's, spans 5.2 once it is averaged over `CONTRAST_BLOCK`."""
CONTRAST_BLOCK = 9
"""Side of the squares over which grey levels are averaged [px]."""
MIN_MATCHES = 12
"""Matches from which their median and their majority are believed."""
SURE_SHARE = 0.8
"""Share of the matches that must agree."""
MAX_ROW_SPREAD = 0.05
"""Range of the middle half of the row differences from which on matches are false [image height]: that of false ones is
about a half, that of a camera that is rotated by 3 degrees a fortieth."""
MIN_ROW_MOTION = 1.0
"""Rows by which a feature must move from frame to frame to tell moments apart [px]: twice the row error of a usual
calibration."""


@dataclass(frozen=True, kw_only=True)
class StereoImages:
    """What the compared pairs show."""

    grey: dict[Side, Float[np.ndarray, " n"]]
    """Mean grey level of the images of each side, 0 to 255; NaN for an image that is not of one colour."""
    shifts: Float[np.ndarray, "m 2"]
    """Left minus right pixel of the features that match within a pair, u and v [px]; empty where matches are false."""
    late: Side | None
    """The side whose images show an earlier moment than those of the other."""

    @property
    def rows(self) -> float | None:
        """Return the median size of the row differences [px]; None where too few features match."""
        return float(np.median(np.abs(self.shifts[:, 1]))) if len(self.shifts) else None

    @property
    def swapped(self) -> bool:
        """Return whether the scene lies further left in the left image."""
        return bool(len(self.shifts) and np.mean(self.shifts[:, 0] < 0) >= SURE_SHARE)


def compare_images(camera: StereoCamera, pairs: Iterable[tuple[StereoPair, StereoPair]]) -> StereoImages:
    """Compare the images of two successive frames each.

    Args:
        camera: their camera.
        pairs: the stereo pairs of both frames, the earlier first.
    """
    grey: dict[Side, list[float]] = {"left": [], "right": []}
    shifts: list[Float[np.ndarray, "_ 2"]] = []
    moved: dict[Side, list[Float[np.ndarray, "_ 3"]]] = {"left": [], "right": []}
    height = camera.left.height
    for pair in pairs:
        levels = {side: [_grey_of_blank(getattr(each, side)) for each in pair] for side in SIDES}
        for side in SIDES:
            grey[side] += levels[side]
        if np.isfinite([*levels["left"], *levels["right"]]).any():
            continue
        before, now = ({side: find_features(camera, side, getattr(each, side)) for side in SIDES} for each in pair)
        matched = match_features(now["left"], now["right"])
        shifts.append(now["left"].pixels[matched[:, 0]] - now["right"].pixels[matched[:, 1]])
        for side, across in zip(SIDES, (matched[:, ::-1], matched), strict=True):
            other: Side = "left" if side == "right" else "right"
            moved[side].append(_rows_of_moved(before[other], now[other], now[side], across))
    of_all = np.concatenate(shifts) if shifts else np.empty((0, 2))
    spread = float(np.ptp(np.percentile(of_all[:, 1], [25, 75]))) if len(of_all) else 0.0
    if len(of_all) < MIN_MATCHES or spread > MAX_ROW_SPREAD * height:
        of_all = np.empty((0, 2))
    offset = float(np.median(of_all[:, 1])) if len(of_all) else 0.0
    late: list[Side] = [
        side for side, rows in zip(SIDES, (offset, -offset), strict=True) if _shows_earlier(moved[side], offset=rows)
    ]
    return StereoImages(
        grey={side: np.array(levels) for side, levels in grey.items()},
        shifts=of_all,
        late=late[0] if len(late) == 1 and len(of_all) else None,
    )


def _grey_of_blank(image: UInt8[np.ndarray, "height width 3"]) -> float:
    """Return the mean grey level of an image of one colour; NaN for any other."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    low, high = np.percentile(cv2.blur(grey, (CONTRAST_BLOCK, CONTRAST_BLOCK)), [1, 99])
    return float(grey.mean()) if high - low < MIN_CONTRAST else np.nan


def _rows_of_moved(
    before: Features, now: Features, other: Features, across: Int[np.ndarray, "m 2"]
) -> Float[np.ndarray, "k 3"]:
    """Return the rows of features before, now, and in the image of the other side [px].

    Args:
        before: of the frame before.
        now: of the same side in this frame.
        other: of the other side in this frame.
        across: numbers of the features that match in `now` and `other`.
    """
    place = dict(across.tolist())
    kept = [(old, new, place[new]) for new, old in match_features(now, before).tolist() if new in place]
    old, new, seen = np.array(kept, np.int64).reshape(-1, 3).T
    return np.column_stack([before.pixels[old, 1], now.pixels[new, 1], other.pixels[seen, 1]])


def _shows_earlier(moved: list[Float[np.ndarray, "_ 3"]], *, offset: float) -> bool:
    """Return whether features that move are in the other image where they were in the frame before.

    Args:
        moved: results of `_rows_of_moved`.
        offset: rows that the other image lies too low [px].
    """
    old, new, seen = np.concatenate([*moved, np.empty((0, 3))]).T
    seen = seen - offset
    motion, to_old, to_new = np.abs(new - old), np.abs(seen - old), np.abs(seen - new)
    telling = (motion >= MIN_ROW_MOTION) & (np.minimum(to_old, to_new) < motion / 2)
    return bool(telling.sum() >= MIN_MATCHES and np.mean(to_old[telling] < to_new[telling]) >= SURE_SHARE)
