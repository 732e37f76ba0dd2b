"""`record` and `import`: what makes recordings."""

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ..errors import OptionError
from ..options import Sensing
from .options import AsJson, Disturb, Name, Out, PathArgument
from .terminal import bar, console, progress, stop

if TYPE_CHECKING:
    from jiggle_mj.scenes import Scene


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
    from jiggle_mj.scenes import Reference, disturbed, load_scene, programme

    from ..episode import observe
    from ..recording.mcap_files import truth_path

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
        progress(sum(1 for _ in programme(loaded)), f"record {loaded.name}") as on_frame,
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
    from ..cluster import cluster
    from ..series import record_series
    from ..worker_processes import WorkerProcesses

    if jobs is not None and executor is not None:
        raise OptionError("--jobs is for this machine, --executor for others: give one of them.")
    try:
        with (
            WorkerProcesses(jobs) if executor is None else cluster(executor) as workers,
            bar(count, f"record {scene.name}") as advance,
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
        stop(f"interrupted; what is in {folder} is whole, and the same command, without --overwrite, goes on", 130)
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
    from ..importing.folder import import_folder

    summary = import_folder(folder, recording, out, overwrite=overwrite)
    for name, why in summary.skipped:
        console.print(f"left out {name}: {why}")
    console.print(
        f"wrote {summary.recording}: {summary.n_frames} frames of {summary.n_points} points, {summary.n_unseen} times "
        f"a point was not seen, {summary.n_held} held; truth: {summary.truth or 'none'}"
    )
    if as_json:
        print(json.dumps(asdict(summary), default=str))
