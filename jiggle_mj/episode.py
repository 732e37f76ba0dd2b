"""The loop of an episode: actions move the reference tissue, observations update the estimate, both are written.

`observe` executes actions, and yields and records observations; `estimate` updates an estimator with observations and
records the estimate. A recording is another source of observations. Scoring is in `jiggle_mj.eval`.
"""

import secrets
import time
from collections.abc import Callable, Generator, Iterable
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from .actions import Action
from .errors import ActionError, OutputError, PerceptionError
from .estimate import Belief, Detection, Estimate, ForceCheck, PointNoise, Sheet
from .observation import Observation
from .recording.declaration import identity
from .recording.estimate import EstimateWriter
from .recording.mcap_files import truth_path
from .recording.output_files import discard, partial_path
from .recording.reader import Recording
from .recording.truth import TruthWriter
from .recording.writer import RecordingWriter

if TYPE_CHECKING:
    from jiggle_mj.estimator import Estimator, EstimatorConfig
    from jiggle_mj.scenes import Reference, Scene

RECORDING, ESTIMATE, RESULT, REPORT = "run.mcap", "estimate.mcap", "result.json", "report.html"
"""Files in the output folder of a run."""
SALT_BYTES = 16
"""Random bytes of a salt: 128 bits, which nobody can try out."""
SHOWN_REASONS = 3
"""How many skipped frames an error names, so that it stays one line."""
MAX_SKIPPED_SHARE = 0.6
"""Largest share of the frames with closed jaws that may be skipped: where most show something else than the sheet, the
few that are used are no result. A half is skipped where one camera has half the rate of the other."""

OnFrame = Callable[[Observation, Estimate | None], None]
"""Callback after each frame, for progress; the estimate is None for a frame that updates nothing."""


@dataclass(frozen=True, kw_only=True)
class Episode:
    """The estimate of a series of observations."""

    sheet: Sheet
    """Particles of the estimator."""
    estimates: tuple[Estimate, ...]
    """Estimate after each used frame."""
    belief: Belief
    """Belief after the last frame."""
    detection: Detection
    """Particles that the final belief reports attached."""
    prior_entropy: float
    """Differential entropy of the belief before the first observation [nat]."""
    n_frames: int
    """Number of frames of the source, including those with open jaws and the skipped ones."""
    skipped: tuple[tuple[int, str], ...]
    """Index and reason of each frame that the recording or the estimator could not use."""
    point_noise: PointNoise | None = None
    """Noise of measured points that the estimator counted with; None for images."""
    cloud_share: float | None = None
    """Median share of a cloud's points that lie on the sheet, over the used frames; None without clouds."""
    force: ForceCheck | None = None
    """Measured and predicted force on the tool; None where none was measured."""


class Stopwatch:
    """Sum of the time spent in one part of a loop."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __enter__(self) -> None:
        self._began = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self.seconds += time.perf_counter() - self._began


def check_directory(directory: Path, names: Iterable[str], *, overwrite: bool) -> None:
    """Check that files may be written to a folder; create and remove nothing.

    Args:
        directory: the folder.
        names: names of the files that will be written.
        overwrite: allow existing files; `clear_directory` removes them later.

    Raises:
        OutputError: the folder holds one of the files, or is a file.
    """
    if directory.exists() and not directory.is_dir():
        raise OutputError(f"{directory} is a file; give a folder for the results.")
    paths = [path for name in names for path in (directory / name, partial_path(directory / name))]
    existing = [path.name for path in paths if path.exists()]
    if existing and not overwrite:
        raise OutputError(
            f"{directory} already holds {', '.join(existing)}; choose another folder or pass --overwrite."
        )


def clear_directory(directory: Path, names: Iterable[str]) -> None:
    """Create the folder, and remove the files of an earlier run, so that no old report stays beside new results.

    Raises:
        OutputError: the folder cannot be created, a file cannot be removed, or another process writes it.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for name in names:
            discard(directory / name)
    except OSError as failure:
        raise OutputError(f"{directory} cannot be written ({failure.strerror}); give another folder.") from failure


def new_salt(scene: "Scene") -> str:
    """Return random text for the identity of a secret scene, so that it does not give the scene away; else nothing."""
    return secrets.token_hex(SALT_BYTES) if scene.secret else ""


def recording_identity(scene: "Scene", sensing: str, seed: int, policy: str = "", *, salt: str = "") -> str:
    """Return the identity that a recording, its truth and its estimate share: a digest of all that they depend on.

    Args:
        scene: the scene.
        sensing: what is sensed.
        seed: seed of the run.
        policy: name and settings of the policy.
        salt: see `new_salt`; the truth file holds it.
    """
    from jiggle_mj.scenes import scene_table  # imported here, so that a recording can be estimated without MuJoCo

    return identity(scene_table(scene), sensing, seed, policy, *([salt] if salt else []))


