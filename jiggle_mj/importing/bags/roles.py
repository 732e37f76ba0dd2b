"""Which topic of a bag is for what: guessed from types and names, settled by the user.

A guess must be the only best one; else the candidates are listed and nothing is taken. Every choice is reported.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass

from ...errors import RecordingError
from .bag_file import BagTopic
from .bag_paths import listed
from .settings import ROLES, Role

IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
TYPES: dict[Role, tuple[str, ...]] = {
    "left": IMAGE_TYPES,
    "right": IMAGE_TYPES,
    "left_info": ("sensor_msgs/msg/CameraInfo",),
    "right_info": ("sensor_msgs/msg/CameraInfo",),
    "tool": ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped"),
    "gripper": (
        "sensor_msgs/msg/JointState",
        "std_msgs/msg/Bool",
        "std_msgs/msg/Float64",
        "std_msgs/msg/Float32",
        "std_msgs/msg/String",
    ),
    "points": ("sensor_msgs/msg/PointCloud2",),
    "depth": ("sensor_msgs/msg/Image",),
    "depth_info": ("sensor_msgs/msg/CameraInfo",),
    "force": ("geometry_msgs/msg/WrenchStamped",),
}
"""Types that a topic of each role may have."""
IMAGE_OF: dict[Role, Role] = {"left_info": "left", "right_info": "right", "depth_info": "depth"}
"""Role of the images that each CameraInfo describes."""
TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
"""Types of /tf and /tf_static."""
LEFT_WORDS, RIGHT_WORDS = {"left", "l", "cam0", "camera0", "infra1"}, {"right", "r", "cam1", "camera1", "infra2"}
"""Words in a topic's name that say which camera it is."""
TRANSPORTS = ("compressed", "compressedDepth", "theora")
"""Last words of a topic that a ROS image transport adds."""
WORDS: dict[Role, set[str]] = {
    "tool": {"tool", "tip", "tcp", "ee", "psm", "psm1", "psm2", "psm3", "cp", "eef"},
    "gripper": {"gripper", "jaw", "jaws", "grasp", "grasper", "closed", "finger", "fingers"},
    "points": {"tissue", "tracked", "tracks", "points"},
    "depth": {"depth"},
    "force": {"tool", "tip", "wrench", "force", "ft"},
}
"""Words in a topic's name that speak for a role."""
COMMANDS = {"setpoint", "desired", "goal", "target", "command", "cmd", "reference", "servo"}
"""Words of topics that say where a robot should be, not where it is."""


@dataclass(frozen=True, kw_only=True)
class RoleChoice:
    """The topic that was chosen for a role."""

    topic: str
    """Name of the topic, or `tf:FRAME` for a tool that is a frame of /tf."""
    by_user: bool
    """Whether the user named it; else it was guessed."""

    @property
    def frame(self) -> str | None:
        """Return the frame of /tf that stands for a topic; None for a topic."""
        return self.topic.removeprefix("tf:") if self.topic.startswith("tf:") else None


def choose_roles(
    topics: dict[str, BagTopic], named: dict[Role, str]
) -> tuple[dict[Role, RoleChoice], dict[Role, list[str]]]:
    """Return the topic of each role, and the candidates of roles that need the user's word.

    Args:
        topics: all topics of the bag.
        named: topics that the user names; an empty name leaves the role without a topic.

    Raises:
        RecordingError: a named topic is not in the bag, is empty, or is not of a type for its role.
    """
    chosen: dict[Role, RoleChoice] = {}
    unsure: dict[Role, list[str]] = {}
    for role, name in named.items():
        if name:
            if not (role == "tool" and name.startswith("tf:")):
                _refuse_unfit(role, name, topics)
            chosen[role] = RoleChoice(topic=name, by_user=True)
    for role in ROLES:
        if role in named or (role in ("points", "depth", "depth_info") and {"left", "right"} <= set(chosen)):
            continue
        if role in ("depth", "depth_info") and "points" in chosen:
            continue
        best = _best(role, topics, chosen)
        if len(best) == 1:
            chosen[role] = RoleChoice(topic=best[0], by_user=False)
        elif best:
            unsure[role] = best
    if "left" in chosen and "right" in chosen and chosen["left"].topic == chosen["right"].topic:
        raise RecordingError(f"{chosen['left'].topic} is named for both left and right; they are two cameras.")
    for role, image in IMAGE_OF.items():
        if image not in chosen and role not in named:
            chosen.pop(role, None)
            unsure.pop(role, None)
    return chosen, unsure


