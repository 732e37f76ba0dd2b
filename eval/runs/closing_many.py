"""Closes the loop over many recordings of one sheet, several at a time, and compares what was found.

The results of each recording are in a folder of its name, as `close_loop` writes them. What is complete is kept when
the same job runs again. Effects of the tissue can be fitted to all of them together, see `closing_jointly`.
"""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from dataclasses import fields
from pathlib import Path
from typing import Any

from jiggle_mj.argument_checks import as_instance, as_path, as_tuple_of
from jiggle_mj.episode import ESTIMATE, RECORDING, RESULT, check_directory, clear_directory
from jiggle_mj.errors import JiggleError, OptionError, OutputError
from jiggle_mj.estimator import EstimatorConfig
from jiggle_mj.estimator.effects import LIBRARY, Effect
from jiggle_mj.estimator.perception import FrameMask, TissueMask
from jiggle_mj.recording.declaration import version_entry
from jiggle_mj.recording.mcap_files import truth_path
from jiggle_mj.recording.output_files import fills_folder, write_text
from jiggle_mj.recording.reader import PAIRING_TOLERANCE_NS, Recording
from jiggle_mj.run_each import run_each
from jiggle_mj.worker_processes import WorkerProcesses

from ..metrics.effects_compared import effects_compared
from ..metrics.result_file import Json
from ..report.comparison_page import write_comparison
from .closing_order import JOB, ClosingOrder
from .closing_the_loop import DISCREPANCY
from .joint_result import JOINT, write_jointly
from .settings_used import with_declared

SUMMARY, PAGE = "results.json", "report.html"
"""Files that compare the recordings."""
FOREIGN = (RECORDING, ESTIMATE, RESULT, DISCREPANCY, JOB)
"""Files of a single job; a folder with one of them is none for a comparison."""
FIGURES = ("verdict", "effects", "ambiguous_with", "posterior", "held_out", "frames", "seconds")
"""Keys of a recording in results.json that are null where it failed."""


