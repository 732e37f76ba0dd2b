"""`table NAME`: many runs, and their figures as Markdown; each table has only the options that it uses."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from ..argument_checks import as_integer
from ..errors import OptionError
from ..options import CalibrationReference, Sensing
from .options import Out, RowsName
from .terminal import console, log

if TYPE_CHECKING:
    from jiggle_mj.eval.studies.study import Study


@dataclass(frozen=True, kw_only=True)
class _TableOptions(ABC):
    """Options of every table."""

    out: Out
    """Folder that keeps every run; what is current there is not run again."""

    @abstractmethod
    def run(self) -> None:
        """Run the study, and print its table."""


@dataclass(frozen=True, kw_only=True)
class _Main(_TableOptions):
    """Table of docs/RESULTS.md: each scene from images and from particles."""

    seeds: tuple[int, ...] | None = None
    """Seeds of each row; 0 to 2 if left out."""

    def run(self) -> None:
        from jiggle_mj.eval.studies.main_table import MainStudy

        _print_table(MainStudy(), self, self.seeds)


@dataclass(frozen=True, kw_only=True)
class _Active(_TableOptions):
    """Comparison of policies as in the paper, with ours; the curves are in OUT/active.html."""

    seeds: tuple[int, ...] | None = None
    """Seeds of each row; 0 to 9 if left out."""
    sensing: Sensing = "particles"
    """Sensing: what the estimator sees."""
    jobs: int | None = None
    """Number of runs at a time; the number of usable cores if left out."""

    def run(self) -> None:
        from jiggle_mj.eval.studies.active_curves import PAGE, write_curves
        from jiggle_mj.eval.studies.active_table import ActiveStudy

        courses = _print_table(ActiveStudy(sensing=self.sensing), self, self.seeds, self.jobs, parallel=True)
        write_curves(courses, self.out / PAGE)
        console.print(f"curves: {self.out / PAGE}")


@dataclass(frozen=True, kw_only=True)
class _Acts(_TableOptions):
    """Table of whether failed cuts and sutures are noticed."""

    seeds: tuple[int, ...] | None = None
    """Seeds of each scene; 0 to 5 if left out."""
    jobs: int | None = None
    """Number of runs at a time; the number of usable cores if left out."""

    def run(self) -> None:
        from jiggle_mj.eval.studies.acts_table import ActsStudy

        _print_table(ActsStudy(), self, self.seeds, self.jobs, parallel=True)


@dataclass(frozen=True, kw_only=True)
class _Undeclared(_TableOptions):
    """Table of whether close-loop names what nobody declares."""

    seeds: tuple[int, ...] | None = None
    """Seeds of each row; 0 to 4 if left out."""
    rows: tuple[RowsName, ...] | None = None
    """Rows of the panel: one effect of the library, two together, one from images, what is outside the library,
    nothing, or one effect or nothing on each of six layouts of a coarse sheet; all but the last if left out."""
    jobs: int | None = None
    """Number of runs at a time; the number of usable cores if left out."""

    def run(self) -> None:
        from jiggle_mj.eval.studies.undeclared_panel import USUAL_GROUPS, rows_of
        from jiggle_mj.eval.studies.undeclared_table import UndeclaredStudy

        rows = rows_of(self.rows or USUAL_GROUPS)
        _print_table(UndeclaredStudy(rows=rows), self, self.seeds, self.jobs, parallel=True)


@dataclass(frozen=True, kw_only=True)
class _Calibration(_TableOptions):
    """Simulation-based calibration: where truths drawn from the prior lie in their posteriors.

    The plots are in OUT/calibration.html.
    """

    seeds: tuple[int, ...] | None = None
    """Seeds of the draws from the prior; 0 to 99 if left out."""
    references: tuple[CalibrationReference, ...] | None = None
    """What makes the data: our own engine with the errors that the filter assumes, our own engine without errors of
    forces, or MuJoCo; all if left out."""
    jobs: int | None = None
    """Number of draws at a time; the number of usable cores if left out."""

    def run(self) -> None:
        from jiggle_mj.eval.report.calibration_page import PAGE, write_calibration_page
        from jiggle_mj.eval.studies.drawn_pulls import REFERENCES
        from jiggle_mj.eval.studies.simulation_based_calibration import CalibrationStudy, summaries

        study = CalibrationStudy(references=self.references or REFERENCES)
        found = _print_table(study, self, self.seeds, self.jobs, parallel=True)
        write_calibration_page(self.out / PAGE, summaries(found))
        console.print(f"plots: {self.out / PAGE}")


@dataclass(frozen=True, kw_only=True)
class _Scalability(_TableOptions):
    """Seconds of a plan at three sizes, on this machine."""

    def run(self) -> None:
        from jiggle_mj.eval.studies.scalability import ScalabilityStudy

        _print_table(ScalabilityStudy(), self)


@dataclass(frozen=True, kw_only=True)
class _Paper(_TableOptions):
    seeds: tuple[int, ...] | None = None
    """Seeds of each row; 0 to 9 if left out."""

    def _run(self, name: str) -> None:
        from jiggle_mj.eval.studies.paper_tables import TABLES, PaperStudy

        _print_table(PaperStudy(table=TABLES[name]), self, self.seeds)


@dataclass(frozen=True, kw_only=True)
class _Simulation(_Paper):
    """Table of the paper with four lifts, printed and measured, with all baselines."""

    def run(self) -> None:
        self._run("simulation")


@dataclass(frozen=True, kw_only=True)
class _OneLift(_Paper):
    """Table of the paper's appendix with one lift, printed and measured, with all baselines."""

    def run(self) -> None:
        self._run("one-lift")


Tables = (
    Annotated[_Main, tyro.conf.subcommand("main")]
    | Annotated[_Active, tyro.conf.subcommand("active")]
    | Annotated[_Acts, tyro.conf.subcommand("acts")]
    | Annotated[_Undeclared, tyro.conf.subcommand("undeclared")]
    | Annotated[_Calibration, tyro.conf.subcommand("calibration")]
    | Annotated[_Scalability, tyro.conf.subcommand("scalability")]
    | Annotated[_Simulation, tyro.conf.subcommand("simulation")]
    | Annotated[_OneLift, tyro.conf.subcommand("one-lift")]
)
"""One subcommand for each table."""


def table(name: tyro.conf.OmitSubcommandPrefixes[tyro.conf.OmitArgPrefixes[Tables]]) -> None:
    """Run a table of scenes and seeds, and print it as Markdown; what is current in OUT is not run again."""
    name.run()


def _print_table(
    study: "Study[Any, Any]",
    options: _TableOptions,
    seeds: tuple[int, ...] | None = None,
    jobs: int | None = None,
    *,
    parallel: bool = False,
) -> dict[Any, Any]:
    """Run a study, print its table, and return the results of its cells.

    Args:
        study: what to run.
        options: of the table.
        seeds: the study's own if None.
        jobs: processes, for a study that runs in parallel; one for each usable core if None.
        parallel: run in processes of their own.

    Raises:
        OptionError: no seed, or one below 0.
    """
    from jiggle_mj.eval.studies.study import run_study

    from ..worker_processes import WorkerProcesses

    if seeds == ():
        raise OptionError("--seeds without a seed: give one or more, or leave it out.")
    checked = study.default_seeds if seeds is None else [as_integer(seed, "--seeds", at_least=0) for seed in seeds]
    cells = study.cells(checked)
    if parallel:
        with WorkerProcesses(jobs) as executor:
            results = run_study(study, cells, options.out, executor=executor, log=log)
    else:
        results = run_study(study, cells, options.out, log=log)
    print(study.to_markdown(results))
    return results