def observe(
    reference: "Reference",
    actions: Iterable[Action],
    path: Path | None = None,
    *,
    seed: int,
    policy: str = "",
    salt: str | None = None,
    overwrite: bool = False,
    watch: Stopwatch | None = None,
    on_refused: Callable[[ActionError], bool] | None = None,
) -> Generator[Observation, None, None]:
    """Execute actions on the reference tissue and yield one observation for each, except where a frame is lost.

    Args:
        reference: the tissue.
        actions: the actions; may be a policy that reads the estimate before it yields the next one.
        path: the recording to write, with the truth in a separate file beside it; None to record nothing.
        seed: seed of the run, for the recording's metadata.
        policy: name of the policy that chooses the actions, with its settings; empty for the scene's programme.
        salt: the salt of the identity; None for a new one.
        overwrite: replace existing files.
        watch: accumulates the time of the simulation.
        on_refused: called with the error of an action that cannot be executed; returns whether to continue with the
            next action. None to raise the error.

    Raises:
        ActionError: an action cannot be executed, and `on_refused` is None.
        OutputError: the files exist, or cannot be written.
    """
    watch = watch or Stopwatch()
    with ExitStack() as files:
        recording = truth_file = None
        if path is not None:
            initial_truth = reference.truth()
            salt = new_salt(reference.scene) if salt is None else salt
            name = recording_identity(reference.scene, reference.sensing, seed, policy, salt=salt)
            run_metadata = {"name": initial_truth.scene, "sensing": reference.sensing, "identity": name}
            if not reference.scene.secret:
                run_metadata["seed"] = str(seed)
            recording = files.enter_context(
                RecordingWriter(
                    path,
                    camera=reference.camera,
                    declaration=reference.declaration,
                    metadata=run_metadata | reference.metadata,
                    overwrite=overwrite,
                )
            )
            truth_file = files.enter_context(
                TruthWriter(
                    truth_path(path),
                    rest=initial_truth.rest,
                    faces=initial_truth.faces,
                    attached=initial_truth.attached,
                    scene=initial_truth.scene,
                    details=initial_truth.details | {"seed": seed},
                    identity=name,
                    salt=salt,
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
            truth_file.conclude(reference.truth().details | {"seed": seed})


def settings(config: "EstimatorConfig") -> dict[str, str]:
    """Return a configuration as the metadata of an estimate holds it."""
    return {name: str(value) for name, value in asdict(config).items()}


def estimate(
    observations: Iterable[Observation],
    estimator: "Estimator",
    path: Path | None = None,
    *,
    metadata: dict[str, str] | None = None,
    on_frame: OnFrame | None = None,
) -> Episode:
    """Update an estimator with observations, one after the other, and return the result.

    Args:
        observations: the yield of `observe`, or a recording.
        estimator: an estimator that has seen nothing yet.
        path: the estimate to write; None to write nothing.
        metadata: further metadata of that file.
        on_frame: called after each frame.

    Raises:
        PerceptionError: no frame could be used, or most frames with closed jaws could not, or `Estimator.update` raises
            it.
    """
    estimates: list[Estimate] = []
    n_frames, closed = 0, list[int]()
    with ExitStack() as files:
        writer: EstimateWriter | None = None
        for observation in observations:
            updated = estimator.update(observation)
            if updated is not None:
                if writer is None and path is not None:
                    all_metadata = settings(estimator.config) | (metadata or {})
                    writer = files.enter_context(EstimateWriter(path, estimator.sheet, all_metadata))
                if writer is not None:
                    writer.write(updated, n_skipped=len(estimator.skipped))
                estimates.append(updated)
            n_frames += 1
            if observation.tool.closed:
                closed.append(observation.index)
            if on_frame is not None:
                on_frame(observation, updated)
        estimator.release()
        unreadable = observations.skipped if isinstance(observations, Recording) else []
        skipped = tuple(sorted((*unreadable, *estimator.skipped)))
        if not estimates:
            why = "; ".join(f"frame {index}: {reason}" for index, reason in skipped[:SHOWN_REASONS])
            raise PerceptionError(
                f"no frame could be used ({why or 'none has closed jaws'}); the estimator learns from frames in which "
                "the tool holds the tissue."
            )
        _refuse_most_skipped(closed, len(estimates), skipped)
        if writer is not None:
            writer.finish(estimator.belief, estimator.detection, skipped=skipped, frames=estimator.kept_frames)
    return Episode(
        sheet=estimator.sheet,
        estimates=tuple(estimates),
        belief=estimator.belief,
        detection=estimator.detection,
        prior_entropy=estimator.prior_entropy,
        n_frames=n_frames + len(unreadable),
        skipped=skipped,
        point_noise=estimator.point_noise,
        cloud_share=median(estimator.cloud_shares) if estimator.cloud_shares else None,
        force=estimator.force_check,
    )


def _refuse_most_skipped(closed: list[int], n_used: int, skipped: Iterable[tuple[int, str]]) -> None:
    """Refuse an estimate from a few frames only, of a recording that does not show the sheet in most.

    Args:
        closed: index of each readable frame with closed jaws, at least one.
        n_used: how many of them are used.
        skipped: index and reason of all that were not used.

    Raises:
        PerceptionError: more than `MAX_SKIPPED_SHARE` of the frames since the jaws closed first were skipped; those
            with open jaws do not count.
    """
    reasons = dict(reversed([(index, why) for index, why in skipped if index >= closed[0]]))
    n_frames = len(closed) + len(reasons.keys() - set(closed))
    n_skipped = n_frames - n_used
    if n_skipped > MAX_SKIPPED_SHARE * n_frames:
        index = min(reasons)
        raise PerceptionError(
            f"{n_skipped} of {n_frames} frames with closed jaws cannot be used; at most {MAX_SKIPPED_SHARE:.0%} may be "
            f"skipped. The first one is frame {index}: {reasons[index].rstrip('.')}. Mend what these frames should "
            "show, or leave them out of the recording."
        )
