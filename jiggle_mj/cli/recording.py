"""The verb `record`, which makes recordings of the simulated reference."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import OptionError
from ..options import Sensing
from .options import AsJson, Disturb, Name, Out, SchedulerUrl
from .terminal import FAILED, INTERRUPTED, bar, console, progress, stop
from .workers import workers

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
    executor: SchedulerUrl = None,
    disturb: Disturb = (),
    overwrite: bool = False,
    as_json: AsJson = False,
) -> None:
    """Simulate the reference tissue and record what the sensors see, without estimating.

    The truth goes to a separate file beside the recording.

    Args:
        scene: name of a shipped scene, or path of a scene file.
        out: the recording to write, for example run.mcap; the truth goes to run.truth.mcap. With --count a folder, in
            which each recording is named by its seed; complete recordings in it are kept.
        sensing: what is recorded: stereo images; noisy tracked points of the tissue; noisy vertices of the reference
            mesh (particles); a noisy cloud of other points in each frame.
        seed: seed of the sensing noise; with --count the seed of the first recording, and each further one adds 1.
        count: number of recordings.
        jobs: number of parallel processes; the number of usable cores if left out.
        executor: Dask scheduler whose workers record instead, into a folder that all of them share.
        disturb: a disturbance that the estimator is not told of, such as gravity=0.5; may be repeated.
            docs/DISTURBANCES.md lists the names.
        overwrite: replace existing files.
        as_json: print the paths and the number of frames to stdout as JSON.
    """
    from jiggle_mj.scenes import Reference, disturbed, load_scene, programme

    from ..episode import observe
    from ..recording.mcap_files import truth_path

    if count is None and (jobs is not None or executor is not None):
        raise OptionError(
            f"--{'jobs' if executor is None else 'executor'} is for several recordings: give --count as well."
        )
    scene_to_record = disturbed(load_scene(scene), disturb)
    if count is not None:
        _record_series(
            scene_to_record,
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
        progress(sum(1 for _ in programme(scene_to_record)), f"record {scene_to_record.name}") as on_frame,
        Reference(scene_to_record, seed=seed, sensing=sensing, dump_dir=out.parent) as reference,
    ):
        n_frames = 0
        for observation in observe(reference, programme(scene_to_record), out, seed=seed, overwrite=overwrite):
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
    """Record a scene with several seeds; exit with 1 where some failed, with 130 after Ctrl-C."""
    from ..series import record_series

    try:
        with workers(jobs, executor) as executing, bar(count, f"record {scene.name}") as advance:
            series = record_series(
                scene,
                folder,
                count=count,
                sensing=sensing,
                seed=seed,
                executor=executing,
                overwrite=overwrite,
                on_done=lambda _: advance(),
            )
    except KeyboardInterrupt:
        stop(
            f"interrupted; the recordings in {folder} are complete; the same command, without --overwrite, continues",
            INTERRUPTED,
        )
    n_made = len(series.recordings) - series.n_kept
    console.print(
        f"{folder}: {n_made} recordings made, {series.n_kept} kept, {len(series.failed)} failed", soft_wrap=True
    )
    for failed_seed, why in series.failed.items():
        console.print(f"seed {failed_seed} failed: {why}", highlight=False, soft_wrap=True)
    if as_json:
        failed = [{"seed": failed_seed, "why": why} for failed_seed, why in series.failed.items()]
        print(json.dumps({"folder": str(folder), "recordings": [*map(str, series.recordings)], "failed": failed}))
    if series.failed:
        sys.exit(FAILED)
