"""What a bag lacks for an estimate, in words, with the cure: for an import that must stop, and for `inspect`."""

from collections.abc import Mapping

from ...errors import RecordingError
from ...recording.topics import GRASP, POSE
from .bag_file import ROS_ENCODINGS, Bag
from .bag_paths import listed
from .gripper import ALWAYS
from .roles import TYPES, RoleChoice
from .settings import BagSettings, Role

NEEDS: dict[Role, str] = {
    "left": "a left image",
    "right": "a right image",
    "left_info": "the left camera's CameraInfo",
    "right_info": "the right camera's CameraInfo",
    "tool": "the pose of the tool",
    "gripper": "the state of the gripper",
    "depth_info": "the depth camera's CameraInfo",
}
"""What each role that can be missing stands for."""


def refuse_foreign(bag: Bag) -> None:
    """Refuse a bag without a message of ROS.

    Raises:
        RecordingError: it is a recording already, or a file of other messages, or empty.
    """
    topics = bag.topics.values()
    if any(topic.encoding in ROS_ENCODINGS for topic in topics):
        return
    if not topics:
        raise RecordingError(f"{bag.path} is empty: it has no topic; record it again.")
    if POSE in bag.topics and GRASP in bag.topics:
        raise RecordingError(f"{bag.path} is a recording already; use it: jiggle-mj estimate {bag.path} --out DIR.")
    encodings = sorted({f"{topic.type} ({topic.encoding})" for topic in topics})
    raise RecordingError(
        f"{bag.path} holds no message of ROS 1 or ROS 2, but {listed(encodings)}; a file of "
        "Foxglove's messages is a recording if its topics have the names in docs/RECORDINGS.md."
    )


def missing_roles(
    roles: Mapping[Role, RoleChoice], unsure: Mapping[Role, list[str]], settings: BagSettings
) -> list[str]:
    """Return what is missing, one sentence each; empty where an import can begin.

    Args:
        roles: the topics that were chosen.
        unsure: candidates of roles that need the user's word.
        settings: what the user says.
    """
    stereo = {"left", "right"} <= set(roles)
    needed: list[Role] = ["tool"]
    found: list[str] = []
    if settings.closed is None or settings.closed.comparison != ALWAYS:
        needed.append("gripper")
    if stereo or not {"points", "depth"} & set(roles):
        if not {"left", "right"} & (set(roles) | set(unsure)):
            found.append(
                "images of both cameras (name them: --topic left=... --topic right=...), tracked points (--topic "
                "points=...) or depth (--topic depth=...)"
            )
        else:
            needed.extend(("left", "right"))
        if "left" in roles and "left" not in settings.camera_info:
            needed.append("left_info")
        if "right" in roles and "right" not in settings.camera_info:
            needed.append("right_info")
    elif "points" not in roles:
        needed.append("depth_info")
    for role in needed:
        if role in roles:
            continue
        if role in unsure:
            found.append(f"{NEEDS[role]}: one of {listed(unsure[role])} (--topic {role}=TOPIC)")
        else:
            found.append(f"{NEEDS[role]} ({_cure(role)})")
    return found


def _cure(role: Role) -> str:
    types = " or ".join(name.rpartition("/")[2] for name in TYPES[role])
    extra = {
        "gripper": "; a bag of one grasp: --closed always",
        "tool": "; a frame of /tf: --topic tool=tf:FRAME",
        "left_info": "; a file: --camera-info left=FILE",
        "right_info": "; a file: --camera-info right=FILE",
    }.get(role, "")
    return f"--topic {role}=TOPIC of type {types}{extra}"
