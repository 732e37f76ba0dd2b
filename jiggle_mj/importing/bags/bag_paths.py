"""The files of a ROS bag: which there are, whether they are whole, and one line for whatever a library raises."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ...errors import JiggleError, RecordingError
from ..points.frame_order import natural_key

STORAGE_SUFFIXES = (".mcap", ".db3")
"""Suffixes of the files that a ROS 2 bag consists of."""
SQLITE_HEADER = 100
"""Bytes of the header of an SQLite file."""
SHOWN_NAMES, SHOWN_NAME = 16, 80
"""How many names a message lists, and how many characters of each."""
SHOWN_REASON = 200
"""Characters of a library's own reason that a message shows."""


def listed(names: Iterable[str]) -> str:
    """Return names for a message: the first `SHOWN_NAMES`, shortened to `SHOWN_NAME` characters each."""
    every = list(names)
    more = f" and {len(every) - SHOWN_NAMES} more" if len(every) > SHOWN_NAMES else ""
    return (", ".join(name[:SHOWN_NAME] for name in every[:SHOWN_NAMES]) + more) or "none"


def is_bag(path: Path) -> bool:
    """Return whether a path looks like a ROS bag: one of its files, or a folder of them without a recording.toml."""
    if path.is_dir():
        return not (path / "recording.toml").exists() and (
            (path / "metadata.yaml").exists() or bool(_storage_files(path)) or any(path.glob("*.bag"))
        )
    return path.suffix in (*STORAGE_SUFFIXES, ".bag", ".active", ".zstd")


def _storage_files(folder: Path) -> list[Path]:
    """Return the storage files of a folder, in the order of counting."""
    return _in_order(file for suffix in STORAGE_SUFFIXES for file in folder.glob(f"*{suffix}"))


def _in_order(files: Iterable[Path]) -> list[Path]:
    """Return files by name, with the numbers in their names in the order of counting."""
    return sorted(files, key=lambda file: (natural_key(file.name), file.name))


def bag_files(path: Path) -> list[Path]:
    """Return what to open for a bag: the path itself, or the files of a folder that lost its metadata.yaml."""
    try:
        import rosbags.typesys  # noqa: F401
    except ImportError as failure:
        raise RecordingError(
            f"{path}: reading ROS bags needs the library rosbags; install it: pip install 'jiggle-mj[ros]'."
        ) from failure
    if not path.exists():
        raise RecordingError(f"{path} cannot be read: there is no such file or folder.")
    if path.is_dir():
        if (path / "metadata.yaml").exists():
            return _mcap_files(path) or [path]
        files = _storage_files(path) or _in_order(path.glob("*.bag"))
        if not files:
            raise RecordingError(f"{path} holds no bag: no metadata.yaml, and no .mcap, .db3 or .bag file.")
        return files
    if path.suffix not in (*STORAGE_SUFFIXES, ".bag"):
        raise RecordingError(
            f"{path} is not read as a bag: give a .bag, .mcap or .db3 file, or the folder of a ROS 2 bag "
            "(a file compressed by ROS 2 needs its folder; 'rosbag reindex' mends a .bag.active file, which was not "
            "closed)."
        )
    return [path]


def _mcap_files(folder: Path) -> list[Path]:
    """Return the files that a metadata.yaml lists where they are plain MCAP files; empty where rosbags must read them.

    Read file by file, each has its end and its checksums verified, and the size of a chunk is bounded.

    Raises:
        RecordingError: a listed file is missing.
    """
    from ruamel.yaml import YAML

    given = YAML(typ="safe").load((folder / "metadata.yaml").read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
    files = [folder / Path(name).name for name in given["relative_file_paths"]]
    if str(given.get("compression_mode")).lower() in ("file", "message") or any(
        file.suffix != ".mcap" for file in files
    ):
        return []
    missing = [file.name for file in files if not file.exists()]
    if missing:
        raise RecordingError(f"{folder} lacks {listed(missing)}, which its metadata.yaml lists; copy the whole bag.")
    return files


def refuse_cut_database(path: Path) -> None:
    """Refuse an SQLite file that is shorter than its header says; SQLite would read what is left without a word.

    Header: https://www.sqlite.org/fileformat.html, section 1.3.

    Raises:
        RecordingError: it is shorter.
    """
    for file in path.glob("*.db3") if path.is_dir() else [path]:
        if file.suffix == ".db3":
            with open(file, "rb") as stream:
                head = stream.read(SQLITE_HEADER)
            page_size = int.from_bytes(head[16:18], "big")
            wanted = (65536 if page_size == 1 else page_size) * int.from_bytes(head[28:32], "big")
            if file.stat().st_size < max(wanted, SQLITE_HEADER):
                raise RecordingError(
                    f"{file} is cut off: {file.stat().st_size} of {wanted} bytes are there; copy it again."
                )


@contextmanager
def refusing(path: Path, part: str = "the bag") -> Iterator[None]:
    """Turn what the libraries raise for damaged data into one line.

    Catches every Exception on purpose: a damaged bag surfaces as errors of rosbags, apsw, zstandard, lz4, struct, yaml
    and OpenCV, as bare KeyErrors and assertions, and as fields of another type where a bag defines a type anew. No list
    of them is complete.
    """
    try:
        yield
    except JiggleError:
        raise
    except Exception as failure:
        cure = " 'rosbag reindex' mends a file that was not closed." if path.suffix == ".bag" else ""
        reason = " ".join((str(failure) or type(failure).__name__).split())[:SHOWN_REASON]
        raise RecordingError(f"{path}: {part} cannot be read ({reason}); is it damaged or cut off?{cure}") from failure
