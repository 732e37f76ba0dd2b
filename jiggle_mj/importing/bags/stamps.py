"""The times of a bag's messages: their own stamps, or the recorder's where they have none.

A header's stamp says when the sensor measured; the time of receipt adds the network's delay. Both must be of one clock
where a topic without header is read beside topics with one.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...errors import RecordingError
from .settings import Clock

MAX_BACKWARDS = 1_000_000_000
"""Longest step back of a topic's stamps [ns]: messages overtake each other by less; a clock that was reset, by more."""
MAX_CLOCK_OFFSET = 1_000_000_000
"""Largest median difference of stamp and receipt at which both are of one clock [ns]."""
NS_PER_S = 1_000_000_000


@dataclass(frozen=True, kw_only=True)
class TopicTimes:
    """When the messages of a topic were taken."""

    topic: str
    """Name of the topic."""
    stamps: tuple[int, ...]
    """Time of each message in the order of the bag [ns]."""
    by_header: bool
    """Whether the stamps are the headers'; else they are the times of receipt."""
    offset: int
    """Median of receipt minus header stamp [ns]; 0 without headers."""
    n_zero: int
    """Number of messages whose header has no stamp."""

    @property
    def order(self) -> list[int]:
        """Return the numbers of the messages by their stamps; of several with one stamp the first."""
        stamps = np.array(self.stamps, np.int64)
        return np.unique(stamps, return_index=True)[1].tolist()


def header_stamp(message: Any) -> int | None:
    """Return the stamp in a message's header [ns]; 0 where it is not set, None without a header."""
    header = getattr(message, "header", None)
    if header is None:
        return None
    return int(header.stamp.sec) * NS_PER_S + int(header.stamp.nanosec)


def topic_times(topic: str, headers: Sequence[int | None], received: Sequence[int], clock: Clock) -> TopicTimes:
    """Return the times of a topic's messages; a topic of which one header has no stamp goes by the times of receipt.

    Args:
        topic: name of the topic.
        headers: result of `header_stamp` for each message.
        received: times of receipt [ns].
        clock: which of them is wanted.

    Raises:
        RecordingError: no message has a time, or time goes backwards by more than `MAX_BACKWARDS`.
    """
    n_zero = sum(stamp == 0 for stamp in headers)
    known = [stamp for stamp in headers if stamp]
    by_header = clock == "header" and len(known) == len(headers) > 0
    stamps = tuple(known) if by_header else tuple(int(time) for time in received)
    if len(stamps) > 1 and not any(stamps):
        raise RecordingError(f"{topic}: neither the headers nor the bag give its messages a time; record it again.")
    offset = int(np.median(np.array(received) - np.array(known))) if len(known) == len(headers) > 0 else 0
    steps = np.diff(np.array(stamps, np.int64))
    if len(steps) and steps.min() < -MAX_BACKWARDS:
        place = int(steps.argmin())
        cure = " --clock receive goes by the time of receipt." if by_header else ""
        raise RecordingError(
            f"{topic}: time goes backwards by {-steps[place] / NS_PER_S:.4g} s after message {place + 1} (a simulation "
            f"that was reset, or two bags in one?); split the bag there.{cure}"
        )
    return TopicTimes(topic=topic, stamps=stamps, by_header=by_header, offset=offset, n_zero=n_zero)


def refuse_two_clocks(times: Iterable[TopicTimes], others: Iterable[TopicTimes] = ()) -> None:
    """Refuse headers of another clock than the recorder's where some topic has only the recorder's.

    Args:
        times: the topics that are used.
        others: topics with headers that only tell the clocks apart.

    Raises:
        RecordingError: both kinds are used and their clocks differ.
    """
    used = list(times)
    received = [each.topic for each in used if not each.by_header]
    for each in [*used, *others]:
        if each.by_header and received and abs(each.offset) > MAX_CLOCK_OFFSET:
            raise RecordingError(
                f"the stamps of {each.topic} are {abs(each.offset) / NS_PER_S:.6g} s from the times of receipt, and "
                f"{received[0]} has only times of receipt: two clocks. Give --clock receive."
            )


def refuse_apart(frames: Sequence[int], frames_topic: str, stamps: Sequence[int], topic: str) -> None:
    """Refuse two topics whose times do not overlap.

    Args:
        frames: stamps of the frames [ns].
        frames_topic: their topic.
        stamps: stamps of another topic [ns].
        topic: its name.

    Raises:
        RecordingError: they do not overlap; the message gives both spans.
    """
    if not len(stamps) or max(stamps) < min(frames) or min(stamps) > max(frames):

        def span(values: Sequence[int]) -> str:
            return f"{min(values) / NS_PER_S:.3f} to {max(values) / NS_PER_S:.3f} s" if len(values) else "nothing"

        raise RecordingError(
            f"{topic} ({span(stamps)}) and {frames_topic} ({span(frames)}) do not overlap in time; are their clocks "
            "different? --clock receive goes by the time of receipt."
        )
