"""Import of a ROS bag: a robot's own recording becomes one of ours.

Two passes: `survey` reads all that is small and the stamps of the rest, then images and clouds come frame by frame, so
the memory does not grow with the bag. The bytes of the output depend on the content of the bag alone.
"""

import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from ...errors import OutputError, RecordingError
from ...observation import MeasuredPoints, Observation, StereoPair, ToolState
from ...recording.declaration import identity
from ...recording.images import refuse_other_size
from ...recording.reader import PAIRING_TOLERANCE_NS
from ...recording.writer import RecordingWriter
from ..complete_files import complete_files
from ..grasp_table import DEFAULT_GRASP_RADIUS
from .bag_file import Bag
from .bag_paths import refusing
from .camera_order import disparities, left_is_left, scene_range
from .clouds import cloud_points, depth_points
from .gripper import state_at
from .images import rgb_image
from .missing import refuse_foreign
from .preparation import FrameParts, Preparation, prepare
from .roles import choose_roles
from .settings import BagSettings, Role
from .tool_in_view import tool_in_view
from .transforms import frame_name


@dataclass(frozen=True, kw_only=True)
class BagSummary:
    """Files and figures of an import."""

    recording: Path
    """The recording."""
    topics: dict[str, str]
    """Topic of each role."""
    guessed: tuple[str, ...]
    """Roles whose topic was guessed."""
    n_frames: int
    """Number of frames of the recording."""
    duration: float
    """Time from the first frame to the last [s]."""
    n_grasps: int
    """Number of grasps."""
    skipped: dict[str, int]
    """Number of frames that were left out, by reason."""
    notes: tuple[str, ...]
    """What was measured, assumed or left out, one sentence each."""


def import_bag(
    bag: str | os.PathLike[str],
    out: str | os.PathLike[str],
    settings: BagSettings | None = None,
    *,
    overwrite: bool = False,
) -> BagSummary:
    """Convert a ROS bag to a recording.

    Args:
        bag: a `.bag`, `.mcap` or `.db3` file, or the folder of a ROS 2 bag.
        out: the recording to write.
        settings: what the user says about the bag; None to guess all.
        overwrite: replace an existing file.

    Raises:
        RecordingError: the bag is damaged or lacks what an estimate needs; the message says what, and what to do.
        OutputError: the output exists, or cannot be written.
    """
    bag, out, settings = Path(bag), Path(out), settings or BagSettings()
    if out.resolve() == bag.resolve() or bag.resolve() in out.resolve().parents:
        raise OutputError(f"{out} is the bag, or lies in it; choose another path.")
    with (
        complete_files(out, overwrite=overwrite) as (part, _),
        Bag(bag, allow_truncated=settings.allow_truncated) as source,
    ):
        with refusing(bag, "a message"):
            return _import(source, part, out, settings)


def _import(bag: Bag, part: Path, out: Path, settings: BagSettings) -> BagSummary:
    """Write the recording to `part`, which becomes `out`; return its summary."""
    refuse_foreign(bag)
    roles, unsure = choose_roles(bag.topics, settings.topics)
    prepared = prepare(bag, roles, unsure, settings)
    notes = list(prepared.notes)
    scene = _scene_seen(bag, prepared, notes)
    if prepared.camera is not None:
        notes += tool_in_view(prepared.camera, prepared, scene)
    skipped: Counter[str] = Counter()
    written: list[int] = []
    with RecordingWriter(
        part,
        camera=prepared.camera,
        declaration=prepared.declaration,
        metadata={"source": "ROS bag", "identity": _identity(prepared)},
    ) as writer:
        _write_frames(bag, prepared, writer, skipped, written)
    if not written:
        reason, count = skipped.most_common(1)[0]
        raise RecordingError(
            f"{bag.path}: none of {sum(skipped.values())} frames can be used; {count} times: {reason}."
        )
    if prepared.settings.grasp_radius is None and all(state.radius is None for state in prepared.jaws):
        notes.append(f"radius of the grip: {1e3 * DEFAULT_GRASP_RADIUS:g} mm is assumed; say yours with --grasp-radius")
    used = [state for state in prepared.jaws if state.closed]
    if not used:
        notes.append("the jaws never close, so there is nothing to estimate from")
    return BagSummary(
        recording=out,
        topics={role: choice.topic for role, choice in prepared.roles.items()},
        guessed=tuple(role for role, choice in prepared.roles.items() if not choice.by_user),
        n_frames=len(written),
        duration=(written[-1] - written[0]) / 1e9,
        n_grasps=max((state.grasp for state in used), default=0),
        skipped=dict(skipped),
        notes=tuple(notes),
    )


def _write_frames(
    bag: Bag, prepared: Preparation, writer: RecordingWriter, skipped: Counter[str], written: list[int]
) -> None:
    origin, previous = prepared.frames[0].stamp, prepared.frames[0].stamp
    forces = iter(prepared.forces)
    force = next(forces, None)
    for frame, read in _read_frames(bag, prepared):
        try:
            observation = _observation(prepared, frame.stamp, read)
        except RecordingError as failure:
            skipped[str(failure)] += 1
            continue
        while force is not None and force.time <= frame.stamp:
            if force.time >= origin:
                writer.write_force(replace(force, time=force.time - origin))
            force = next(forces, None)
        reports = prepared.tool.between(previous, frame.stamp, origin)
        writer.write(replace(observation, index=len(written), time=frame.stamp - origin, reports=reports))
        written.append(frame.stamp)
        previous = frame.stamp


