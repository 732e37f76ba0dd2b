"""All that an import knows before it reads the first image: camera, tool, jaws, frames and what to say about them."""

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from ...camera import CameraCalibration, StereoCamera
from ...errors import RecordingError
from ...observation import Declaration, MeasuredPoints
from ...recording.force import NO_TORQUE, ToolForce
from ...recording.schemas import WORLD
from .bag_camera import bag_camera
from .bag_file import Bag
from .bag_paths import listed
from .calibration import parse_camera_info
from .gripper import ALWAYS, JawState, jaw_states, jaw_value
from .missing import missing_roles
from .roles import RoleChoice
from .settings import MS, BagSettings, Role
from .stamps import refuse_apart
from .stereo_pairs import pair_images
from .survey import BagSurvey, survey_bag
from .tool_track import ToolTrack
from .transforms import TransformTree, frame_name

CLOUD_TOLERANCE = 5 * MS
"""Largest difference of the stamps of a cloud and a left image of one frame [ns]."""


@dataclass(frozen=True, kw_only=True)
class FrameParts:
    """The messages that make one frame."""

    stamp: int
    """Time of the frame: that of its left image, cloud or depth image [ns]."""
    parts: dict[Role, int]
    """Number of the message of each role within its topic."""


@dataclass(frozen=True, kw_only=True)
class Preparation:
    """What an import knows before the images."""

    settings: BagSettings
    """What the user says."""
    roles: dict[Role, RoleChoice]
    """Topic of each role."""
    tree: TransformTree
    """All coordinate frames."""
    world: str
    """Frame that counts as the world."""
    camera: StereoCamera | None
    """The stereo camera; None without a pair."""
    order_unsure: bool
    """Whether only the images can tell the left camera from the right one."""
    depth_calibration: CameraCalibration | None
    """Calibration of the depth camera; None without depth."""
    declaration: Declaration
    """The user's prior knowledge of the tissue."""
    tool: ToolTrack
    """Where the tip is."""
    jaws: list[JawState]
    """The jaws, by time."""
    forces: list[ToolForce]
    """Forces on the tool, by time on the bag's clock."""
    frames: list[FrameParts]
    """The frames to come, by time."""
    notes: tuple[str, ...]
    """What was measured, assumed or left out."""

    def topic(self, role: Role) -> str:
        """Return the topic of a role."""
        return self.roles[role].topic


def prepare(
    bag: Bag, roles: dict[Role, RoleChoice], unsure: dict[Role, list[str]], settings: BagSettings
) -> Preparation:
    """Read all of a bag but its images and clouds.

    Args:
        bag: the open bag.
        roles: topic of each role.
        unsure: candidates of roles that need the user's word.
        settings: what the user says.

    Raises:
        RecordingError: something that an estimate needs is missing or contradicts itself.
    """
    missing = missing_roles(roles, unsure, settings)
    if missing:
        raise RecordingError(f"{bag.path} lacks {'; '.join(missing)}. 'jiggle-mj inspect {bag.path}' lists its topics.")
    stereo = {"left", "right"} <= set(roles)
    if stereo and not any(roles[role].by_user for role in ("points", "depth") if role in roles):
        roles = {role: choice for role, choice in roles.items() if role not in ("points", "depth", "depth_info")}
    survey = survey_bag(bag, roles, settings)
    notes = list(survey.notes)
    main: Role = "left" if stereo else "points" if "points" in roles else "depth"
    world, declaration = _world(survey, main, settings, notes)
    tool = _tool(survey, roles, world, notes).scaled(settings.tool_unit)
    camera, order_unsure = None, False
    if stereo:
        camera, order_unsure = bag_camera(bag, survey, roles, settings, world, tool, notes)
    depth = None
    if main == "depth":
        info = survey.messages["depth_info"][0]
        depth = parse_camera_info(info, roles["depth_info"].topic, survey.frame["depth_info"]).calibration
    if main != "left" and settings.noise_sd is None:
        notes.append(
            f"noise of the points: {1e3 * MeasuredPoints.sd:g} mm is assumed; say yours with [points] noise_sd in "
            "map.toml"
        )
    frames = _frames(survey, main, settings, notes)
    stamps = [frame.stamp for frame in frames]
    refuse_apart(stamps, roles[main].topic, tool.times.tolist(), roles["tool"].topic)
    return Preparation(
        settings=settings,
        roles=roles,
        tree=survey.tree,
        world=world,
        camera=camera,
        order_unsure=order_unsure,
        depth_calibration=depth,
        declaration=declaration,
        tool=tool,
        jaws=_jaws(survey, roles, settings, stamps, notes),
        forces=_forces(survey, world, settings.force_sd, notes),
        frames=frames,
        notes=tuple(notes),
    )


def _world(survey: BagSurvey, main: Role, settings: BagSettings, notes: list[str]) -> tuple[str, Declaration]:
    """Return the frame that counts as the world, and the declaration, without gravity where up is unknown."""
    sensor, tree = survey.frame[main], survey.tree
    world = settings.world or (tree.root(sensor) if sensor else "world")
    if settings.world is not None and settings.world not in tree.names and settings.world != sensor:
        raise RecordingError(f"/tf has no frame '{settings.world[:200]}'; it has: {listed(sorted(tree.names))}.")
    if world == sensor and settings.declaration is None and "optical" in world:
        notes.append(f"the world is the camera's frame '{world}', whose vertical is unknown: gravity is left out")
        return world, replace(Declaration(), gravity=(0.0, 0.0, 0.0), bed=False)
    notes.append(f"the world is the frame '{world}', z up")
    return world, settings.declaration or Declaration()


