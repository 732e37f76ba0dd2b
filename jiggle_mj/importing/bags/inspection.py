"""What is in a bag or a recording: topics, types, counts, rates, frames, spans, and what an estimate lacks.

Reads a bag from end to end, as counts and spans need; decodes only the messages of types that an import reads.
"""

from collections import Counter, defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import RecordingError
from ...recording.reader import Recording
from .bag_file import ROS_ENCODINGS, Bag
from .bag_paths import refusing
from .missing import missing_roles
from .roles import TF_TYPES, TYPES, RoleChoice, choose_roles
from .settings import BagSettings, Role
from .stamps import NS_PER_S, header_stamp
from .transforms import frame_name


@dataclass(frozen=True, kw_only=True)
class TopicReport:
    """One topic, as `jiggle-mj inspect` prints it."""

    name: str
    """Name of the topic."""
    type: str
    """Type of its messages."""
    count: int
    """Number of its messages."""
    rate: float | None
    """Messages per second, from the median time between two; None for fewer than two."""
    span: tuple[float, float] | None
    """First and last time, from the first message of the bag [s]; None without messages."""
    frames: tuple[str, ...]
    """Coordinate frames of its messages; of /tf each as `parent > child`."""
    stamped: bool | None
    """Whether every header has a stamp; None without headers."""
    role: str | None
    """What an import takes it for; None for nothing."""


@dataclass(frozen=True, kw_only=True)
class BagReport:
    """What `jiggle-mj inspect` prints."""

    path: Path
    """The bag or recording."""
    kind: str
    """What it is: a ROS bag or a recording."""
    topics: tuple[TopicReport, ...]
    """Its topics by name."""
    missing: tuple[str, ...]
    """What an estimate lacks, one sentence each; empty where nothing does."""
    next_command: str
    """What to run next."""


@dataclass
class _Found:
    """Times and frames of a topic, as they come."""

    received: list[int] = field(default_factory=list)
    stamps: list[int | None] = field(default_factory=list)
    frames: set[str] = field(default_factory=set)


def inspect_bag(path: Path, settings: BagSettings | None = None) -> BagReport:
    """Return what is in a bag, or in a recording of ours.

    Args:
        path: the bag or recording.
        settings: what the user says about the bag.

    Raises:
        RecordingError: missing, damaged, or neither.
    """
    settings = settings or BagSettings()
    with Bag(path, allow_truncated=settings.allow_truncated) as bag, refusing(path, "a message"):
        ours = not any(topic.encoding in ROS_ENCODINGS for topic in bag.topics.values())
        roles: dict[Role, RoleChoice] = {}
        unsure: dict[Role, list[str]] = {}
        if not ours:
            roles, unsure = choose_roles(bag.topics, settings.topics)
        found = _times(bag)
        start = min((min(each.received) for each in found.values() if each.received), default=0)
        role_of = {choice.topic: role for role, choice in roles.items()}
        topics = tuple(
            _report(topic.name, topic.type, found[topic.name], start, role_of.get(topic.name))
            for topic in bag.topics.values()
        )
    if ours:
        return BagReport(
            path=path,
            kind="recording",
            topics=topics,
            missing=_recording_lacks(path, allow_truncated=settings.allow_truncated),
            next_command=f"jiggle-mj estimate {path} --out out/estimate",
        )
    missing = missing_roles(roles, unsure, settings)
    if "gripper" in roles and bag.topics[roles["gripper"].topic].type != "std_msgs/msg/Bool":
        missing.append("when the jaws are closed: say it with --closed, for example --closed 'jaw<0.1' (docs/BAGS.md)")
    return BagReport(
        path=path,
        kind="ROS bag",
        topics=topics,
        missing=tuple(missing),
        next_command=f"jiggle-mj import {path} --out run.mcap" + (" with what is missing" if missing else ""),
    )


def _times(bag: Bag) -> dict[str, _Found]:
    """Return times and frames by topic; messages of types that no import reads are counted by `bag.topics` alone."""
    known = {name for types in TYPES.values() for name in types} | set(TF_TYPES)
    found: dict[str, _Found] = defaultdict(_Found)
    readable = [
        topic.name
        for topic in bag.topics.values()
        if topic.type in known and topic.encoding in ROS_ENCODINGS and topic.count
    ]
    for message in bag.messages(readable):
        each = found[message.topic]
        each.received.append(message.received)
        each.stamps.append(header_stamp(message.content))
        each.frames |= _frames(message.content)
    for name, received, _ in bag.raw(set(bag.topics) - set(readable)):
        found[name].received.append(received)
    return found


def _frames(content: Any) -> set[str]:
    if hasattr(content, "transforms"):
        return {
            f"{frame_name(each.header.frame_id)} > {frame_name(each.child_frame_id)}" for each in content.transforms
        }
    name = frame_name(content.header.frame_id) if hasattr(content, "header") else ""
    return {name} if name else set()


def _report(name: str, kind: str, found: _Found, start: int, role: str | None) -> TopicReport:
    times = np.sort(np.array(found.received, np.int64))
    steps = np.diff(times)
    headers = [stamp for stamp in found.stamps if stamp is not None]
    return TopicReport(
        name=name,
        type=kind,
        count=len(times),
        rate=float(NS_PER_S / np.median(steps)) if len(steps) and np.median(steps) > 0 else None,
        span=((times[0] - start) / NS_PER_S, (times[-1] - start) / NS_PER_S) if len(times) else None,
        frames=tuple(sorted(found.frames)),
        stamped=all(headers) if headers else None,
        role=role,
    )


def _recording_lacks(path: Path, *, allow_truncated: bool) -> tuple[str, ...]:
    """Return why a recording cannot be estimated; empty where it can."""
    try:
        recording = Recording.open(path, allow_truncated=allow_truncated)
        usable = sum(1 for _ in recording)
    except RecordingError as failure:
        return (str(failure),)
    if not recording.skipped:
        return ()
    reason, count = Counter(why for _, why in recording.skipped).most_common(1)[0]
    return (f"{len(recording.skipped)} of {usable + len(recording.skipped)} frames; {count} times: {reason}",)