def is_rectified(topic: str) -> bool:
    """Return whether a topic's name says that its images are rectified, as ROS's image_proc names them."""
    return any(word == "rect" or word.startswith("rectified") for word in _words(topic))


def _refuse_unfit(role: Role, name: str, topics: dict[str, BagTopic]) -> None:
    if name not in topics:
        raise RecordingError(f"the bag has no topic '{name[:200]}' for {role}; it has: {listed(topics)}.")
    if topics[name].type not in TYPES[role]:
        raise RecordingError(f"{name} is {topics[name].type}; a topic for {role} must be {' or '.join(TYPES[role])}.")
    if not topics[name].count:
        raise RecordingError(f"{name} ({role}) holds no message; record it again, or name another topic.")


def _best(role: Role, topics: dict[str, BagTopic], chosen: dict[Role, RoleChoice]) -> list[str]:
    """Return the candidates of a role with the best rank."""
    fit = [topic for topic in topics.values() if topic.type in TYPES[role] and topic.count]
    if role in ("left_info", "right_info", "depth_info"):
        return _info_of(role, [topic.name for topic in fit], chosen)
    if role in ("left", "right"):
        side = LEFT_WORDS if role == "left" else RIGHT_WORDS
        fit = [topic for topic in fit if set(_words(topic.name)) & side and not _is_depth(topic)]
        if role == "right" and "left" in chosen:
            twins = [topic.name for topic in fit if _neutral(topic.name) == _neutral(chosen["left"].topic)]
            if len(twins) == 1:
                return twins
    elif role == "depth":
        fit = [topic for topic in fit if _is_depth(topic)]
    elif role == "gripper":
        spoken = [topic for topic in fit if set(_words(topic.name)) & WORDS[role]]
        fit = spoken or [topic for topic in fit if topic.type != "std_msgs/msg/String"]
    ranks = {topic.name: _rank(role, topic) for topic in fit}
    return sorted(name for name, rank in ranks.items() if rank == max(ranks.values()))


def _rank(role: Role, topic: BagTopic) -> tuple[int, ...]:
    words = set(_words(topic.name))
    if role in ("left", "right", "depth"):
        compressed = topic.type.endswith("CompressedImage")
        return (-("mono" in words), -("rect" in words), -compressed)
    return (-bool(words & COMMANDS), bool(words & WORDS[role]))


def _info_of(role: Role, infos: list[str], chosen: dict[Role, RoleChoice]) -> list[str]:
    """Return the CameraInfo of the image's namespace, or those that share its word for the side."""
    image = chosen.get(IMAGE_OF[role])
    if image is None:
        return []
    parts = [part for part in image.topic.split("/") if part not in TRANSPORTS]
    for length in range(len(parts) - 1, 0, -1):
        beside = [name for name in infos if name == "/".join([*parts[:length], "camera_info"])]
        if beside:
            return beside
    side = {"left": LEFT_WORDS, "right": RIGHT_WORDS, "depth": WORDS["depth"]}[IMAGE_OF[role]]
    return [name for name in infos if set(_words(name)) & side]


def _is_depth(topic: BagTopic) -> bool:
    return bool({"depth", "compresseddepth", "disparity"} & set(_words(topic.name)))


def _neutral(name: str) -> str:
    """Return a topic's name with one word for both sides."""
    return " ".join("side" if word in LEFT_WORDS | RIGHT_WORDS else word for word in _words(name))


def _words(name: str) -> Iterable[str]:
    return [word.lower() for word in re.split(r"[/_\-]", name) if word]
