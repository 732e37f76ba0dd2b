"""The command line: `jiggle-mj VERB`. Results go to files; --json prints them, all else goes to stderr.

Exit codes: 0 fine, 1 the run failed, 2 bad usage (a scene, an option or an output folder that cannot be used). Heavy
imports happen inside the verbs, so that help is quick.
"""

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NoReturn

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from jiggle_mj.allocator import keep_freed_memory
from jiggle_mj.errors import JiggleError, OptionError, OutputError, SceneError
from jiggle_mj.policies import PolicyName

if TYPE_CHECKING:
    from jiggle_mj.episode import OnFrame
    from jiggle_mj.estimate import Estimate
    from jiggle_mj.observation import Observation
    from jiggle_mj.scenes import Scene

Sensing = Literal["stereo", "points", "particles", "cloud"]
FilterName = Literal["implicit", "explicit", "adam", "nnls", "unscented"]
PathArgument = Annotated[Path, tyro.conf.Positional]
Name = Annotated[str, tyro.conf.Positional]
RowsName = Literal["inside", "together", "images", "outside", "nothing"]
TableName = Literal["main", "active", "acts", "undeclared", "scalability", "simulation", "one-lift"]
Out = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
AsJson = Annotated[bool, tyro.conf.arg(name="json")]
Disturb = tyro.conf.UseAppendAction[Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME[=MAGNITUDE]")]]

console = Console(stderr=True)


def run(
    scene: Name,
    /,
    *,
    out: Out,
    sensing: Sensing = "stereo",
    policy: PolicyName | None = None,
    steps: int | None = None,
    estimator: FilterName = "implicit",
    seed: int = 0,
    disturb: Disturb = (),
    overwrite: bool = False,
    as_json: AsJson = False,
) -> None:
    """The main job: reference tissue, stereo, estimate, score, report.

    Args:
        scene: a shipped scene (arc, line, ...) or the path of a scene file.
        out: folder for run.mcap, run.truth.mcap, estimate.mcap, result.json and report.html.
        sensing: what the estimator sees: images; noisy tracked points of the tissue; noisy vertices of the reference; a
            noisy cloud of other points in each frame.
        policy: who chooses the pulls, if not whom the scene names: corners is its programme; information is ours,
            one-grasp is ours without letting go; detach cuts what it finds, suture sews; sl-d, lg-d, lg-h and pmp-WAY
            are the paper's, which move one grasp.
        steps: how many actions a policy may take: 40 if left out, 400 of detach and suture.
        estimator: implicit is ours; explicit is the paper's filter, adam its baseline; nnls and unscented are others'.
        seed: of the sensing noise.
        disturb: something that nobody tells the estimator of, such as gravity=0.5; any number of times. The names are
            in docs/DISTURBANCES.md.
        overwrite: replace results that are already in the folder, from the moment that the run begins.
        as_json: print result.json to stdout.
    """
    from jiggle_mj.estimator import EstimatorConfig
    from jiggle_mj.eval.acting import most_actions
    from jiggle_mj.eval.experiment import run_scene
    from jiggle_mj.scenes import disturbed, load_scene

    loaded, config = disturbed(load_scene(scene), disturb), EstimatorConfig(filter=estimator)
    with _progress(most_actions(loaded, policy, steps), f"run {loaded.name}") as on_frame:
        figures = run_scene(
            loaded,
            out,
            seed=seed,
            sensing=sensing,
            policy=policy,
            steps=steps,
            config=config,
            overwrite=overwrite,
            on_frame=on_frame,
        )
    _show(figures, out, as_json)


def record(
    scene: Name,
    /,
    *,
    out: Out,
    sensing: Sensing = "stereo",
    seed: int = 0,
    count: int | None = None,
    jobs: int | None = None,
    executor: Annotated[str | None, tyro.conf.arg(metavar="dask://HOST:PORT")] = None,
    disturb: Disturb = (),
    overwrite: bool = False,
    as_json: AsJson = False,
) -> None:
    """The reference tissue alone: observations to OUT, the truth to a file of its own beside it.

    Args:
        scene: a shipped scene or the path of a scene file.
        out: the recording, for example run.mcap; the truth goes to run.truth.mcap. With --count a folder, in which each
            recording is named by its seed; what is whole there is kept.
        sensing: what is recorded.
        seed: of the sensing noise; with --count of the first recording, the next has the next.
        count: how many recordings.
        jobs: how many at a time, each in a process of its own; as many as there are usable cores if left out.
        executor: a Dask scheduler whose workers record instead, into a folder that all of them share.
        disturb: something that nobody tells the estimator of, such as gravity=0.5; any number of times. The names are
            in docs/DISTURBANCES.md.
        overwrite: replace files that are already there.
        as_json: print what was written to stdout.
    """
    from jiggle_mj.episode import observe
    from jiggle_mj.mcap_files import truth_path
    from jiggle_mj.scenes import Reference, disturbed, load_scene, programme

    if count is None and (jobs is not None or executor is not None):
        raise OptionError(f"--{'jobs' if executor is None else 'executor'} is for many recordings: give --count too.")
    loaded = disturbed(load_scene(scene), disturb)
    if count is not None:
        _record_series(
            loaded,
            out,
            count=count,
            jobs=jobs,
            executor=executor,
            sensing=sensing,
            seed=seed,
            overwrite=overwrite,
            as_json=as_json,
        )
        return
    with (
        _progress(sum(1 for _ in programme(loaded)), f"record {loaded.name}") as on_frame,
        Reference(loaded, seed=seed, sensing=sensing, dump_dir=out.parent) as reference,
    ):
        n_frames = 0
        for observation in observe(reference, programme(loaded), out, seed=seed, overwrite=overwrite):
            on_frame(observation, None)
            n_frames += 1
    console.print(f"wrote {out}: {n_frames} frames; the truth: {truth_path(out)}")
    if as_json:
        print(json.dumps({"recording": str(out), "truth": str(truth_path(out)), "n_frames": n_frames}))


def _record_series(
    scene: "Scene",
    folder: Path,
    *,
    count: int,
    jobs: int | None,
    executor: str | None,
    sensing: Sensing,
    seed: int,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Many recordings of a scene; leaves with 1 where some failed, with 130 after Ctrl-C."""
    from jiggle_mj.cluster import cluster
    from jiggle_mj.recording_series import record_series
    from jiggle_mj.worker_processes import WorkerProcesses

    if jobs is not None and executor is not None:
        raise OptionError("--jobs is for this machine, --executor for others: give one of them.")
    try:
        with (
            WorkerProcesses(jobs) if executor is None else cluster(executor) as workers,
            _bar(count, f"record {scene.name}") as advance,
        ):
            series = record_series(
                scene,
                folder,
                count=count,
                sensing=sensing,
                seed=seed,
                executor=workers,
                overwrite=overwrite,
                on_done=lambda _: advance(),
            )
    except KeyboardInterrupt:
        _stop(f"interrupted; what is in {folder} is whole, and the same command, without --overwrite, goes on", 130)
    made = len(series.recordings) - series.n_kept
    console.print(
        f"{folder}: {made} recordings made, {series.n_kept} kept, {len(series.failed)} failed", soft_wrap=True
    )
    for one, why in series.failed.items():
        console.print(f"seed {one} failed: {why}", markup=False, highlight=False, soft_wrap=True)
    if as_json:
        failed = [{"seed": one, "why": why} for one, why in series.failed.items()]
        print(json.dumps({"folder": str(folder), "recordings": [*map(str, series.recordings)], "failed": failed}))
    if series.failed:
        sys.exit(1)


def import_(
    folder: PathArgument,
    /,
    *,
    out: Out,
    recording: Path | None = None,
    overwrite: bool = False,
    as_json: AsJson = False,
) -> None:
    """A folder of measured data into a recording.

    Args:
        folder: where the data files are.
        out: the recording to write; what the toml holds as truth goes to a file of its own beside it.
        recording: the recording.toml that describes the data; the folder's own if left out.
        overwrite: replace files that are already there.
        as_json: print a summary to stdout.
    """
    from jiggle_mj.importing import import_folder

    summary = import_folder(folder, recording, out, overwrite=overwrite)
    for name, why in summary.skipped:
        console.print(f"left out {name}: {why}")
    console.print(
        f"wrote {summary.recording}: {summary.n_frames} frames of {summary.n_points} points, {summary.n_unseen} times "
        f"a point was not seen, {summary.n_held} held; truth: {summary.truth or 'none'}"
    )
    if as_json:
        print(json.dumps(asdict(summary), default=str))


def estimate(
    recording: PathArgument,
    /,
    *,
    out: Out,
    estimator: FilterName = "implicit",
    allow_truncated: bool = False,
    overwrite: bool = False,
    as_json: AsJson = False,
) -> None:
    """Estimate from a recording, which holds observations only.

    Args:
        recording: an MCAP file.
        out: folder for estimate.mcap, result.json and report.html.
        estimator: implicit is ours; explicit is the paper's filter, adam its baseline; nnls and unscented are others'.
        allow_truncated: use what is whole of a recording that was cut off.
        overwrite: replace results that are already in the folder.
        as_json: print result.json to stdout.
    """
    from jiggle_mj.estimator import EstimatorConfig
    from jiggle_mj.eval.experiment import run_estimator
    from jiggle_mj.recording import Recording

    length = len(Recording.open(recording, allow_truncated=allow_truncated))
    with _progress(length, f"estimate {recording.name}") as on_frame:
        figures = run_estimator(
            recording,
            out,
            config=EstimatorConfig(filter=estimator),
            overwrite=overwrite,
            allow_truncated=allow_truncated,
            on_frame=on_frame,
        )
    _show(figures, out, as_json)


def identify(recording: PathArgument, /, *, allow_truncated: bool = False, as_json: AsJson = False) -> None:
    """Weight and bending stiffness of the sheet over its membrane stiffness, from a recording.

    Args:
        recording: an MCAP file.
        allow_truncated: use what is whole of a recording that was cut off.
        as_json: print what was found to stdout.
    """
    from jiggle_mj import episode
    from jiggle_mj.estimator import Estimator
    from jiggle_mj.recording import Recording

    source = Recording.open(recording, allow_truncated=allow_truncated)
    estimator = Estimator(source.declaration, source.camera)
    with _progress(len(source), f"estimate {recording.name}") as on_frame:
        episode.estimate(source, estimator, on_frame=on_frame)
    with console.status("weight and bending") as status:
        material = estimator.identify(
            on_pass=lambda factors: status.update(", ".join(f"{name} x {x:.3g}" for name, x in factors.items()))
        )
    table = Table("over the membrane stiffness", "unit", "declared", "found", "standard error", box=None)
    for name, ratio in material.ratios.items():
        known = ratio.refused is None
        found = (f"{ratio.declared * ratio.factor:.3g}", f"{100 * ratio.log_sd:.1f} %") if known else ("-", "-")
        table.add_row(name, ratio.unit, f"{ratio.declared:.3g}", *found)
    console.print(table)
    for name, why in material.refused.items():
        console.print(f"{name}: not identified; {why}.", highlight=False)
    found = material.declaration
    console.print(
        f"If the sheet weighs the declared {found.areal_density:g} kg/m^2: membrane_stiffness = "
        f"{found.membrane_stiffness:.3g} N/m, and thickness = {found.thickness:.3g} m for its bending.",
        highlight=False,
    )
    if as_json:
        ratios = {name: asdict(ratio) for name, ratio in material.ratios.items()}
        declared = {name: getattr(found, name) for name in ("membrane_stiffness", "thickness", "areal_density")}
        print(json.dumps({"ratios": ratios, "refused": material.refused, "declaration": declared}))


def close_loop(
    recording: PathArgument,
    /,
    *,
    out: Out,
    truth: Path | None = None,
    suggest: bool = False,
    allow_truncated: bool = False,
    overwrite: bool = False,
    as_json: AsJson = False,
) -> None:
    """What the model lacks of a recording: the residual, the effect behind it, and the error before and after.

    Args:
        recording: an MCAP file.
        out: folder for discrepancy.json and discrepancy.html.
        truth: a truth file, to score what is found attached before and after; opened when all is decided.
        suggest: where several effects explain the frames, look for the next pull that tells them apart.
        allow_truncated: use what is whole of a recording that was cut off.
        overwrite: replace results that are already in the folder.
        as_json: print discrepancy.json to stdout.
    """
    from jiggle_mj.eval.closing_the_loop import PAGE
    from jiggle_mj.eval.closing_the_loop import close_loop as close
    from jiggle_mj.eval.discrepancy_page import story
    from jiggle_mj.recording import Recording

    length = len(Recording.open(recording, allow_truncated=allow_truncated))
    with _progress(length, f"follow {recording.name}") as on_frame:
        found = close(
            recording,
            out,
            truth=truth,
            suggestion=suggest,
            allow_truncated=allow_truncated,
            overwrite=overwrite,
            on_frame=on_frame,
            say=lambda text: console.print(text, highlight=False, markup=False),
        )
    console.print(found["verdict"], style="bold")
    for sentence in story(found):
        console.print(sentence, highlight=False, markup=False)
    console.print(f"report: {out / PAGE}")
    if as_json:
        print(json.dumps(found))


def score(directory: PathArgument, /, *, truth: Path, recording: Path | None = None, as_json: AsJson = False) -> None:
    """Score an estimate against a truth file, and write the truth into its report.

    Args:
        directory: a folder that `run` or `estimate` filled.
        truth: the truth file, for example run.truth.mcap.
        recording: what was estimated, for the report's pictures; if left out, it is looked for beside the truth and in
            the folder.
        as_json: print result.json to stdout.
    """
    from jiggle_mj.eval.experiment import score_directory

    _show(score_directory(directory, truth, recording=recording, say=console.print), directory, as_json)


def table(
    name: Annotated[TableName, tyro.conf.Positional],
    /,
    *,
    out: Out,
    seeds: tuple[int, ...] | None = None,
    sensing: Sensing | None = None,
    jobs: int | None = None,
    rows: tuple[RowsName, ...] | None = None,
) -> None:
    """Run a table of scenes and seeds, and print it as Markdown; what is in OUT already is not run again.

    Args:
        name: main is the README's; active is the paper's comparison of policies, with ours; acts is whether failed cuts
            and sutures are noticed; undeclared is whether close-loop names what nobody declares; scalability times
            plans at three sizes, on this machine; simulation and one-lift are the paper's, with its printed figures and
            all baselines.
        out: holds a folder for each run, and of active the curves, active.html.
        seeds: of each row; 0 to 2 for main, 0 to 5 for acts, 0 to 4 for undeclared and 0 to 9 for the paper's if left
            out.
        sensing: of active; particles if left out.
        jobs: of active, acts and undeclared: how many runs at a time; as many as there are usable cores if left out.
        rows: of undeclared: one effect of the library, two together, one from images, what is outside the library, or
            nothing; all if left out.
    """
    from jiggle_mj.eval import paper_tables, tables

    def say(text: str) -> None:
        console.print(text, highlight=False)

    if sensing is not None and name != "active":
        raise OptionError(f"--sensing is for the table active; got {name}.")
    if jobs is not None and name not in ("active", "acts", "undeclared"):
        raise OptionError(f"--jobs is for the tables active, acts and undeclared; got {name}.")
    if rows is not None and name != "undeclared":
        raise OptionError(f"--rows is for the table undeclared; got {name}.")
    if name == "main":
        print(tables.markdown(tables.measure(tables.MAIN, seeds or range(3), out, say=say)))
    elif name == "active":
        from jiggle_mj.eval import active_table
        from jiggle_mj.worker_processes import WorkerProcesses

        with WorkerProcesses(jobs) as executor:
            runs = active_table.measure(
                active_table.SCENES,
                active_table.POLICIES,
                seeds or range(10),
                out,
                sensing=sensing or "particles",
                executor=executor,
                say=say,
            )
        print(active_table.markdown(runs))
        active_table.write_curves(runs, out / active_table.FILE)
        console.print(f"curves: {out / active_table.FILE}")
    elif name == "acts":
        from jiggle_mj.eval import acts_table
        from jiggle_mj.worker_processes import WorkerProcesses

        with WorkerProcesses(jobs) as executor:
            found = acts_table.measure(acts_table.SCENES, seeds or range(6), out, executor=executor, say=say)
        print(acts_table.markdown(found))
    elif name == "undeclared":
        from jiggle_mj.eval import undeclared_table as undeclared
        from jiggle_mj.eval.undeclared_panel import GROUPS
        from jiggle_mj.worker_processes import WorkerProcesses

        names = [name for group in (rows or GROUPS) for name in GROUPS[group]]
        with WorkerProcesses(jobs) as executor:
            closed = undeclared.measure(names, seeds or range(5), out, executor=executor, say=say)
        print(undeclared.markdown(closed))
    elif name == "scalability":
        from jiggle_mj.eval import scalability

        print(scalability.markdown(scalability.scalability(scalability.SIZES, say=say)))
    else:
        table, cells = paper_tables.TABLES[name], paper_tables.cells()
        print(paper_tables.markdown(table, paper_tables.measure(table, cells, seeds or range(10), out, say=say)))


def bench(
    part: Annotated[Literal["estimator", "reference"], tyro.conf.Positional] = "estimator",
    /,
    *,
    sizes: tuple[int, ...] | None = None,
    gate: bool = False,
    as_json: AsJson = False,
) -> None:
    """Time the estimator's or the reference tissue's parts on this machine, compile time apart; medians.

    Args:
        part: estimator, or reference.
        sizes: about how many particles (600, 1200 if left out; the first is compared with the paper's filter too, and
            of more than 10000 the solver is timed alone), or vertices of the reference (300, 625, 1200, 2500).
        gate: fail where something became worse than the committed baseline allows.
        as_json: print the figures to stdout.
    """
    from jiggle_mj.eval.benchmark import SIZES, baseline, benchmark, regressions

    def say(text: str) -> None:
        console.print(text, highlight=False)

    if part == "reference":
        from jiggle_mj.eval import reference_benchmark as reference

        metrics = reference.reference_benchmark(sizes or reference.SIZES, say=say)
    else:
        metrics = benchmark(sizes or SIZES, paper=True, say=say)
    table = Table("", "figure", "", box=None)
    for name, entry in metrics.items():
        value = entry["value"]
        table.add_row(name, value if isinstance(value, str) else f"{value:.3g}", str(entry["unit"]))
    console.print(table)
    if as_json:
        print(json.dumps(metrics))
    worse = regressions(metrics, baseline()) if gate else []
    for line in worse:
        console.print(line, style="red", highlight=False)
    if worse:
        sys.exit(1)


def scene_check(scene: Name, /, *, disturb: Disturb = (), as_json: AsJson = False) -> None:
    """Static load tests of a scene's compiled sheet: its stiffness beside the typed and the declared one.

    Args:
        scene: a shipped scene or the path of a scene file.
        disturb: see run; those of the material that begin at 0 count.
        as_json: print the figures to stdout.
    """
    from jiggle_mj.scenes import disturbed, load_scene
    from jiggle_mj.scenes.load_tests import QUANTITIES, far_from_declared, load_tests, typed

    loaded = disturbed(load_scene(scene), disturb)
    with console.status("load tests") as status:
        found = load_tests(loaded, say=lambda text: status.update(f"load tests: {text}"))
    stated = typed(loaded.tissue)
    spacings = [f"{1e3 * one.spacing:.2f} mm" for one in found]
    table = Table("effective", "unit", "typed", *spacings, box=None)
    for name, unit in QUANTITIES.items():
        ratios = ["too coarse" if isnan(value := getattr(one, name)) else f"{value:.4g}" for one in found]
        table.add_row(name.replace("_", " "), unit, f"{getattr(stated, name):.4g}", *ratios)
    console.print(table)
    for line in far_from_declared(loaded, found):
        console.print(line, style="yellow", markup=False, highlight=False)
    if as_json:
        plain = [{key: None if isnan(value) else value for key, value in asdict(one).items()} for one in found]
        print(json.dumps({"typed": asdict(stated), "effective": plain}))


def doctor(*, as_json: AsJson = False) -> None:
    """Check this machine: versions, JAX devices, offscreen OpenGL, cores and memory.

    Args:
        as_json: print the checks to stdout.
    """
    from jiggle_mj.doctor import doctor as examine

    checks = examine()
    table = Table("", "check", "found", "what to do", box=None)
    for check in checks:
        table.add_row("[green]ok[/]" if check.ok else "[red]no[/]", check.name, check.detail, check.remedy or "")
    console.print(table)
    if as_json:
        print(json.dumps([asdict(check) for check in checks]))
    if not all(check.ok for check in checks):
        sys.exit(1)


VERBS = {
    "run": run,
    "record": record,
    "import": import_,
    "estimate": estimate,
    "identify": identify,
    "close-loop": close_loop,
    "score": score,
    "table": table,
    "bench": bench,
    "scene-check": scene_check,
    "doctor": doctor,
}


def main() -> None:
    """Entry point of `jiggle-mj`."""
    keep_freed_memory()
    try:
        tyro.extras.subcommand_cli_from_dict(
            VERBS,
            prog="jiggle-mj",
            description="Find where a tissue is attached, how strongly and how surely, from pulls seen by a camera.",
        )
    except (SceneError, OptionError, OutputError) as failure:
        _stop(failure, 2)
    except JiggleError as failure:
        _stop(failure, 1)
    except KeyboardInterrupt:
        _stop("interrupted; the recording so far is whole, and 'jiggle-mj estimate' reads it into another folder", 130)


def _stop(failure: object, code: int) -> NoReturn:
    console.print(f"jiggle-mj: {failure}", style="red", markup=False, highlight=False, soft_wrap=True)
    sys.exit(code)


@contextmanager
def _progress(total: int, title: str) -> "Iterator[OnFrame]":
    """A bar of frames."""
    with _bar(total, title) as advance:

        def on_frame(observation: "Observation", found: "Estimate | None") -> None:
            note = "" if found is None else f", entropy {found.entropy:.0f} nat"
            advance(f": grasp {observation.tool.grasp}{note}")

        yield on_frame


@contextmanager
def _bar(total: int, title: str) -> Iterator[Callable[..., None]]:
    """A bar on stderr; what is given is called with a note for each part done."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as bar:
        task = bar.add_task(title, total=total)
        yield lambda note="": bar.update(task, advance=1, description=title + note)


def _show(figures: dict, out: Path, as_json: bool) -> None:
    """What was found, in a few lines; the whole of it with --json."""
    from jiggle_mj.eval.verdict import doubts

    detection, calibration = figures["detection"], figures["calibration"]
    console.print(
        f"{detection['n_detected']} of {figures['n_particles']} particles reported attached ({detection['rule']})"
    )
    if detection["n_attached"] is not None:
        table = Table("rings", "PCD %", "PUG %", "F1 %", box=None)
        for rings, one in detection["by_dilation"].items():
            table.add_row(
                rings, *("-" if one[name] is None else f"{100 * one[name]:.1f}" for name in ("pcd", "pug", "f1"))
            )
        console.print(table)
        parts = [f"{detection['n_attached']} truly attached"]
        if calibration["nees_attached"] is not None:
            parts.append(f"NEES per dof of the attached {calibration['nees_attached']:.2f}")
        if figures["tracking"]["rms_m"] is not None:
            parts.append(f"tracking RMS {1e3 * figures['tracking']['rms_m']:.2f} mm")
        console.print(", ".join(parts))
    for skipped in figures["frames"]["skipped"]:
        console.print(f"frame {skipped['index']} skipped: {skipped['why']}")
    for index in figures["frames"]["not_converged"]:
        console.print(f"frame {index}: the search for the sheet's state was cut off; trust it less.")
    for doubt in doubts(figures):
        console.print(doubt)
    console.print(f"report: {out / 'report.html'}")
    if as_json:
        print(json.dumps(figures))
