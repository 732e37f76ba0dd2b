"""Reading recordings: MCAP files that hold what an estimator may see, and nothing else.

The topics are in docs/RECORDINGS.md. A frame that fails a check is named and skipped. Does not rectify, resample or
interpolate; `contents` says which messages a file may hold, `pairing` which of them belong together, and
`observation_reader` decodes them.
"""

import math
import os
from collections import deque
from collections.abc import Container, Iterator
from dataclasses import replace
from typing import Any, Self

from ..argument_checks import as_path
from ..camera import StereoCamera
from ..errors import RecordingError
from ..observation import Declaration, Observation
from .contents import RecordingContents
from .frames import transform_of_rotation
from .observation_reader import ObservationReader
from .pairing import MAX_PAIRING_TOLERANCE_MS, MessageGroup, Stamped, group_messages, lone_jumps, stamp_gap
from .schemas import parse_calibration
from .topics import GRASP, LEFT, LEFT_INFO, POINTS, POSE, RIGHT, RIGHT_INFO

PAIRING_TOLERANCE_NS = 5_000_000
"""Default largest difference between the stamps of one group [ns]; the sensors of a robot stamp a few ms apart."""
MAX_POSE_AGE_NS = 100_000_000
"""Default age above which a tool pose no longer says where the tool is [ns]."""
MAX_SEED_DIGITS = 20
"""Longest seed that is read: 64 bits."""


class Recording:
    """A recording opened for reading; iterating gives the usable observations, images decoded one frame at a time.

    `Recording.open` makes one. Iterating again starts from the beginning.
    """

    camera: StereoCamera | None
    """The calibrated stereo camera; None where the recording has points only."""
    declaration: Declaration
    """What the user declared; the defaults where the file, a robot's for example, holds none."""
    declared: bool
    """Whether the file holds a declaration."""
    metadata: dict[str, str]
    """Versions, units, seed; empty for a file that another program wrote."""
    ignored: dict[str, int]
    """Number of messages on each topic that is not read."""
    skipped: list[tuple[int, str]]
    """Index and reason of each unusable frame of the latest iteration, up to where it stands."""

    def __init__(self, contents: RecordingContents, *, tolerance_ns: int, pose_age_ns: int) -> None:
        self._contents, self._tolerance = contents, tolerance_ns
        self.camera = _read_camera(contents) if contents.has_images else None
        self.declaration, self.metadata, self.ignored = contents.declaration, contents.metadata, contents.ignored
        self.declared = contents.declared
        self.skipped = []
        stamped = contents.stamped
        self._groups = group_messages(
            left=stamped[LEFT],
            right=stamped[RIGHT],
            points=stamped[POINTS],
            pose=stamped[POSE],
            grasp=stamped[GRASP],
            tolerance=tolerance_ns,
        )
        _refuse_unpaired(contents, self._groups, tolerance_ns)
        self._reader = ObservationReader(
            contents=contents,
            camera=self.camera,
            poses=sorted(stamped[POSE]),
            origin=0 if self.metadata else self._groups[0].stamp,
            max_pose_age=pose_age_ns,
            tolerance=tolerance_ns,
        )

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        *,
        allow_truncated: bool = False,
        tolerance_ns: int = PAIRING_TOLERANCE_NS,
        pose_age_ns: int = MAX_POSE_AGE_NS,
    ) -> Self:
        """Open a recording and read everything in it except images and points.

        Args:
            path: an MCAP file of observations.
            allow_truncated: read the complete records of a file that was cut off.
            tolerance_ns: largest difference between the stamps of one frame [ns].
            pose_age_ns: largest age of a tool pose that still says where the tool is [ns].

        Raises:
            RecordingError: missing, not an MCAP, truncated, damaged, foreign, holding truth, uncalibrated.
        """
        contents = RecordingContents(
            as_path(path, "the recording", error=RecordingError), allow_truncated=allow_truncated
        )
        return cls(contents, tolerance_ns=tolerance_ns, pose_age_ns=pose_age_ns)

    @property
    def why_no_force(self) -> str | None:
        """Why the forces on the tool are not used, such as that their frame is unknown; None where they are."""
        return self._reader.why_no_force

    @property
    def lost_forces(self) -> tuple[int, int]:
        """How many forces on the tool are not three finite numbers, and how many the file holds."""
        forces = self._contents.forces
        return sum(not force.is_measured for force in forces), len(forces)

    @property
    def seed(self) -> int | None:
        """Return the seed that the metadata state; None where they state none, as a secret scene's."""
        text = self.metadata.get("seed", "")
        return int(text) if text.isascii() and text.isdigit() and len(text) <= MAX_SEED_DIGITS else None

    def __len__(self) -> int:
        """Return the number of frames, unusable ones included."""
        return len(self._groups)

    def __iter__(self) -> Iterator[Observation]:
        """Yield the usable observations in file order."""
        return self._observations(range(len(self)))

    def without_images(self) -> Iterator[Observation]:
        """Yield the usable observations without their images, which takes much less time; images are not checked."""
        return self.with_images_of(())

    def with_images_of(self, indices: Container[int]) -> Iterator[Observation]:
        """Yield the usable observations, those of some indices with their images; other images are not checked."""
        return self._observations(indices)

    def _observations(self, with_images: Container[int]) -> Iterator[Observation]:
        self.skipped = []
        latest: int | None = None
        last_pose: Stamped | None = None
        coming = deque(self._contents.events)
        jumps = lone_jumps([group.stamp for group in self._groups])
        for index, (group, messages) in enumerate(self._grouped_messages()):
            try:
                if index in jumps:
                    raise RecordingError(f"its time leaps to {group.stamp} ns, and the next frame's back")
                if latest is not None and group.stamp <= latest:
                    raise RecordingError(f"time goes backwards, from {latest} ns to {group.stamp} ns")
                latest = group.stamp
                observation = self._reader.read(index, group, messages, images=index in with_images)
            except RecordingError as failure:
                self.skipped.append((index, str(failure)))
                continue
            events = []
            while coming and coming[0][0] <= group.stamp + self._tolerance:
                events.append(coming.popleft()[1])
            reports = self._reader.reports(last_pose, group.pose)
            yield replace(observation, events=tuple(events), reports=reports)
            last_pose = group.pose

    def _grouped_messages(self) -> Iterator[tuple[MessageGroup, dict[str, Any]]]:
        """Yield each group with its images and points, still encoded; keep only what a later group needs."""
        wanted = {message.ordinal: topic for group in self._groups for topic, message in _parts(group)}
        kept: dict[int, Any] = {}
        coming = iter(self._groups)
        group = next(coming, None)
        for ordinal, message in self._contents.encoded(wanted):
            kept[ordinal] = message
            while group is not None and all(part.ordinal <= ordinal for _, part in _parts(group)):
                yield group, {topic: kept.pop(part.ordinal) for topic, part in _parts(group)}
                group = next(coming, None)


