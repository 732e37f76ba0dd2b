"""The two whole jobs: a scene from the tissue to the report, and a recording from its file to the report.

Each fills a folder with the files of an experiment. The truth, where there is any, is opened only after the estimate is
written.
"""

import platform
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from jiggle_mj.actions import Grasp
from jiggle_mj.episode import (
    ESTIMATE,
    RECORDING,
    REPORT,
    RESULT,
    Episode,
    OnFrame,
    Stopwatch,
    check_directory,
    clear_directory,
    estimate,
    observe,
    recording_identity,
    settings,
)
from jiggle_mj.errors import OutputError, PerceptionError, RecordingError
from jiggle_mj.estimator import Estimator, EstimatorConfig
from jiggle_mj.estimator.perception import Disparity, TissueMask
from jiggle_mj.estimator.planning.policy import INTERRUPTED, Decision, Policy
from jiggle_mj.limits import Limits
from jiggle_mj.observation import StereoPair
from jiggle_mj.recording.estimate import EstimateRecording, read_estimate
from jiggle_mj.recording.mcap_files import truth_path
from jiggle_mj.recording.reader import Recording
from jiggle_mj.truth import Truth

from ..metrics.score import IDENTITY, RECORDED, Json, read_scorable, result, score_read, write_result
from ..report.run_page import shown_steps, write_report
from .acting import actions, acts, check_goes_with, policy_named

if TYPE_CHECKING:
    from jiggle_mj.options import Sensing
    from jiggle_mj.scenes import Scene

PACKAGES = ("jiggle-mj", "mujoco", "jax", "numpy", "scipy", "opencv-python-headless")


