"""Files that get their name when they are complete, and one writer at a time.

A file is written as NAME.part beside its place and renamed at its end, so that a file under its own name is complete.
What a killed process wrote stays as NAME.part. Locks are the operating system's (`flock`), which drops those of a dead
process; on file systems that have none, such as some network folders, writers are not kept apart.
"""

import errno
import fcntl
import functools
import inspect
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, ParamSpec, TypeVar

from ..argument_checks import as_path
from ..errors import OutputError

PARTIAL_SUFFIX = ".part"
"""End of the name of a file that is not complete."""
Parameters = ParamSpec("Parameters")
Returned = TypeVar("Returned")


def partial_path(path: Path) -> Path:
    """Return the name of a file until it is complete: run.mcap.part for run.mcap."""
    return path.with_name(path.name + PARTIAL_SUFFIX)


class PartialFile:
    """A binary file under its partial name, locked against other writers until it is complete.

    A device or a pipe is written as it is; a link keeps its place, and the file that it names is replaced.

    Args:
        path: the name of the complete file.
        overwrite: replace a complete or an abandoned file.

    Raises:
        OutputError: the file exists, another process writes it, a killed one left its part, or it cannot be written.
    """

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        if path.is_dir():
            raise OutputError(f"{path} is a folder; give a file, such as {path / 'run.mcap'}.")
        special = path.exists() and not path.is_file()
        self.path = path.resolve() if path.is_symlink() else path
        self.partial = path if special else partial_path(self.path)
        if path.exists() and not overwrite and not special:
            raise OutputError(f"{path} exists; choose another path, or allow the file to be replaced (--overwrite).")
        try:
            self.file: BinaryIO = os.fdopen(os.open(self.partial, os.O_RDWR | os.O_CREAT, 0o666), "wb")
        except OSError as failure:
            raise OutputError(f"{path} cannot be written: {failure.strerror}.") from failure
        try:
            if not (_lock(self.file.fileno()) and self._is_mine()):
                raise OutputError(f"{path} is being written by another process; wait for it, or choose another path.")
            if os.fstat(self.file.fileno()).st_size and not overwrite:
                raise OutputError(
                    f"{self.partial} is what an interrupted run left; read it with --allow-truncated, choose another "
                    "path, or replace it with --overwrite."
                )
            if not special:
                self.file.truncate(0)
        except BaseException:
            self.file.close()
            raise

    def complete(self) -> None:
        """Put the file on the disk and give it its name.

        Raises:
            OSError: the disk is full, or somebody removed the file.
        """
        self.file.flush()
        if self.partial != self.path:
            os.fsync(self.file.fileno())
            os.replace(self.partial, self.path)
        self.file.close()

    def discard(self) -> None:
        """Remove the partial file and let others write; a complete file stays as it is."""
        with suppress(OSError):
            self.partial.unlink()
        self.file.close()

    def _is_mine(self) -> bool:
        """Return whether the locked file still has the partial name, which its last writer may have changed."""
        try:
            return os.path.samestat(os.stat(self.partial), os.fstat(self.file.fileno()))
        except FileNotFoundError:
            return False


def write_text(path: Path, text: str) -> None:
    """Write a text file, complete or not at all.

    Raises:
        OutputError: it cannot be written.
    """
    write_bytes(path, text.encode())


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file, complete or not at all.

    Raises:
        OutputError: it cannot be written.
    """
    partial = path.with_name(f"{path.name}.{os.getpid()}{PARTIAL_SUFFIX}")
    try:
        with open(partial, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except OSError as failure:
        with suppress(OSError):
            partial.unlink()
        raise OutputError(f"{path} cannot be written ({failure.strerror}); give a folder that exists.") from failure


def discard(path: Path) -> None:
    """Remove a file and what an interrupted run left of it.

    Raises:
        OutputError: another process writes it.
        OSError: it cannot be removed.
    """
    partial = partial_path(path)
    if partial.exists():
        with open(partial, "rb") as file:
            if not _lock(file.fileno()):
                raise OutputError(f"{path} is being written by another process; wait for it, or choose another folder.")
            partial.unlink(missing_ok=True)
    path.unlink(missing_ok=True)


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Keep other jobs from filling a folder; create it, and remove it again if it is left empty.

    Raises:
        OutputError: another job fills the folder, or it cannot be created.
    """
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder} is a file; give a folder for the results.")
    created = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError as failure:
        raise OutputError(f"{folder} cannot be written ({failure.strerror}); give another folder.") from failure
    try:
        if not _lock(descriptor):
            raise OutputError(f"another process writes its results to {folder}; wait for it, or give another folder.")
        yield
    finally:
        os.close(descriptor)
        if created:
            with suppress(OSError):
                folder.rmdir()


def fills_folder(job: Callable[Parameters, Returned]) -> Callable[Parameters, Returned]:
    """Return the job so that two of them cannot fill one folder: the argument `directory`."""
    signature = inspect.signature(job)

    @functools.wraps(job)
    def alone(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Returned:
        directory = as_path(signature.bind(*args, **kwargs).arguments["directory"], "the folder")
        with folder_lock(directory):
            return job(*args, **kwargs)

    return alone


def _lock(descriptor: int) -> bool:
    """Lock an open file or folder; return whether no other writer has the lock."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as failure:
        return failure.errno not in (errno.EWOULDBLOCK, errno.EACCES)
    return True
