"""Any study: what is run and what is not, in this process and in an executor, and how a table is written."""

from collections.abc import Iterable, Mapping
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import pytest

from jiggle_mj.errors import OutputError
from jiggle_mj.eval.studies.figures import mean_and_range, value
from jiggle_mj.eval.studies.study import Study, Table, run_study


@dataclass(frozen=True, kw_only=True)
class Squares(Study[int, int]):
    """Squares of the seeds, each in a file."""

    default_seeds: ClassVar[range] = range(3)
    fails: int | None = None
    """The cell that cannot be run."""
    ran: list[int] = field(default_factory=list)

    def cells(self, seeds: Iterable[int]) -> tuple[int, ...]:
        return tuple(seeds)

    def name(self, cell: int) -> str:
        return f"{cell}.txt"

    def run_cell(self, cell: int, path: Path) -> None:
        if cell == self.fails:
            raise ValueError("torn")
        self.ran.append(cell)
        path.write_text(str(cell**2))

    def is_current(self, cell: int, path: Path) -> bool:
        return path.exists() and path.read_text() != "old"

    def read(self, cell: int, path: Path) -> int:
        return int(path.read_text())

    def summarise(self, results: Mapping[int, int]) -> Table:
        rows = tuple((str(cell), str(square)) for cell, square in results.items())
        return Table(headings=("n", "n^2"), rows=rows, beneath=("", "Exact."))


@pytest.fixture(params=[False, True], ids=["in this process", "in an executor"])
def executor(request):
    """None, or an executor of one thread, so that cells are done in order."""
    if not request.param:
        yield None
    else:
        with ThreadPoolExecutor(1) as threads:
            yield threads


@pytest.mark.parametrize("name", ["run.mcap", "estimate.mcap", "result.json"])
def test_a_folder_of_a_run_and_a_file_are_no_place_for_a_table(tmp_path: Path, name: str):
    (tmp_path / name).write_text("kept")
    with pytest.raises(OutputError, match=f"holds {name} of a run; a table needs a folder of its own"):
        run_study(Squares(), (0, 1), tmp_path)
    with pytest.raises(OutputError, match="is a file"):
        run_study(Squares(), (0, 1), tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_what_is_current_is_not_run_again(tmp_path: Path, executor: Executor | None):
    study, lines = Squares(), []
    assert run_study(study, (0, 1), tmp_path / "new", executor=executor) == {0: 0, 1: 1}
    (tmp_path / "new" / "1.txt").write_text("old")
    results = run_study(study, (0, 1, 2), tmp_path / "new", executor=executor, log=lines.append)
    assert results == {0: 0, 1: 1, 2: 4}
    assert study.ran == [0, 1, 1, 2] and lines == ["1 of 2: 1.txt", "2 of 2: 2.txt"]


def test_the_first_failure_ends_the_study_and_what_is_finished_stays(tmp_path: Path, executor: Executor | None):
    study, lines = Squares(fails=1), []
    with pytest.raises(ValueError, match="torn"):
        run_study(study, (0, 1, 2), tmp_path, executor=executor, log=lines.append)
    assert study.is_current(0, tmp_path / "0.txt") and lines[0] == "1 of 3: 0.txt"
    assert run_study(Squares(), (0,), tmp_path, executor=executor) == {0: 0}


def test_in_this_process_nothing_runs_after_the_first_failure(tmp_path: Path):
    study = Squares(fails=1)
    with pytest.raises(ValueError, match="torn"):
        run_study(study, (0, 1, 2), tmp_path)
    assert study.ran == [0]


def test_a_table_in_markdown():
    assert Squares().to_markdown({2: 4, 3: 9}) == "| n | n^2 |\n|---|---|\n| 2 | 4 |\n| 3 | 9 |\n\nExact."


def test_means_have_a_range_where_values_differ_and_a_dash_where_there_are_none():
    assert mean_and_range([0.5, None, 1.0], 100.0, 1) == "75.0 (50.0…100.0)"
    assert mean_and_range([0.5, 0.5], 1.0, 2) == "0.50"
    assert mean_and_range([None], 1.0, 2) == "\N{EN DASH}"


def test_a_figure_that_is_null_or_missing_is_none():
    run = {"detection": {"pcd": None, "n": 3}}
    assert value(run, ("detection", "n")) == 3.0
    assert value(run, ("detection", "pcd")) is None
    assert value(run, ("detection", "n", "deeper")) is None
