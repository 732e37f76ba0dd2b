"""The first pass over a bag: its clock, its small messages, and the stamps of its images and clouds.

Images and clouds are not kept; `importer` reads them in a second pass, frame by frame.
"""

from dataclasses import dataclass, field
from typing import Any

from ...errors import RecordingError
from .bag_file import Bag
from .roles import TF_TYPES, RoleChoice
from .settings import BagSettings, Role
from .stamps import TopicTimes, header_stamp, refuse_two_clocks, topic_times
from .transforms import TransformTree, frame_name

HEAVY: tuple[Role, ...] = ("left", "right", "points", "depth")
"""Roles whose messages are not kept."""


@dataclass(frozen=True, kw_only=True)
class BagSurvey:
    """What the first pass found."""

    times: dict[Role, TopicTimes]
    """Times of the messages of each role that is a topic."""
    messages: dict[Role, list[Any]]
    """Messages of the roles that are kept, in the order of the bag."""
    frame: dict[Role, str]
    """Coordinate frame of the first message of each role; empty where it names none."""
    tree: TransformTree
    """All coordinate frames."""
    notes: list[str] = field(default_factory=list)
    """What the user should know."""


def survey_bag(bag: Bag, roles: dict[Role, RoleChoice], settings: BagSettings) -> BagSurvey:
    """Read a bag once.

    Args:
        bag: the open bag.
        roles: topic of each role.
        settings: what the user says.

    Raises:
        RecordingError: damaged, without messages on a topic, of two clocks, or time that goes backwards.
    """
    role_of: dict[str, list[Role]] = {}
    for role, choice in roles.items():
        if choice.frame is None:
            role_of.setdefault(choice.topic, []).append(role)
    tf_topics = {topic.name for topic in bag.topics.values() if topic.type in TF_TYPES and topic.count}
    headers: dict[str, list[int | None]] = {name: [] for name in role_of}
    received: dict[str, list[int]] = {name: [] for name in role_of}
    messages: dict[Role, list[Any]] = {role: [] for role in roles if role not in HEAVY}
    frame: dict[Role, str] = {}
    tree = TransformTree()
    for message in bag.messages([*role_of, *tf_topics]):
        if message.topic in tf_topics:
            for transform in message.content.transforms:
                stamp = header_stamp(transform)
                by_header = settings.clock == "header" and stamp
                tree.add(transform, stamp if by_header and stamp is not None else message.received)
            continue
        headers[message.topic].append(header_stamp(message.content))
        received[message.topic].append(message.received)
        for role in role_of[message.topic]:
            header = getattr(message.content, "header", None)
            frame.setdefault(role, frame_name(header.frame_id) if header is not None else "")
            if role not in HEAVY:
                messages[role].append(message.content)
    times: dict[Role, TopicTimes] = {}
    notes: list[str] = []
    for name, its_roles in role_of.items():
        if not received[name]:
            raise RecordingError(f"{name} ({its_roles[0]}) holds no message; record it again, or name another topic.")
        of_topic = topic_times(name, headers[name], received[name], settings.clock)
        if of_topic.n_zero and settings.clock == "header":
            notes.append(
                f"{name}: {of_topic.n_zero} of {len(received[name])} messages have no stamp; its times are those of "
                "receipt"
            )
        n_twice = len(of_topic.stamps) - len(of_topic.order)
        if n_twice and not name.endswith("camera_info"):
            notes.append(f"{name}: {n_twice} messages have the stamp of an earlier one and are left out")
        times |= {role: of_topic for role in its_roles}
    notes += tree.left_out()
    clocked = [each for role, each in times.items() if role not in ("left_info", "right_info", "depth_info")]
    refuse_two_clocks(clocked)
    return BagSurvey(times=times, messages=messages, frame=frame, tree=tree, notes=notes)
