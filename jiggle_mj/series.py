"""Many recordings of one scene, each with a seed of its own, made by any `concurrent.futures.Executor`.

A recording is written in a hidden folder of its own and moved to its final name when it is whole, the truth first: a
final name never means half a recording, whatever is killed. A series that was interrupted goes on where it was. The
bytes depend on scene, sensing and seed alone, not on who records how many at a time.
"""

import shutil
import tempfile
from collections import Counter
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue

from mcap.records import Metadata

from jiggle_mj.options import Sensing
from jiggle_mj.scenes import Reference, Scene, programme

from .cluster import died_with_its_worker
from .episode import check_directory, clear_directory, observe, recording_identity
from .errors import OptionError, OutputError, RecordingError, SimulationError
from .recording.declaration import METADATA
from .recording.mcap_files import iterate_records, truth_path
from .worker_processes import WorkerProcesses

TRIES = 3
"""How many workers may die at a recording before it is given up."""
CANCELLED = "its executor cancelled it, as one does that was stopped or lost its scheduler"


@dataclass(frozen=True, kw_only=True)
class RecordingSeries:
    """What there is of a series."""

    folder: Path
    recordings: tuple[Path, ...]
    """Whole, by seed; the truth of each is beside it."""
    n_kept: int
    """Of the recordings, those that were there before."""
    failed: dict[int, str]
    """Why there is no recording of a seed."""


@dataclass(frozen=True, kw_only=True)
class _Order:
    """One recording to be made. Clusters log the orders that fail, so the scene, which may be secret, is not shown."""

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
    """Record a scene with the seeds `seed` to `seed + count - 1`, except those that are whole in the folder already.

    Files are named by their seed: 000007.mcap and 000007.truth.mcap. A recording whose worker dies is begun anew, until
    `TRIES` have died; one whose simulation fails leaves its state in 000007.failed. Either way the others go on.

    Args:
        scene: what is recorded.
        folder: where the files go; for executors on other machines, a folder that they share under this name.
            Recordings of other seeds that are there stay, whatever they are of.
        count: how many.
        sensing: what is recorded.
        seed: of the first recording's sensing noise.
        executor: who records, and is left running; None for processes on all cores of this machine (see
            `WorkerProcesses`, which may be given too).
        overwrite: remove the recordings of these seeds first.
        on_done: told the seed of each recording that is there, for progress.

    Returns:
        Which recordings there are, and which failed.

    Raises:
        OptionError: fewer than one recording, or a seed below 0.
        OutputError: the folder cannot be used, or holds other recordings under these names.
        JiggleError: what would befall every recording: the scene is impossible, no OpenGL. What is whole stays.
        KeyboardInterrupt: what has not begun is cancelled; what is whole stays.
    """
    folder = Path(folder)
    if count < 1:
        raise OptionError(f"count = {count}: must be at least 1.")
    if seed < 0:
        raise OptionError(f"seed = {seed}: must be an integer of at least 0.")
    orders = [
        _Order(scene=scene, sensing=sensing, seed=one, path=(folder / f"{one:06d}.mcap").absolute())
        for one in range(seed, seed + count)
    ]
    files = [path.name for order in orders for path in (order.path, truth_path(order.path))]
    check_directory(folder, (), overwrite=overwrite)
    clear_directory(folder, files if overwrite else ())
    kept = {order.seed for order in orders if _is_whole(order)}
    on_done = on_done or (lambda _: None)
    for one in sorted(kept):
        on_done(one)
    coming = [order for order in orders if order.seed not in kept]
    with ExitStack() as own:
        if executor is None:
            executor = own.enter_context(WorkerProcesses())
        failed = _carry_out(coming, executor, on_done)
    return RecordingSeries(
        folder=folder,
        recordings=tuple(folder / order.path.name for order in orders if order.seed not in failed),
        n_kept=len(kept),
        failed=dict(sorted(failed.items())),
    )


def _carry_out(orders: list[_Order], executor: Executor, on_done: Callable[[int], None]) -> dict[int, str]:
    """Have the orders carried out; why some could not be, by seed."""
    finished: SimpleQueue[Future[None]] = SimpleQueue()
    pending: dict[Future[None], _Order] = {}
    deaths: Counter[int] = Counter()
    failed: dict[int, str] = {}

    def submit(order: _Order) -> None:
        try:
            future = executor.submit(_record, order)
        except BrokenExecutor as failure:
            future = Future()
            future.set_exception(failure)
        pending[future] = order
        future.add_done_callback(finished.put)

    try:
        for order in orders:
            submit(order)
        while pending:
            future = finished.get()
            order = pending.pop(future)
            failure = CancelledError(CANCELLED) if future.cancelled() else future.exception()
            if failure is None:
                on_done(order.seed)
            elif isinstance(failure, BrokenExecutor):
                deaths[order.seed] += 1
                if deaths[order.seed] < TRIES:
                    submit(order)
                else:
                    failed[order.seed] = f"{TRIES} times its worker died or could not be started: {failure}."
            elif isinstance(failure, SimulationError | CancelledError) or died_with_its_worker(failure):
                failed[order.seed] = str(failure)
            else:
                raise failure
    finally:
        for future in pending:
            future.cancel()
    return failed


def _record(order: _Order) -> None:
    """Make one recording and its truth, whole or not at all; what a killed worker left of it goes first."""
    path = order.path
    for left in path.parent.glob(f".{path.stem}-*"):
        shutil.rmtree(left, ignore_errors=True)
    with (
        tempfile.TemporaryDirectory(prefix=f".{path.stem}-", dir=path.parent) as hidden,
        Reference(
            order.scene, seed=order.seed, sensing=order.sensing, dump_dir=path.with_suffix(".failed")
        ) as reference,
    ):
        made = Path(hidden) / path.name
        for _ in observe(reference, programme(order.scene), made, seed=order.seed):
            pass
        truth_path(made).replace(truth_path(path))
        made.replace(path)


def _is_whole(order: _Order) -> bool:
    """Whether the recording and its truth are there.

    Raises:
        OutputError: the file is another recording, or none.
    """
    if not order.path.exists():
        return False
    remedy = "Choose another folder or pass --overwrite."
    try:
        records = iterate_records(order.path)
        said = next((one.metadata for one in records if isinstance(one, Metadata) and one.name == METADATA), {})
    except RecordingError as failure:
        raise OutputError(f"the place of seed {order.seed} is taken: {failure} {remedy}") from failure
    if said.get("identity") != recording_identity(order.scene, order.sensing, order.seed):
        asked = {"name": order.scene.name, "sensing": order.sensing, "seed": str(order.seed)}
        found = {key: said.get(key, "unknown") for key in asked}
        why = "a scene of that name with other contents or disturbances" if found == asked else f"{found}, not {asked}"
        raise OutputError(f"{order.path} is of {why}. {remedy}")
    return truth_path(order.path).exists()
