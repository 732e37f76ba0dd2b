"""Which messages of a recording belong to one frame, decided from their time stamps alone.

Left and right images, or clouds where there are no images, make the groups; the tool's state is its latest report.
The sensors of a robot stamp the same instant a few ms apart, hence a tolerance. Decodes nothing: see `reader`.
"""

from bisect import bisect_left, bisect_right
from dataclasses import dataclass
from itertools import pairwise
from statistics import median_low

MAX_PAIRING_TOLERANCE_MS = 1000.0
"""Largest difference between the stamps of one frame that may be allowed [ms]: in a second, every tissue has moved."""
MAX_LEAP_NS = 60_000_000_000
"""Leap of one time stamp ahead of the next one that is a fault of the stamp [ns]: a minute."""


@dataclass(frozen=True, kw_only=True, order=True)
class Stamped:
    """One message, by its own time and its place in the file."""

    stamp: int
    """Time stamp of the message [ns]."""
    ordinal: int
    """Number of the message in the file, from 0."""


@dataclass(frozen=True, kw_only=True)
class MessageGroup:
    """The messages that make one frame; None for one that is missing."""

    stamp: int
    """Time stamp of the frame: that of its image or cloud [ns]."""
    left: Stamped | None = None
    """Left image."""
    right: Stamped | None = None
    """Right image."""
    points: Stamped | None = None
    """Point cloud."""
    pose: Stamped | None = None
    """Latest tool pose."""
    grasp: Stamped | None = None
    """Latest state of the jaws."""


def group_messages(
    *,
    left: list[Stamped],
    right: list[Stamped],
    points: list[Stamped],
    pose: list[Stamped],
    grasp: list[Stamped],
    tolerance: int,
) -> list[MessageGroup]:
    """Group messages into frames, in the order of the file, which may differ from the order of their stamps.

    A left image takes the nearest right image within the tolerance that no earlier one took, and likewise a cloud.
    A right image that no left image takes is a group of its own, so that its missing half is named. Without any image
    each cloud is a group. The tool's pose and grasp are the latest ones at most `tolerance` after the group's stamp,
    whatever their age.

    Args:
        left: messages of each kind, in file order.
        right: see `left`.
        points: see `left`.
        pose: see `left`.
        grasp: see `left`.
        tolerance: largest difference of stamps within a group [ns].
    """
    rights, clouds = _Pool(right), _Pool(points)
    sensors: list[tuple[Stamped, MessageGroup]] = []
    if left or right:
        for image in left:
            mate, cloud = rights.take(image.stamp, tolerance), clouds.take(image.stamp, tolerance)
            sensors.append((image, MessageGroup(stamp=image.stamp, left=image, right=mate, points=cloud)))
        sensors += [(image, MessageGroup(stamp=image.stamp, right=image)) for image in rights.remaining()]
    else:
        sensors = [(cloud, MessageGroup(stamp=cloud.stamp, points=cloud)) for cloud in points]
    poses, grasps = sorted(pose), sorted(grasp)
    return [
        MessageGroup(
            stamp=group.stamp,
            left=group.left,
            right=group.right,
            points=group.points,
            pose=_latest(poses, group.stamp + tolerance),
            grasp=_latest(grasps, group.stamp + tolerance),
        )
        for _, group in sorted(sensors, key=lambda pair: pair[0].ordinal)
    ]


def _latest(messages: list[Stamped], until: int) -> Stamped | None:
    place = bisect_right(messages, until, key=lambda message: message.stamp)
    return messages[place - 1] if place else None


@dataclass(frozen=True, kw_only=True)
class StampGap:
    """How far the right images are from the left ones in time, where none is within the tolerance."""

    median: int
    """Median of the nearest right image's stamp minus the left image's [ns]."""
    period: int
    """Median time between two left images [ns]; 0 for one image."""

    @property
    def within_frame(self) -> bool:
        """Return whether each right image is nearer to its left image than to the next one."""
        return self.period == 0 or 2 * abs(self.median) < self.period


def stamp_gap(left: list[Stamped], right: list[Stamped]) -> StampGap:
    """Return the gap between left images and their nearest right images; there must be some of both."""
    lefts, rights = sorted(each.stamp for each in left), sorted(each.stamp for each in right)
    gaps = []
    for stamp in lefts:
        place = bisect_left(rights, stamp)
        gaps.append(min((other - stamp for other in rights[max(0, place - 1) : place + 1]), key=abs))
    periods = [after - before for before, after in pairwise(lefts)]
    return StampGap(median=int(median_low(gaps)), period=int(median_low(periods)) if periods else 0)


def lone_jumps(stamps: list[int]) -> set[int]:
    """Return the places of stamps that leap ahead of their neighbours by more than `MAX_LEAP_NS` and alone.

    Without them the stamps before and after still rise, so that one wrong stamp does not cost all frames behind it.
    """
    return {
        place
        for place in range(1, len(stamps) - 1)
        if stamps[place - 1] < stamps[place + 1] < stamps[place] - MAX_LEAP_NS
    }


class _Pool:
    """Messages that can be taken once each."""

    def __init__(self, messages: list[Stamped]) -> None:
        self._messages = sorted(messages)
        self._taken: set[Stamped] = set()

    def take(self, stamp: int, tolerance: int) -> Stamped | None:
        """Take the message nearest to a stamp within the tolerance; None where there is none."""
        first = bisect_left(self._messages, stamp - tolerance, key=lambda message: message.stamp)
        last = bisect_right(self._messages, stamp + tolerance, key=lambda message: message.stamp)
        free = [message for message in self._messages[first:last] if message not in self._taken]
        nearest = min(free, key=lambda message: abs(message.stamp - stamp), default=None)
        if nearest is not None:
            self._taken.add(nearest)
        return nearest

    def remaining(self) -> list[Stamped]:
        """Return the messages that were not taken."""
        return [message for message in self._messages if message not in self._taken]
