"""The noise of measured points that counts: as the recording states it, or as frames at rest show it where it is more.

Differences of frames do not show noise that stays the same, so less measured noise than stated proves nothing.
"""

import math
from dataclasses import dataclass

from jiggle_mj.estimate import PointNoise
from jiggle_mj.observation import MeasuredPoints

from .still_noise import MAX_SMOOTH_SHARE, StillNoise

MAX_RATIO, MAX_SMOOTH_RATIO = 1.1, 1.25
"""Ratio of measured to stated standard deviation up to which the statement holds, of all noise and of the part that
neighbours share: from five frames of 20 points the first errs by 0.06, and the second, of few independent values, by
0.25."""


@dataclass(frozen=True, kw_only=True)
class CombinedNoise:
    """Noise of one recording's points."""

    noise: StillNoise
    """The noise that counts."""
    stated: MeasuredPoints
    """Points of the first frame, which state theirs."""
    measured: bool
    """Whether frames at rest show more than is stated."""

    @classmethod
    def of(cls, stated: MeasuredPoints, measured: StillNoise | None) -> "CombinedNoise":
        """Combine what the points state with what is measured, None for nothing."""
        total, smooth, length, frames, more = stated.sd, stated.smooth_sd, stated.smooth_length or 0.0, 0, False
        if measured is not None:
            frames = measured.frames
            if more_smooth := measured.smooth_sd > MAX_SMOOTH_RATIO * smooth:
                smooth, length = measured.smooth_sd, measured.length
            more = more_smooth or measured.total_sd > MAX_RATIO * total
            total = max(total, measured.total_sd) if more else total
        smooth = min(smooth, math.sqrt(MAX_SMOOTH_SHARE) * total)
        noise = StillNoise(sd=math.sqrt(total**2 - smooth**2), smooth_sd=smooth, length=length, frames=frames)
        return cls(noise=noise, stated=stated, measured=more)

    @property
    def published(self) -> PointNoise:
        """Return the noise as results have it."""
        noise, stated = self.noise, self.stated
        return PointNoise(
            sd=noise.sd,
            smooth_sd=noise.smooth_sd,
            smooth_length=noise.length if noise.smooth_sd else None,
            source="measured" if self.measured else "stated" if stated.sd_stated else "assumed",
            stated_sd=stated.sd if stated.sd_stated else None,
            still_frames=noise.frames,
        )