def _parts(group: MessageGroup) -> list[tuple[str, Stamped]]:
    """Return the images and points of a group, which are decoded later, with their topics."""
    parts = ((LEFT, group.left), (RIGHT, group.right), (POINTS, group.points))
    return [(topic, message) for topic, message in parts if message is not None]


def _refuse_unpaired(contents: RecordingContents, groups: list[MessageGroup], tolerance_ns: int) -> None:
    """Refuse a recording in which no left image has a right one, and say how far apart they are."""
    left, right = contents.stamped[LEFT], contents.stamped[RIGHT]
    if not left or not right or any(group.left is not None and group.right is not None for group in groups):
        return
    gap = stamp_gap(left, right)
    apart, side = abs(gap.median) / 1e6, "later" if gap.median > 0 else "earlier"
    wanted = math.ceil(apart) + 1
    if gap.within_frame and wanted <= MAX_PAIRING_TOLERANCE_MS:
        cure = (
            f"if the cameras do fire together, read it with --pairing-tolerance {wanted} "
            f"(tolerance_ns={wanted}_000_000)"
        )
    else:
        often = f"left images come every {gap.period / 1e6:g} ms" if gap.period else "there is one left image"
        cure = f"{often}, and at most {MAX_PAIRING_TOLERANCE_MS:g} ms can be allowed: are the two stamps of one clock?"
    raise RecordingError(
        f"{contents.path} has {len(left)} left and {len(right)} right images and no pair within "
        f"{tolerance_ns / 1e6:g} ms: the nearest right image comes {apart:.6g} ms {side} (median); {cure}."
    )


def _read_camera(contents: RecordingContents) -> StereoCamera:
    left, right = contents.calibrations[LEFT_INFO], contents.calibrations[RIGHT_INFO]
    calibration = parse_calibration(left, LEFT_INFO)
    T_world_left = contents.frames.T_world(left.frame_id, LEFT_INFO)
    return StereoCamera(
        left=calibration,
        right=parse_calibration(right, RIGHT_INFO),
        T_world_camera=T_world_left @ transform_of_rotation(calibration.R.T),
    )
