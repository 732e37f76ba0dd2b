"""A study: a table over many runs, each kept in a place of its own, and the one function that runs any study.

A study that was interrupted goes on where it stopped: a cell whose files are current is not run again. A cell is
current when this version and the study's settings made it; give a new folder after any other change.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterable, Mapping
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar, Generic, TypeVar

from jiggle_mj.episode import ESTIMATE, RECORDING, RESULT, check_directory
from jiggle_mj.errors import OutputError

Cell = TypeVar("Cell", bound=Hashable)
Result = TypeVar("Result")


@dataclass(frozen=True, kw_only=True)
class Table:
    """Text of a table: headings, rows, and the lines beneath it."""

    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    beneath: tuple[str, ...] = ()
    """Lines after the rows; an empty one first keeps them apart from the table."""

    def to_markdown(self) -> str:
        """Return the table as Markdown."""
        lines = ["| " + " | ".join(self.headings) + " |", "|" + "---|" * len(self.headings)]
        lines += ["| " + " | ".join(row) + " |" for row in self.rows]
        return "\n".join([*lines, *self.beneath])


class Study(ABC, Generic[Cell, Result]):
    """Cells to run, how one is run and read back, and the table that they make.

    A study and its cells go through pickle, so that a cell can run in another process.
    """

    default_seeds: ClassVar[range]
    """Seeds that are run if none are given."""

    @abstractmethod
    def cells(self, seeds: Iterable[int]) -> tuple[Cell, ...]:
        """Return all cells for these seeds, in the order of the table."""

    @abstractmethod
    def name(self, cell: Cell) -> str:
        """Return the name of the cell's folder or file, unique in the study."""

    @abstractmethod
    def run_cell(self, cell: Cell, path: Path) -> None:
        """Run one cell, and write its files, in place of those that are there.

        Args:
            cell: what to run.
            path: the cell's own folder or file.
        """

    @abstractmethod
    def is_current(self, cell: Cell, path: Path) -> bool:
        """Say whether the cell's files are complete, and made by this version and these settings."""

    @abstractmethod
    def read(self, cell: Cell, path: Path) -> Result:
        """Read the files of a cell that has run."""

    @abstractmethod
    def summarise(self, results: Mapping[Cell, Result]) -> Table:
        """Return the table of these results."""

    def to_markdown(self, results: Mapping[Cell, Result]) -> str:
        """Return the table of these results as Markdown."""
        return self.summarise(results).to_markdown()


def run_study(
    study: Study[Cell, Result],
    cells: Iterable[Cell],
    directory: Path,
    *,
    executor: Executor | None = None,
    log: Callable[[str], None] = lambda _: None,
) -> dict[Cell, Result]:
    """Run the cells that are not current, and read all of them.

    Args:
        study: runs and reads the cells.
        cells: of the study, those to run and read.
        directory: holds a folder or a file for each cell.
        executor: runs several cells at a time; None runs one after the other in this process.
        log: gets a line for each cell: before it starts in this process, after it is done in an executor.

    Raises:
        OutputError: the directory is a file, or holds the results of a run.
        Exception: whatever the first cell that fails raises; what is finished stays.
    """
    check_directory(directory, (), overwrite=False)
    if held := [name for name in (RECORDING, ESTIMATE, RESULT) if (directory / name).exists()]:
        raise OutputError(f"{directory} holds {', '.join(held)} of a run; a table needs a folder of its own.")
    paths = {cell: directory / study.name(cell) for cell in cells}
    missing = {
        path.name: partial(study.run_cell, cell, path)
        for cell, path in paths.items()
        if not study.is_current(cell, path)
    }
    directory.mkdir(parents=True, exist_ok=True)
    if executor is None:
        for number, (name, run) in enumerate(missing.items(), start=1):
            log(f"{number} of {len(missing)}: {name}")
            run()
    else:
        run_all(missing, executor, log=log)
    return {cell: study.read(cell, path) for cell, path in paths.items()}


def run_all(runs: Mapping[str, Callable[[], object]], executor: Executor, *, log: Callable[[str], None]) -> None:
    """Run calls by name, several at a time; the first that fails ends them, and what is finished stays.

    Args:
        runs: what to call; each goes through pickle.
        executor: calls it.
        log: gets a line for each call that is done.

    Raises:
        Exception: whatever the first call that fails raises.
    """
    pending = {executor.submit(run): name for name, run in runs.items()}
    try:
        for number, done in enumerate(as_completed(pending), start=1):
            done.result()
            log(f"{number} of {len(pending)}: {pending[done]}")
    except BaseException:
        for future in pending:
            future.cancel()
        raise
