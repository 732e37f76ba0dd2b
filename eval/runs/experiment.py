"""The two complete jobs: a scene from the tissue to the report, and a recording from its file to the report.

Each fills a folder with the files of an experiment. The truth, if there is one, is opened only after the estimate is
written.
"""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jiggle_mj.actions import Grasp
from jiggle_mj.argument_checks import as_instance, as_path
from jiggle_mj.episode import (
    ESTIMATE,
    RECORDING,
    REPORT,
    RESULT,
    OnFrame,
    Stopwatch,
    check_directory,
    clear_directory,
    estimate,
    new_salt,
    observe,
    recording_identity,
    settings,
)
from jiggle_mj.errors import PerceptionError
from jiggle_mj.estimator import Estimator, EstimatorConfig
from jiggle_mj.estimator.perception import Disparity, FrameMask, TissueMask
from jiggle_mj.estimator.planning.policy import INTERRUPTED, Policy
from jiggle_mj.recording.mcap_files import truth_path
from jiggle_mj.recording.output_files import fills_folder
from jiggle_mj.recording.reader import PAIRING_TOLERANCE_NS, Recording

from ..metrics.result import Run, result, score_read
from ..metrics.result_file import (
    IDENTITY,
    RECORDED,
    TOLERANCE,
    Json,
    read_scorable,
    write_result,
)
from .acting import actions, acts, check_policy_fits, policy_named
from .check_before import check_before
from .folder_report import write_folder_report
from .settings_used import settings_used, with_declared

if TYPE_CHECKING:
    from jiggle_mj.options import Sensing
    from jiggle_mj.scenes import Scene