def run_scene(
    scene: "Scene",
    directory: Path,
    *,
    seed: int = 0,
    sensing: "Sensing" = "stereo",
    policy: str | None = None,
    steps: int | None = None,
    config: EstimatorConfig | None = None,
    mask: TissueMask | None = None,
    disparity: Disparity | None = None,
    overwrite: bool = False,
    on_frame: OnFrame | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Json:
    """The main job: reference tissue, observations, estimate, score, report.

    Args:
        scene: the tissue, the grasp programme and the limits of a policy.
        directory: where the files go.
        seed: of the sensing noise; the same seed gives the same recording.
        sensing: what the estimator sees.
        policy: who chooses the pulls, one of `POLICIES`; the scene's own if None.
        steps: how many actions a policy may take at most; the programme takes its own.
        config: of the estimator.
        mask: see `Estimator`.
        disparity: see `Estimator`.
        overwrite: replace an earlier run's files.
        on_frame: called after each frame.
        stop: asked before each action; once it says so the run ends, and what was seen is judged and written.

    Returns:
        The content of result.json.

    Raises:
        JiggleError: what any of the parts raises.
    """
    from jiggle_mj.scenes import Reference  # here, so that a recording can be estimated without MuJoCo

    policy = policy or scene.programme.policy
    chooses, config = policy_named(policy, scene, seed=seed), config or EstimatorConfig()
    if chooses is not None:
        config = replace(config, refinement="frames")
        check_goes_with(chooses, config)
    own = (RECORDING, truth_path(Path(RECORDING)).name, ESTIMATE, RESULT, REPORT)
    check_directory(directory, own, overwrite=overwrite)
    watch = Stopwatch()
    with Reference(scene, seed=seed, sensing=sensing, dump_dir=directory) as reference:
        estimator = Estimator(reference.declaration, reference.camera, config=config, mask=mask, disparity=disparity)
        clear_directory(directory, own)
        said = "" if chooses is None else f"{policy}, {steps} steps, {settings(estimator.config)}"
        about = {RECORDED: scene.name, IDENTITY: recording_identity(scene, sensing, seed, said)}
        does = actions(scene, chooses, estimator, steps, stop=stop)
        refused = None if chooses is None else chooses.refused
        frames = observe(
            reference, does, directory / RECORDING, seed=seed, policy=said, watch=watch, on_refused=refused
        )
        try:
            episode = estimate(frames, estimator, directory / ESTIMATE, metadata=about, on_frame=on_frame)
        except PerceptionError as failure:
            if chooses is None or any(isinstance(one.action, Grasp) for one in chooses.decisions):
                raise
            raise PerceptionError(f"the policy {policy} has ended, as {chooses.ended}: {failure}") from failure
    unscored = _result(
        episode,
        scene=scene.name,
        seed=seed,
        sensing=sensing,
        estimator=estimator.config.filter,
        policy=policy,
        disturbances=reference.metadata.get("disturbances"),
        simulation_s=watch.seconds,
        limits=scene.limits.limits(),
        decisions=[] if chooses is None else chooses.decisions,
        ended=_ended(chooses, interrupted=stop()),
        procedure=acts(chooses, estimator),
    )
    write_result(directory / RESULT, unscored)
    unscored, found, truth = read_scorable(directory, truth_path(directory / RECORDING))
    scored = score_read(directory, unscored, found, truth)
    _report(directory, episode, scored, recording=directory / RECORDING, truth=truth)
    return scored


def run_estimator(
    recording_path: Path,
    directory: Path,
    *,
    config: EstimatorConfig | None = None,
    mask: TissueMask | None = None,
    disparity: Disparity | None = None,
    overwrite: bool = False,
    allow_truncated: bool = False,
    on_frame: OnFrame | None = None,
) -> Json:
    """Estimate from a recording: observations only.

    Args:
        recording_path: the MCAP file.
        directory: where the files go.
        config: of the estimator.
        mask: see `Estimator`.
        disparity: see `Estimator`.
        overwrite: replace an earlier run's files.
        allow_truncated: use what is whole of a recording that was cut off.
        on_frame: called after each frame.

    Returns:
        The content of result.json, without what needs the truth.

    Raises:
        JiggleError: what any of the parts raises.
    """
    recording = Recording.open(recording_path, allow_truncated=allow_truncated)
    own = (ESTIMATE, RESULT, REPORT)
    check_directory(directory, own, overwrite=overwrite)
    estimator = Estimator(recording.declaration, recording.camera, config=config, mask=mask, disparity=disparity)
    clear_directory(directory, own)
    name = recording.metadata.get("name", recording_path.stem)
    about = {RECORDED: name, IDENTITY: recording.metadata.get("identity", "")}
    episode = estimate(recording, estimator, directory / ESTIMATE, metadata=about, on_frame=on_frame)
    figures = _result(
        episode,
        scene=name,
        seed=int(recording.metadata.get("seed", 0)),
        sensing=recording.metadata.get("sensing", "points" if recording.camera is None else "stereo"),
        estimator=estimator.config.filter,
        policy="recorded",
        disturbances=recording.metadata.get("disturbances"),
    )
    write_result(directory / RESULT, figures)
    _report(directory, episode, figures, recording=recording_path)
    return figures


def score_directory(
    directory: Path, truth: Path, *, recording: Path | None = None, log: Callable[[str], None] = lambda _: None
) -> Json:
    """Score an estimate that lies in a folder, and write its report anew with the truth beside it.

    Args:
        directory: the folder.
        truth: the truth file.
        recording: what was estimated, for the report's pictures; if None, it is looked for beside the truth file and in
            the folder.
        log: told if the report loses its pictures.

    Raises:
        RecordingError: the folder holds no estimate, the file no truth, or one of another recording.
        OutputError: the estimate did not finish.
    """
    unscored, found, true = read_scorable(directory, truth)
    if recording is not None and not _is_of(found, recording):
        raise RecordingError(f"{recording} is not the recording that {directory} estimates.")
    figures = score_read(directory, unscored, found, true)
    if recording is None:
        beside = truth.with_name(truth.name.replace(".truth.", "."))
        candidates = (path for path in (beside, directory / RECORDING) if path != truth and path.exists())
        recording = next((path for path in candidates if _is_of(found, path)), None)
    if recording is None and figures["sensing"] == "stereo":
        log("the recording is not beside the truth: the report has no pictures; pass --recording for them")
    _report(directory, found, figures, recording=recording, truth=true)
    return figures


def _ended(policy: Policy | None, *, interrupted: bool) -> str | None:
    """Why a policy has ended; of the scene's programme, only that it did not get to its end."""
    if policy is None:
        return INTERRUPTED if interrupted else None
    return policy.ended


def _is_of(read: EstimateRecording, recording: Path) -> bool:
    """Whether an estimate is of this recording, by name and identity."""
    about = Recording.open(recording, allow_truncated=True).metadata
    same = about.get("name", recording.stem) == read.metadata.get(RECORDED)
    return same and about.get("identity", "") == read.metadata.get(IDENTITY, "")


def _report(
    directory: Path,
    found: Episode | EstimateRecording,
    figures: Json,
    *,
    recording: Path | None,
    truth: Truth | None = None,
) -> None:
    """Write report.html; the pictures come from the recording, if there is one with images."""
    if found.belief is None or found.detection is None:
        raise OutputError(f"{directory / ESTIMATE} ends before its belief; estimate the recording again.")
    opened = None if recording is None else Recording.open(recording, allow_truncated=True)
    settings: dict[str, object] = {"estimate": dict(read_estimate(directory / ESTIMATE).metadata)}
    if opened is not None:
        declared = asdict(opened.declaration)
        settings["declared"] = {key: value for key, value in declared.items() if key != "mesh"}
    settings["versions"] = {name: version(name) for name in PACKAGES} | {"python": platform.python_version()}
    pairs: dict[int, StereoPair] = {}
    if opened is not None and opened.camera is not None:
        shown = {found.estimates[step].index for step in shown_steps(found.estimates, found.sheet.rest)}
        pairs = {frame.index: frame.images for frame in opened if frame.index in shown and frame.images is not None}
    write_report(
        directory / REPORT,
        sheet=found.sheet,
        estimates=found.estimates,
        belief=found.belief,
        detection=found.detection,
        result=figures,
        settings=settings,
        truth=truth,
        images=pairs.get if pairs else None,
        camera=None if opened is None else opened.camera,
    )


def _result(
    episode: Episode,
    *,
    scene: str,
    seed: int,
    sensing: str,
    estimator: str,
    policy: str,
    disturbances: str | None,
    simulation_s: float | None = None,
    limits: Limits | None = None,
    decisions: Sequence[Decision] = (),
    ended: str | None = None,
    procedure: Json | None = None,
) -> Json:
    return result(
        scene=scene,
        seed=seed,
        sensing=sensing,
        estimator=estimator,
        policy=policy,
        disturbances=disturbances,
        sheet=episode.sheet,
        estimates=episode.estimates,
        detection=episode.detection,
        prior_entropy=episode.prior_entropy,
        n_frames=episode.n_frames,
        skipped=episode.skipped,
        simulation_s=simulation_s,
        limits=limits,
        decisions=decisions,
        ended=ended,
        procedure=procedure,
    )
