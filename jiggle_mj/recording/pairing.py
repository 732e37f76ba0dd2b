"""Which messages of a recording belong to one moment, decided from their time stamps alone.

Left and right images, or clouds where there are no images, make the moments; the tool's state is what it last said.
Sensors of a robot stamp the same moment a few ms apart, hence a tolerance. Decodes nothing: see `recording`.
"""

from bisect import bisect_left, bisect_right
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, order=True)
class Stamped:
    """One message, by its own time and its place in the file."""

    stamp: int
    """[ns]."""
    ordinal: int
    """Number of the message in the file."""


@dataclass(frozen=True, kw_only=True)
class MessageGroup:
    """The messages of one moment; None for one that is not there."""

    stamp: int
    """[ns]."""
    left: Stamped | None = None
    right: Stamped | None = None
    points: Stamped | None = None
    pose: Stamped | None = None
    grasp: Stamped | None = None


def group_moments(
    *,
    left: list[Stamped],
    right: list[Stamped],
    points: list[Stamped],
    pose: list[Stamped],
    grasp: list[Stamped],
    tolerance: int,
) -> list[MessageGroup]:
    """Moments in the order in which the file holds them, which need not be the order of their stamps.

    A left image takes the nearest right image within the tolerance that no earlier one took, and likewise a cloud.
    A right image that nobody took is a moment of its own, so that its missing half is named. Without any image each
    cloud is a moment. The tool's pose and grasp are the latest at most `tolerance` after the moment, however old.

    Args:
        left: messages of each kind, in file order.
        right: see `left`.
        points: see `left`.
        pose: see `left`.
        grasp: see `left`.
        tolerance: largest difference of stamps within a moment [ns].
    """
    rights, clouds = _Pool(right), _Pool(points)
    sensors: list[tuple[Stamped, MessageGroup]] = []
    if left or right:
        for image in left:
            mate, cloud = rights.take(image.stamp, tolerance), clouds.take(image.stamp, tolerance)
            sensors.append((image, MessageGroup(stamp=image.stamp, left=image, right=mate, points=cloud)))
        sensors += [(image, MessageGroup(stamp=image.stamp, right=image)) for image in rights.unexplained()]
    else:
        sensors = [(cloud, MessageGroup(stamp=cloud.stamp, points=cloud)) for cloud in points]
    poses, grasps = sorted(pose), sorted(grasp)
    return [
        MessageGroup(
            stamp=moment.stamp,
            left=moment.left,
            right=moment.right,
            points=moment.points,
            pose=_latest(poses, moment.stamp + tolerance),
            grasp=_latest(grasps, moment.stamp + tolerance),
        )
        for _, moment in sorted(sensors, key=lambda pair: pair[0].ordinal)
    ]


def _latest(messages: list[Stamped], until: int) -> Stamped | None:
    place = bisect_right(messages, until, key=lambda message: message.stamp)
    return messages[place - 1] if place else None


class _Pool:
    """Messages that can be taken once each."""

    def __init__(self, messages: list[Stamped]) -> None:
        self._messages = sorted(messages)
        self._taken: set[Stamped] = set()

    def take(self, stamp: int, tolerance: int) -> Stamped | None:
        first = bisect_left(self._messages, stamp - tolerance, key=lambda message: message.stamp)
        last = bisect_right(self._messages, stamp + tolerance, key=lambda message: message.stamp)
        free = [message for message in self._messages[first:last] if message not in self._taken]
        nearest = min(free, key=lambda message: abs(message.stamp - stamp), default=None)
        if nearest is not None:
            self._taken.add(nearest)
        return nearest

    def unexplained(self) -> list[Stamped]:
        return [message for message in self._messages if message not in self._taken]