@fills_folder
def run_scene(
    scene: "Scene",
    directory: Path,
    *,
    seed: int = 0,
    sensing: "Sensing" = "stereo",
    policy: str | None = None,
    planner: Policy | None = None,
    steps: int | None = None,
    config: EstimatorConfig | None = None,
    declare: Mapping[str, Any] | None = None,
    mask: TissueMask | FrameMask | None = None,
    disparity: Disparity | None = None,
    overwrite: bool = False,
    on_frame: OnFrame | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Json:
    """Run the main job: reference tissue, observations, estimate, score, report.

    Args:
        scene: the tissue, the grasp programme and the limits of a policy.
        directory: where the files go.
        seed: of the sensing noise; the same seed gives the same recording.
        sensing: what the estimator sees.
        policy: name of what chooses the pulls, one of `POLICIES`; the scene's own if None.
        planner: plans in place of the policy of that name.
        steps: most actions of a policy; the programme has its own number.
        config: of the estimator.
        declare: properties of the tissue by name, over those that are declared already; see `Declaration`.
        mask: see `Estimator`.
        disparity: see `Estimator`.
        overwrite: replace an earlier run's files.
        on_frame: called after each frame.
        stop: asked before each action; once it is true the run ends, and what was seen is scored and written.

    Returns:
        The content of result.json.

    Raises:
        JiggleError: what any of the parts raises.
    """
    from jiggle_mj.scenes import Reference, Scene  # here, so that a recording can be estimated without MuJoCo

    as_instance(scene, "scene", Scene, hint="load_scene(NAME) reads one.")
    directory = as_path(directory, "the folder")
    policy = policy or scene.programme.policy
    planner, config = planner or policy_named(policy, scene, seed=seed), config or EstimatorConfig()
    if planner is not None:
        config = replace(config, refinement="frames")
        check_policy_fits(planner, config)
    own = (RECORDING, truth_path(Path(RECORDING)).name, ESTIMATE, RESULT, REPORT)
    check_directory(directory, own, overwrite=overwrite)
    watch = Stopwatch()
    with Reference(scene, seed=seed, sensing=sensing, dump_dir=directory) as reference, ExitStack() as files:
        declaration = with_declared(reference.declaration, declare)
        estimator = Estimator(declaration, reference.camera, config=config, mask=mask, disparity=disparity)
        clear_directory(directory, own)
        description = "" if planner is None else f"{policy}, {steps} steps, {settings(estimator.config)}"
        salt = new_salt(scene)
        name = recording_identity(scene, sensing, seed, description, salt=salt)
        about = {RECORDED: scene.name, IDENTITY: name}
        frames = observe(
            reference,
            actions(scene, planner, estimator, steps, stop=stop),
            directory / RECORDING,
            seed=seed,
            policy=description,
            salt=salt,
            watch=watch,
            on_refused=None if planner is None else planner.refused,
        )
        files.callback(frames.close)
        try:
            episode = estimate(frames, estimator, directory / ESTIMATE, metadata=about, on_frame=on_frame)
        except PerceptionError as failure:
            if planner is None or any(isinstance(decision.action, Grasp) for decision in planner.decisions):
                raise
            raise PerceptionError(f"the policy {policy} has ended, as {planner.ended}: {failure}") from failure
    run = Run(
        episode=episode,
        scene=scene.name,
        seed=None if scene.secret else seed,
        sensing=sensing,
        estimator=estimator.config.filter,
        policy=policy,
        disturbances=reference.metadata.get("disturbances"),
        settings=settings_used(declaration, estimator.config, declare=declare, declared=True),
        simulation_s=watch.seconds,
        limits=scene.limits.limits(),
        decisions=() if planner is None else tuple(planner.decisions),
        ended=_ended(planner, interrupted=stop()),
        procedure=acts(planner, estimator),
    )
    write_result(directory / RESULT, result(run))
    unscored, estimated, truth = read_scorable(directory, truth_path(directory / RECORDING))
    scored = score_read(directory, unscored, estimated, truth)
    write_folder_report(directory, episode, scored, recording=directory / RECORDING, truth=truth)
    return scored


@fills_folder
def run_estimator(
    recording_path: Path,
    directory: Path,
    *,
    config: EstimatorConfig | None = None,
    declare: Mapping[str, Any] | None = None,
    mask: TissueMask | FrameMask | None = None,
    disparity: Disparity | None = None,
    overwrite: bool = False,
    allow_truncated: bool = False,
    allow_implausible: bool = False,
    tolerance_ns: int = PAIRING_TOLERANCE_NS,
    on_frame: OnFrame | None = None,
    log: Callable[[str], None] = lambda _: None,
) -> Json:
    """Estimate from a recording, which holds observations only, and write the report.

    Args:
        recording_path: the MCAP file.
        directory: where the files go.
        config: of the estimator.
        declare: properties of the tissue by name, over those that are declared already; see `Declaration`.
        mask: see `Estimator`.
        disparity: see `Estimator`.
        overwrite: replace an earlier run's files.
        allow_truncated: use the complete part of a recording that was cut off.
        allow_implausible: use a recording that `problems` refuses.
        tolerance_ns: largest difference between the stamps of one frame [ns].
        on_frame: called after each frame.
        log: gets a line for what is doubtful about the recording, and for what is assumed of its tissue.

    Returns:
        The content of result.json, without what needs the truth.

    Raises:
        JiggleError: what any of the parts raises.
    """
    recording_path, directory = as_path(recording_path, "the recording"), as_path(directory, "the folder")
    recording = Recording.open(recording_path, allow_truncated=allow_truncated, tolerance_ns=tolerance_ns)
    own = (ESTIMATE, RESULT, REPORT)
    check_directory(directory, own, overwrite=overwrite)
    declaration = with_declared(recording.declaration, declare)
    check_before(recording, recording_path, declare, allow_implausible=allow_implausible, log=log)
    estimator = Estimator(declaration, recording.camera, config=config, mask=mask, disparity=disparity)
    clear_directory(directory, own)
    name = recording.metadata.get("name", recording_path.stem)
    about = {RECORDED: name, IDENTITY: recording.metadata.get("identity", ""), TOLERANCE: str(tolerance_ns)}
    episode = estimate(recording, estimator, directory / ESTIMATE, metadata=about, on_frame=on_frame)
    run = Run(
        episode=episode,
        scene=name,
        seed=recording.seed,
        sensing=recording.metadata.get("sensing", "points" if recording.camera is None else "stereo"),
        estimator=estimator.config.filter,
        policy="recorded",
        disturbances=recording.metadata.get("disturbances"),
        settings=settings_used(declaration, estimator.config, declare=declare, declared=recording.declared),
    )
    figures = result(run)
    write_result(directory / RESULT, figures)
    write_folder_report(directory, episode, figures, recording=recording_path, tolerance_ns=tolerance_ns)
    return figures


def _ended(policy: Policy | None, *, interrupted: bool) -> str | None:
    """Return why a policy has ended; for the scene's programme, only that it was interrupted."""
    if policy is None:
        return INTERRUPTED if interrupted else None
    return policy.ended
