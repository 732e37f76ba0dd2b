"""The loop: actions move the reference tissue, observations move the estimate, and both are written as they come.

Three streams that compose: `observe` turns actions into observations (and records them), `estimate` turns observations
into an estimate (and records it); a recording is another source of observations. Nothing is scored here.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from .actions import Action
from .errors import ActionError, OutputError, PerceptionError
from .estimate import Belief, Detection, Estimate, Sheet
from .observation import Observation
from .recording.declaration import identity
from .recording.estimate import EstimateWriter
from .recording.mcap_files import truth_path
from .recording.reader import Recording, RecordingWriter
from .recording.truth import TruthWriter

if TYPE_CHECKING:
    from jiggle_mj.estimator import Estimator, EstimatorConfig
    from jiggle_mj.scenes import Reference, Scene

RECORDING, ESTIMATE, RESULT, REPORT = "run.mcap", "estimate.mcap", "result.json", "report.html"

OnFrame = Callable[[Observation, Estimate | None], None]
"""Called after each frame, for progress; the estimate is None where there is none."""


@dataclass(frozen=True, kw_only=True)
class Episode:
    """What the estimator made of a series of observations."""

    sheet: Sheet
    estimates: tuple[Estimate, ...]
    belief: Belief
    detection: Detection
    prior_entropy: float
    """Of the belief before anything was seen [nat]."""
    n_frames: int
    """Of the source, those with open jaws and the skipped ones among them."""
    skipped: tuple[tuple[int, str], ...]
    """Index and reason of each frame that the recording or the estimator could not use."""


class Stopwatch:
    """Adds up the time spent in one part of a loop."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __enter__(self) -> None:
        self._began = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self.seconds += time.perf_counter() - self._began


def check_directory(directory: Path, names: Iterable[str], *, overwrite: bool) -> None:
    """Check that the files to come may be written.

    Args:
        directory: the folder.
        names: of the files to come.
        overwrite: results that are there may be replaced; `clear_directory` does it, once nothing stands in the way.

    Raises:
        OutputError: it holds results, or is a file.
    """
    if directory.exists() and not directory.is_dir():
        raise OutputError(f"{directory} is a file; give a folder for the results.")
    there = [name for name in names if (directory / name).exists()]
    if there and not overwrite:
        raise OutputError(f"{directory} already holds {', '.join(there)}; choose another folder or pass --overwrite.")


def clear_directory(directory: Path, names: Iterable[str]) -> None:
    """Make the folder, and remove an earlier run's files, so that no old report stands beside new results.

    Raises:
        OutputError: the folder cannot be made, or a file not removed.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for name in names:
            (directory / name).unlink(missing_ok=True)
    except OSError as failure:
        raise OutputError(f"{directory} cannot be written ({failure.strerror}); give another folder.") from failure


def recording_identity(scene: "Scene", sensing: str, seed: int, policy: str = "") -> str:
    """Ties a recording, its truth and its estimate together: a digest of all that they depend on."""
    from jiggle_mj.scenes import scene_table  # here, so that a recording can be estimated without MuJoCo

    return identity(scene_table(scene), sensing, seed, policy)


def observe(
    reference: "Reference",
    actions: Iterable[Action],
    path: Path | None = None,
    *,
    seed: int,
    policy: str = "",
    overwrite: bool = False,
    watch: Stopwatch | None = None,
    on_refused: Callable[[ActionError], bool] | None = None,
) -> Iterator[Observation]:
    """Carry out actions on the reference tissue, one observation each but where a frame was lost.

    Args:
        reference: the tissue.
        actions: what to do; may be a policy that looks at the estimate before it yields the next.
        path: where to record, truth in a file of its own beside it; None for nowhere.
        seed: of the run, for the recording's metadata.
        policy: who chooses the actions, with all that it depends on; empty for the scene's programme.
        overwrite: replace files that are there.
        watch: adds up the time of the simulation.
        on_refused: told of an action that cannot be carried out, and says whether there is another; if None, it is
            raised.
    """
    watch = watch or Stopwatch()
    with ExitStack() as files:
        recording = truth_file = None
        if path is not None:
            start = reference.truth()
            name = recording_identity(reference.scene, reference.sensing, seed, policy)
            about = {"name": start.scene, "seed": str(seed), "sensing": reference.sensing, "identity": name}
            recording = files.enter_context(
                RecordingWriter(
                    path,
                    camera=reference.camera,
                    declaration=reference.declaration,
                    metadata=about | reference.metadata,
                    overwrite=overwrite,
                )
            )
            truth_file = files.enter_context(
                TruthWriter(
                    truth_path(path),
                    rest=start.rest,
                    faces=start.faces,
                    attached=start.attached,
                    scene=start.scene,
                    details=start.details,
                    identity=name,
                    overwrite=overwrite,
                )
            )
        for action in actions:
            try:
                with watch:
                    observation = reference.step(action)
            except ActionError as refused:
                if on_refused is None:
                    raise
                if on_refused(refused):
                    continue
                break
            if observation.lost:
                continue
            if recording is not None and truth_file is not None:
                recording.write(observation)
                truth_file.write(reference.truth_frame())
            yield observation
        if truth_file is not None:
            truth_file.conclude(reference.truth().details)


def settings(config: "EstimatorConfig") -> dict[str, str]:
    """A configuration as an estimate's metadata holds it."""
    return {name: str(value) for name, value in asdict(config).items()}


def estimate(
    observations: Iterable[Observation],
    estimator: "Estimator",
    path: Path | None = None,
    *,
    metadata: dict[str, str] | None = None,
    on_frame: OnFrame | None = None,
) -> Episode:
    """Show observations to an estimator, one after the other.

    Args:
        observations: from `observe`, or a recording.
        estimator: a fresh one.
        path: where to write the estimate; None for nowhere.
        metadata: of that file.
        on_frame: called after each frame.

    Raises:
        PerceptionError: nothing was estimated at all, or what `Estimator.update` raises.
    """
    estimates: list[Estimate] = []
    n_frames = 0
    with ExitStack() as files:
        writer: EstimateWriter | None = None
        for observation in observations:
            one = estimator.update(observation)
            if one is not None:
                if writer is None and path is not None:
                    said = settings(estimator.config) | (metadata or {})
                    writer = files.enter_context(EstimateWriter(path, estimator.sheet, said))
                if writer is not None:
                    writer.write(one, n_skipped=len(estimator.skipped))
                estimates.append(one)
            n_frames += 1
            if on_frame is not None:
                on_frame(observation, one)
        estimator.release()
        unread = observations.skipped if isinstance(observations, Recording) else []
        skipped = tuple(sorted((*unread, *estimator.skipped)))
        if not estimates:
            why = "; ".join(f"frame {index}: {reason}" for index, reason in skipped[:3])
            raise PerceptionError(
                f"no frame could be used ({why or 'none has closed jaws'}); the estimator learns from frames in which "
                "the tool holds the tissue."
            )
        if writer is not None:
            writer.finish(estimator.belief, estimator.detection, skipped=skipped)
    return Episode(
        sheet=estimator.sheet,
        estimates=tuple(estimates),
        belief=estimator.belief,
        detection=estimator.detection,
        prior_entropy=estimator.prior_entropy,
        n_frames=n_frames + len(unread),
        skipped=skipped,
    )
