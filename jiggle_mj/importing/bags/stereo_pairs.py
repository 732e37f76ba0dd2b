"""Pairs of left and right images, by the nearest stamp.

Two images are a pair where each is the other's nearest and their stamps differ by at most the tolerance, which must be
below half the time from frame to frame: an image is never paired with another moment's.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from ...errors import RecordingError
from ...recording.pairing import MAX_PAIRING_TOLERANCE_MS
from .settings import MS


@dataclass(frozen=True, kw_only=True)
class StereoPairs:
    """Which left image belongs to which right image."""

    left: Int[np.ndarray, " n"]
    """Numbers of the left images, by time."""
    right: Int[np.ndarray, " n"]
    """Number of each one's right image."""
    offsets: Int[np.ndarray, " n"]
    """Stamp of the right image minus that of the left [ns]."""
    n_alone: int
    """Number of images, left and right, without a partner."""

    def summary(self) -> str:
        """Return the measured offsets in words."""
        offsets = self.offsets / MS
        return (
            f"{len(offsets)} pairs, right minus left {np.median(offsets):.3g} ms (from {offsets.min():.3g} to "
            f"{offsets.max():.3g} ms); {self.n_alone} images without a partner"
        )


def pair_images(left: Sequence[int], right: Sequence[int], tolerance_ms: float) -> StereoPairs:
    """Pair images by their stamps.

    Args:
        left: stamps of the left images in any order [ns].
        right: stamps of the right images [ns].
        tolerance_ms: largest difference within a pair [ms].

    Raises:
        RecordingError: no pair within the tolerance, or a tolerance that could pair two moments.
    """
    left_order, right_order = (np.unique(np.array(stamps, np.int64), return_index=True) for stamps in (left, right))
    (lefts, left_numbers), (rights, right_numbers) = left_order, right_order
    nearest_right = _nearest(lefts, rights)
    mutual = _nearest(rights, lefts)[nearest_right] == np.arange(len(lefts))
    offsets = rights[nearest_right] - lefts
    tolerance = round(tolerance_ms * MS)
    period = min((float(np.median(np.diff(each))) for each in (lefts, rights) if len(each) > 1), default=np.inf)
    paired = mutual & (np.abs(offsets) <= tolerance)
    if not paired.any():
        nearest = offsets[mutual] / MS
        wanted = np.ceil(np.abs(nearest).max() + 1)
        cure = (
            f"--pairing-tolerance {wanted:g} pairs them, if the tissue stands still that long"
            if wanted * MS < period / 2 and wanted <= MAX_PAIRING_TOLERANCE_MS
            else "no tolerance pairs them without mixing moments: synchronise the cameras, or go by --clock receive"
        )
        raise RecordingError(
            f"no left image has a right image within {tolerance_ms:g} ms: right minus left is "
            f"{np.median(nearest):.4g} ms (from {nearest.min():.4g} to {nearest.max():.4g} ms); {cure}."
        )
    if tolerance >= period / 2:
        raise RecordingError(
            f"--pairing-tolerance {tolerance_ms:g} ms is half of the {period / MS:.4g} ms from frame to frame or more, "
            f"so it could pair two moments; give less than {period / 2 / MS:.4g}."
        )
    return StereoPairs(
        left=left_numbers[paired],
        right=right_numbers[nearest_right[paired]],
        offsets=offsets[paired],
        n_alone=len(left) + len(right) - 2 * int(paired.sum()),
    )


def _nearest(stamps: Int[np.ndarray, " n"], others: Int[np.ndarray, " m"]) -> Int[np.ndarray, " n"]:
    """Return the number of the nearest of the others, which increase, to each stamp."""
    after = np.clip(np.searchsorted(others, stamps), 1, max(len(others) - 1, 1))
    if len(others) == 1:
        return np.zeros(len(stamps), np.int64)
    return after - (stamps - others[after - 1] <= others[after] - stamps)