def _frames(survey: BagSurvey, main: Role, settings: BagSettings, notes: list[str]) -> list[FrameParts]:
    times = survey.times[main]
    if main != "left":
        return [FrameParts(stamp=times.stamps[number], parts={main: number}) for number in times.order]
    rights = survey.times["right"]
    pairs = pair_images(times.stamps, rights.stamps, settings.pairing_tolerance_ms)
    notes.append(pairs.summary())
    clouds = survey.times.get("points")
    order = [] if clouds is None else clouds.order
    known = np.array([] if clouds is None else [clouds.stamps[number] for number in order], np.int64)
    frames: list[FrameParts] = []
    for left, right in zip(pairs.left.tolist(), pairs.right.tolist(), strict=True):
        parts: dict[Role, int] = {"left": left, "right": right}
        stamp = times.stamps[left]
        if len(known):
            nearest = int(np.abs(known - stamp).argmin())
            if abs(int(known[nearest]) - stamp) <= CLOUD_TOLERANCE:
                parts["points"] = order[nearest]
        frames.append(FrameParts(stamp=stamp, parts=parts))
    return frames


def _tool(survey: BagSurvey, roles: dict[Role, RoleChoice], world: str, notes: list[str]) -> ToolTrack:
    frame = roles["tool"].frame
    if frame is not None:
        tool = ToolTrack.from_frame(frame, survey.tree, world)
    else:
        tool = ToolTrack.from_messages(survey.messages["tool"], survey.times["tool"], survey.tree, world)
    topic = roles["tool"].topic
    if tool.n_dropped:
        why = tool.why_dropped or f"not joined to '{world}' at their time"
        notes.append(f"{topic}: {tool.n_dropped} poses are left out: {why}")
    if not tool.rotates:
        notes.append(f"{topic}: no pose has an orientation (all quaternions are 0), so the tool does not rotate")
    return tool


def _jaws(
    survey: BagSurvey,
    roles: dict[Role, RoleChoice],
    settings: BagSettings,
    stamps: list[int],
    notes: list[str],
) -> list[JawState]:
    rule = settings.closed
    if "gripper" not in roles or (rule is not None and rule.comparison == ALWAYS):
        notes.append("the jaws are taken as closed in all frames (--closed always)")
        return [JawState(time=stamps[0], closed=True, grasp=1)]
    times, messages = survey.times["gripper"], survey.messages["gripper"]
    values = [jaw_value(messages[number], rule, times.topic) for number in times.order]
    ordered = [times.stamps[number] for number in times.order]
    refuse_apart(stamps, "the frames", ordered, times.topic)
    states, n_short = jaw_states(ordered, values, rule, times.topic)
    if n_short:
        notes.append(
            f"{times.topic}: {n_short} grasps are shorter than 0.1 s; is that noise around the limit of --closed?"
        )
    if stamps[0] + CLOUD_TOLERANCE < ordered[0]:
        early = sum(stamp + CLOUD_TOLERANCE < ordered[0] for stamp in stamps)
        notes.append(f"{times.topic} begins after {early} frames; the jaws count as open until then")
    closes = "closed as its messages say" if rule is None else str(rule)
    notes.append(f"gripper: {closes}")
    return states


def _forces(survey: BagSurvey, world: str, sd: float | None, notes: list[str]) -> list[ToolForce]:
    """Return the forces on the tool in the world, without those whose frame /tf does not join to it at their time.

    Where it joins none, all keep their frame, by which a reader says why they are not used.
    """
    if "force" not in survey.messages:
        return []
    times, joined, apart, n_without = survey.times["force"], list[ToolForce](), list[ToolForce](), 0
    for number in times.order:
        message, time = survey.messages["force"][number], times.stamps[number]
        force, torque = (np.array([each.x, each.y, each.z]) for each in (message.wrench.force, message.wrench.torque))
        n_without += not np.isfinite(force).all()
        frame, found = frame_name(message.header.frame_id) or world, joined
        try:
            rotation = survey.tree.T_world(frame, world, time, times.topic)[:3, :3]
        except RecordingError:
            rotation, found = np.eye(3), apart
        else:
            frame = WORLD
        x, y, z = (rotation @ force).tolist()
        # A sensor of forces alone may report torques of NaN; nothing is computed from them.
        u, v, w = (rotation @ torque).tolist() if np.isfinite(torque).all() else NO_TORQUE
        found.append(ToolForce(time=time, force=(x, y, z), torque=(u, v, w), frame_id=frame, sd=sd))
    if n_without:
        notes.append(
            f"{times.topic}: {n_without} of {len(times.order)} forces are not finite, and count as not measured"
        )
    for frame, count in Counter(force.frame_id for force in apart).items():
        notes.append(
            f"{times.topic}: {count} forces are not used: /tf does not join '{frame}' to '{world}' at their time"
        )
    # A frame of the bag that has the name of a recording's world would be taken for it.
    return joined or [force for force in apart if force.frame_id != WORLD]