@fills_folder
def close_loops(
    recordings: Sequence[Path],
    directory: Path,
    *,
    library: tuple[Effect, ...] = LIBRARY,
    suggestion: bool = False,
    joint: bool = False,
    config: EstimatorConfig | None = None,
    declare: Mapping[str, Any] | None = None,
    mask: TissueMask | FrameMask | None = None,
    overwrite: bool = False,
    allow_truncated: bool = False,
    allow_implausible: bool = False,
    tolerance_ns: int = PAIRING_TOLERANCE_NS,
    executor: Executor | None = None,
    log: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Close the loop over several recordings of one sheet, and compare the effects and the errors.

    A recording that fails leaves the others as they are. What an earlier call with the same arguments has completed is
    kept.

    Args:
        recordings: MCAP files; each name without its ending is that of a folder, and may occur once.
        directory: where results.json, report.html and a folder for each recording go; executors on other machines
            must share it, and the recordings, under the same names.
        library: as in `close_loop`, and so the arguments up to `tolerance_ns`.
        suggestion: see `close_loop`.
        joint: fit effects of the tissue to all recordings together, too; joint.json and a corrected_joint.toml in each
            folder say what that gives.
        config: of the estimator.
        declare: properties of the tissue, for all recordings.
        mask: the same for all recordings.
        overwrite: replace earlier results of these recordings.
        allow_truncated: see `close_loop`.
        allow_implausible: see `close_loop`.
        tolerance_ns: see `close_loop`.
        executor: closes the loops; it is not shut down. None for `WorkerProcesses` on all cores of this machine.
        log: gets a line for each recording that ends.

    Returns:
        The content of results.json; with `joint` also that of joint.json under this name, None where fewer than two
        recordings could be closed.

    Raises:
        OptionError: no recording, two of the same name, or recordings of sheets that are declared differently; with
            `joint` a single one, or recordings of sheets of different shapes.
        OutputError: the directory holds a recording or other results, or a file cannot be written.
        KeyboardInterrupt: recordings that have not begun are cancelled; complete results stay.
    """
    directory = as_path(directory, "the folder")
    paths = _by_name([Path(path) for path in as_tuple_of(recordings, "recordings", (str, Path))])
    if executor is not None:
        as_instance(executor, "executor", Executor, hint="WorkerProcesses() is one.")
    if joint and len(paths) < 2:
        raise OptionError(
            f"joint: {recordings[0]} is a single recording, and there are no others to fit it with; give two or more."
        )
    _check_place(directory, paths)
    _refuse_other_sheets(paths, declare, allow_truncated=allow_truncated, tolerance_ns=tolerance_ns)
    options = {
        "library": library,
        "suggestion": suggestion,
        "config": config,
        "declare": declare,
        "mask": mask,
        "allow_truncated": allow_truncated,
        "allow_implausible": allow_implausible,
        "tolerance_ns": tolerance_ns,
    }
    orders = {name: ClosingOrder.of(path, directory / name, options, keep_fits=joint) for name, path in paths.items()}
    missing = {name: order for name, order in orders.items() if overwrite or not order.is_complete()}
    directory.mkdir(parents=True, exist_ok=True)
    clear_directory(directory, (SUMMARY, PAGE, JOINT))
    failed: dict[str, str] = {}
    ended = len(orders) - len(missing)
    if ended:
        log(f"{ended} of {len(orders)} are complete, and kept")

    def on_done(name: str, why: str | None) -> None:
        nonlocal ended
        ended += 1
        if why is not None:
            failed[name] = why
        log(f"{ended} of {len(orders)}: {name}: {_outcome(orders[name].found()) if why is None else f'failed: {why}'}")

    with ExitStack() as stack:
        if executor is None and (missing or joint):
            executor = stack.enter_context(WorkerProcesses())
        if missing:
            assert executor is not None
            run_each(
                ClosingOrder.execute,
                missing,
                executor,
                on_done=on_done,
                fails_alone=lambda failure: isinstance(failure, Exception),
            )
        results = _summary(orders, failed)
        write_text(directory / SUMMARY, json.dumps(results, indent=1) + "\n")
        write_comparison(directory / PAGE, results)
        if joint:
            assert executor is not None
            closed = {name: order for name, order in orders.items() if name not in failed}
            together = write_jointly(directory, closed, executor, log) if len(closed) > 1 else None
            write_comparison(directory / PAGE, results, together)
            results = results | {"joint": together}
    return results


def without_truth(recordings: Iterable[Path]) -> list[Path]:
    """Return the recordings without the truth files that lie beside them and have their names, as a pattern gives."""
    given = list(recordings)
    truths = {truth_path(path) for path in given}
    return [path for path in given if path not in truths]


def _by_name(recordings: list[Path]) -> dict[str, Path]:
    """Return recordings by name.

    Raises:
        OptionError: none, or two of one name.
    """
    if not recordings:
        raise OptionError("no recording is given; give one MCAP file or more.")
    paths: dict[str, Path] = {}
    for path in recordings:
        if (other := paths.get(path.stem)) is not None:
            raise OptionError(
                f"{other} and {path} are both named '{path.stem}', and each recording's results go to a folder of its "
                "name; give each once, or rename one."
            )
        paths[path.stem] = path
    return paths


def _check_place(directory: Path, paths: Mapping[str, Path]) -> None:
    """Refuse a folder that holds a recording, or the results of something else.

    Raises:
        OutputError: it does.
    """
    check_directory(directory, (), overwrite=False)
    if held := [name for name in FOREIGN if (directory / name).exists()]:
        raise OutputError(f"{directory} holds {', '.join(held)} of one recording; give a folder of its own.")
    if (directory / PAGE).exists() and not (directory / SUMMARY).exists():
        raise OutputError(f"{directory} holds {PAGE} of something else; give a folder of its own.")
    where = directory.resolve()
    for path in paths.values():
        if where in path.resolve().parents:
            raise OutputError(f"{directory} holds the recording {path}; give a folder of its own for the results.")


def _refuse_other_sheets(
    paths: Mapping[str, Path], declare: Mapping[str, Any] | None, *, allow_truncated: bool, tolerance_ns: int
) -> None:
    """Refuse recordings of sheets that are declared differently: sizes of effects are relative to what is declared.

    Recordings that cannot be read are left for their own lines.

    Raises:
        OptionError: two differ.
    """
    first: tuple[Path, Json] | None = None
    for path in paths.values():
        try:
            recording = Recording.open(path, allow_truncated=allow_truncated, tolerance_ns=tolerance_ns)
        except JiggleError:
            continue
        declaration = with_declared(recording.declaration, declare)
        declared = {one.name: getattr(declaration, one.name) for one in fields(declaration) if one.name != "mesh"}
        first = first or (path, declared)
        for name, value in declared.items():
            if value != (expected := first[1][name]):
                raise OptionError(
                    f"{first[0]} and {path} are not declared as one sheet: {name} is {expected} and {value}. Effects "
                    "of different sheets are not compared; give each sheet a folder of its own, or say what holds for "
                    f"all: --declare {name}=..."
                )


def _outcome(found: Mapping[str, Any]) -> str:
    """Return verdict and effects in a few words."""
    named = ", ".join(effect["name"] for effect in found["effects"])
    return found["verdict"] + (f", {named}" if named else "")


def _summary(orders: Mapping[str, ClosingOrder], failed: Mapping[str, str]) -> dict[str, Any]:
    """Return the content of results.json."""
    found = {name: order.found() for name, order in orders.items() if name not in failed}
    rows = [
        {"name": name, "recording": str(order.recording), "failed": failed.get(name)}
        | (_figures(found[name], order.seconds()) if name in found else dict.fromkeys(FIGURES))
        for name, order in orders.items()
    ]
    same_at_sites = [effect.name for effect in LIBRARY if effect.site_prior_sd]
    compared = effects_compared(found, same_at_sites=same_at_sites)
    return {**version_entry(), "recordings": rows, "effects": compared}


def _figures(found: Mapping[str, Any], seconds: float | None) -> dict[str, Any]:
    """Return the figures of one recording in the summary."""
    figures = {
        "verdict": found["verdict"],
        "effects": [effect["name"] for effect in found["effects"]],
        "ambiguous_with": found["ambiguous_with"],
        "posterior": [{key: one[key] for key in ("effects", "probability")} for one in found["posterior"]],
        "held_out": {name: value for name, value in found["held_out"].items() if not isinstance(value, list)},
        "frames": found["frames"]["used"],
        "seconds": seconds,
    }
    return {name: figures[name] for name in FIGURES}
