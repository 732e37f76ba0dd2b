"""What is refused as a recording: a file that holds truth, and one that lacks what an estimate needs."""

from collections.abc import Collection
from pathlib import Path

from ..errors import RecordingError
from .topics import GRASP, LEFT, LEFT_INFO, POINTS, POSE, RIGHT, RIGHT_INFO

MAX_LISTED = 500
"""Most characters of topics that a message lists: those of a robot, shortened only where a name is absurd."""


def refuse_truth(path: Path, topic: str) -> None:
    """Refuse a file for one of its topics.

    Raises:
        RecordingError: the topic is one of truth, which the estimator must not see.
    """
    if topic.startswith("/truth/"):
        advice = f" (pass {path.name.replace('.truth.', '.')})" if ".truth." in path.name else ""
        raise RecordingError(f"{path.name} holds /truth topics; the estimator reads observations only{advice}.")


def refuse_incomplete(path: Path, present: set[str], ignored: Collection[str]) -> None:
    """Refuse a file that lacks the tool, both a stereo pair and points, or the calibration of its images.

    Args:
        path: the file, for the message.
        present: its topics that are read and hold messages.
        ignored: its other topics.

    Raises:
        RecordingError: something is missing; the message says what.
    """
    has_images = LEFT in present or RIGHT in present
    sensors = f"{POINTS} or the pair {LEFT}, {RIGHT}"
    if not present:
        raise RecordingError(
            f"{path} is foreign: it needs {POSE}, {GRASP} and {sensors}; its topics are: {_listed(ignored)}."
        )
    missing = [topic for topic in (POSE, GRASP) if topic not in present]
    if (LEFT in present) != (RIGHT in present):
        missing.append(LEFT if RIGHT in present else RIGHT)
    if not (has_images or POINTS in present):
        missing.append(sensors)
    if missing:
        raise RecordingError(
            f"{path} lacks {' and '.join(missing)}; its topics are: {_listed(present | set(ignored))}."
        )
    uncalibrated = [topic for topic in (LEFT_INFO, RIGHT_INFO) if topic not in present]
    if has_images and uncalibrated:
        raise RecordingError(f"{path} has images but no calibration: it lacks {' and '.join(uncalibrated)}.")


def _listed(topics: Collection[str]) -> str:
    """Return names of topics for a message, in the order of names, as far as there is room."""
    names = ", ".join(sorted(topics)) or "none"
    return names if len(names) <= MAX_LISTED else f"{names[:MAX_LISTED]}..., {len(topics)} in all"
