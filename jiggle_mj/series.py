"""Many recordings of one scene, one per seed, made by any `concurrent.futures.Executor`.

A recording is written in a hidden folder and moved to its final name when it is complete, the truth first: a file with
a final name is complete, whatever process is killed. An interrupted series continues where it stopped. The bytes depend
on scene, sensing and seed alone, not on the executor or the number of its workers.
"""

import shutil
import tempfile
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from mcap.records import Metadata

from jiggle_mj.options import SENSING, Sensing
from jiggle_mj.scenes import Reference, Scene, programme

from .argument_checks import as_choice, as_instance, as_integer, as_path, quoted
from .episode import check_directory, clear_directory, observe, recording_identity
from .errors import OptionError, OutputError, RecordingError, SimulationError
from .recording.declaration import METADATA
from .recording.mcap_files import iterate_records, truth_path
from .recording.truth import salt
from .run_each import run_each
from .worker_processes import WorkerProcesses

MAX_RECORDINGS = 100_000
"""Most recordings of one series: of some MB each they fill a disk."""


@dataclass(frozen=True, kw_only=True)
class RecordingSeries:
    """The recordings of a series that exist, and the reasons for those that do not."""

    folder: Path
    """Folder of the series."""
    recordings: tuple[Path, ...]
    """Complete recordings by seed; the truth of each is beside it."""
    n_kept: int
    """Number of recordings that existed before."""
    failed: dict[int, str]
    """Reason by seed for each recording that failed."""


@dataclass(frozen=True, kw_only=True)
class _Order:
    """One recording to make.

    Clusters log the repr of an order that fails, so it omits the scene, which may be secret.
    """

    scene: Scene = field(repr=False)
    sensing: Sensing
    seed: int
    path: Path


def record_series(
    scene: Scene,
    folder: Path | str,
    *,
    count: int,
    sensing: Sensing = "stereo",
    seed: int = 0,
    executor: Executor | None = None,
    overwrite: bool = False,
    on_done: Callable[[int], None] | None = None,
) -> RecordingSeries:
    """Record a scene with the seeds `seed` to `seed + count - 1`, except those that are complete in the folder.

    Files are named by their seed: 000007.mcap and 000007.truth.mcap. A recording whose worker dies is restarted, up to
    `run_each.TRIES` times in all; one whose simulation fails leaves its state in 000007.failed. The others continue.

    Args:
        scene: the scene to record.
        folder: the folder for the files; executors on other machines must share it under this name. Files of other
            seeds stay.
        count: number of recordings.
        sensing: what each observation holds.
        seed: seed of the first recording's sensing noise.
        executor: the executor that runs the simulations; it is not shut down. None for `WorkerProcesses` on all cores
            of this machine.
        overwrite: remove the recordings of these seeds first.
        on_done: called with the seed of each recording that exists, for progress.

    Returns:
        The recordings that exist, and the reasons for those that failed.

    Raises:
        OptionError: fewer than one recording or more than `MAX_RECORDINGS`, a seed below 0, or an argument of another
            type.
        OutputError: the folder cannot be used, or holds other recordings under these names.
        JiggleError: every recording would fail: the scene is impossible, no OpenGL. Complete recordings stay.
        KeyboardInterrupt: recordings that have not begun are cancelled; complete ones stay.
    """
    as_instance(scene, "scene", Scene, hint="load_scene(NAME) reads one.")
    as_choice(sensing, "sensing", SENSING)
    folder = as_path(folder, "folder")
    count, seed = as_integer(count, "count", at_least=1), as_integer(seed, "seed", at_least=0)
    if count > MAX_RECORDINGS:
        raise OptionError(
            f"count = {quoted(count)}: at most {MAX_RECORDINGS} recordings are made; give another --seed for "
            "further ones."
        )
    if executor is not None:
        as_instance(executor, "executor", Executor, hint="WorkerProcesses() is one.")
    orders = [
        _Order(scene=scene, sensing=sensing, seed=each, path=(folder / f"{each:06d}.mcap").absolute())
        for each in range(seed, seed + count)
    ]
    files = [path.name for order in orders for path in (order.path, truth_path(order.path))]
    check_directory(folder, (), overwrite=overwrite)
    clear_directory(folder, files if overwrite else ())
    kept = {order.seed for order in orders if _is_complete(order)}
    on_done = on_done or (lambda _: None)
    for kept_seed in sorted(kept):
        on_done(kept_seed)
    missing = [order for order in orders if order.seed not in kept]
    with ExitStack() as stack:
        if executor is None:
            executor = stack.enter_context(WorkerProcesses())
        failed = run_each(
            _record,
            {order.seed: order for order in missing},
            executor,
            on_done=lambda done, why: on_done(done) if why is None else None,
            fails_alone=lambda failure: isinstance(failure, SimulationError),
        )
    return RecordingSeries(
        folder=folder,
        recordings=tuple(folder / order.path.name for order in orders if order.seed not in failed),
        n_kept=len(kept),
        failed=dict(sorted(failed.items())),
    )


def _record(order: _Order) -> None:
    """Make one recording and its truth, complete or not at all; remove first what a killed worker left of it."""
    path = order.path
    for abandoned in path.parent.glob(f".{path.stem}-*"):
        shutil.rmtree(abandoned, ignore_errors=True)
    with (
        tempfile.TemporaryDirectory(prefix=f".{path.stem}-", dir=path.parent) as hidden,
        Reference(
            order.scene, seed=order.seed, sensing=order.sensing, dump_dir=path.with_suffix(".failed")
        ) as reference,
    ):
        unfinished = Path(hidden) / path.name
        for _ in observe(reference, programme(order.scene), unfinished, seed=order.seed):
            pass
        truth_path(unfinished).replace(truth_path(path))
        unfinished.replace(path)


def _is_complete(order: _Order) -> bool:
    """Return whether the recording and its truth exist.

    Raises:
        OutputError: the file is another recording, or no recording.
    """
    if not order.path.exists():
        return False
    remedy = "Choose another folder or pass --overwrite."
    try:
        records = iterate_records(order.path)
        metadata = next((r.metadata for r in records if isinstance(r, Metadata) and r.name == METADATA), {})
    except RecordingError as failure:
        raise OutputError(f"seed {order.seed} has another file in its place: {failure} {remedy}") from failure
    truth = truth_path(order.path)
    try:
        salted = salt(truth) if truth.exists() else ""
    except RecordingError as failure:
        raise OutputError(f"the truth of seed {order.seed} cannot be read: {failure} {remedy}") from failure
    if metadata.get("identity") != recording_identity(order.scene, order.sensing, order.seed, salt=salted):
        requested = {"name": order.scene.name, "sensing": order.sensing, "seed": str(order.seed)}
        found = {key: metadata.get(key, "unknown") for key in requested}
        same_name = "a scene of that name with other contents or disturbances"
        what = same_name if found == requested else f"{found}, not {requested}"
        raise OutputError(f"{order.path} is a recording of {what}. {remedy}")
    return truth.exists()