def _observation(prepared: Preparation, stamp: int, read: dict[Role, Any]) -> Observation:
    """Return the observation of one frame; its index, its time from the start and its reports are the caller's."""
    position, quat_wxyz = prepared.tool.at(stamp)
    jaws = state_at(prepared.jaws, stamp + PAIRING_TOLERANCE_NS)  # as `Recording` reads them
    images = points = None
    if "left" in read:
        images = StereoPair(left=_image(prepared, "left", read), right=_image(prepared, "right", read))
    if "points" in read or "depth" in read:
        points = _points(prepared, stamp, read)
    return Observation(
        index=0,
        time=stamp,
        tool=ToolState(
            position=position,
            quat_wxyz=quat_wxyz,
            closed=jaws.closed,
            grasp=jaws.grasp,
            radius=jaws.radius or prepared.settings.grasp_radius or DEFAULT_GRASP_RADIUS,
            held_tracks=jaws.held_tracks,
            by_points=jaws.by_points,
        ),
        images=images,
        points=points,
    )


def _read_frames(bag: Bag, prepared: Preparation) -> Iterator[tuple[FrameParts, dict[Role, Any]]]:
    """Yield each frame with its messages, in the order of time; keep only what a later frame needs."""
    roles_of: dict[str, Role] = {prepared.topic(role): role for frame in prepared.frames for role in frame.parts}
    wanted = {(role, number) for frame in prepared.frames for role, number in frame.parts.items()}
    kept: dict[tuple[Role, int], Any] = {}
    coming = iter(prepared.frames)
    frame = next(coming, None)
    for message in bag.messages(list(roles_of)):
        key: tuple[Role, int] = (roles_of[message.topic], message.number)
        if key in wanted:
            kept[key] = message.content
        while frame is not None and all(part in kept for part in frame.parts.items()):
            yield frame, {part[0]: kept.pop(part) for part in frame.parts.items()}
            frame = next(coming, None)


def _image(prepared: Preparation, role: Role, read: dict[Role, Any]) -> UInt8[np.ndarray, "height width 3"]:
    assert prepared.camera is not None
    calibration, topic = prepared.camera.left, prepared.topic(role)
    try:
        image = rgb_image(read[role])
    except RecordingError as failure:
        raise RecordingError(f"{topic} {failure}") from failure
    refuse_other_size(image, calibration, topic)
    return image


def _points(prepared: Preparation, stamp: int, read: dict[Role, Any]) -> MeasuredPoints:
    role: Role = "points" if "points" in read else "depth"
    topic, track = prepared.topic(role), None
    try:
        if role == "points":
            positions, track = cloud_points(read[role], prepared.settings.id_field)
        else:
            assert prepared.depth_calibration is not None
            positions = depth_points(read[role], prepared.depth_calibration, prepared.settings.depth)
    except RecordingError as failure:
        raise RecordingError(f"{topic} {failure}") from failure
    name = frame_name(read[role].header.frame_id) or prepared.world
    T = prepared.tree.T_world(name, prepared.world, stamp, topic)
    if not np.array_equal(T, np.eye(4)):
        positions = positions @ T[:3, :3].T + T[:3, 3]
    known = {} if prepared.settings.noise_sd is None else {"sd": prepared.settings.noise_sd}
    return MeasuredPoints(positions=positions, track_id=track, sd_stated=bool(known), **known)


def _scene_seen(bag: Bag, prepared: Preparation, notes: list[str]) -> tuple[float, float] | None:
    """Return the range of the disparities in the first pair of images that can be used [px]; None where unknown.

    Raises:
        RecordingError: the topics of the cameras are swapped, or nothing tells whether they are.
    """
    if prepared.camera is None:
        return None
    for _, read in _read_frames(bag, prepared):
        try:
            pair = StereoPair(left=_image(prepared, "left", read), right=_image(prepared, "right", read))
        except RecordingError:
            continue
        found = disparities(prepared.camera, pair)
        right_order = left_is_left(found)
        if right_order is False or (right_order is None and prepared.order_unsure):
            raise RecordingError(
                f"{bag.path}: {prepared.topic('left')} was taken by the camera on the right"
                + (" (the scene lies further left in it)" if right_order is False else ", says the sign of P[0,3]")
                + "; swap the topics: --topic left=... --topic right=..., and left_info, right_info likewise."
            )
        if prepared.order_unsure:
            notes.append("P[0,3] of the right camera has the other sign; the images show which camera is on the left")
        return scene_range(found)
    return None


def _identity(prepared: Preparation) -> str:
    """Return the identity of the recording: the times of its frames, and where the tool was."""
    stamps = np.array([frame.stamp for frame in prepared.frames], np.int64)
    return identity(stamps - stamps[0], prepared.tool.times - stamps[0], prepared.tool.positions)
