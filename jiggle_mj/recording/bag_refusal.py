"""The refusal of a robot's bag where a recording is due, with the command that imports it."""

from pathlib import Path

from ..errors import RecordingError

BAG_SUFFIXES = (".bag", ".db3")
"""Suffixes of files that only a robot's bag has."""
BAG_ENCODINGS = ("cdr", "ros1")
"""Encodings of the messages of ROS 2 and ROS 1."""


def refuse_bag(path: Path, encoding: str = "") -> None:
    """Refuse a robot's bag, which must be imported first.

    Args:
        path: the file or folder.
        encoding: of the messages on one of its topics, where that is known.

    Raises:
        RecordingError: it is a bag; the message gives the command.
    """
    is_folder = path.is_dir() and ((path / "metadata.yaml").exists() or any(path.glob("*.db3")))
    if is_folder or (path.suffix in BAG_SUFFIXES and path.exists()) or encoding in BAG_ENCODINGS:
        raise RecordingError(
            f"{path} is a robot's bag; import it first: jiggle-mj import {path} --out run.mcap (docs/BAGS.md)."
        )
