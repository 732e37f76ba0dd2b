"""The verbs `run`, `estimate`, `identify`, `close-loop` and `score`: estimation, model errors and scores."""

import itertools
import json
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import OptionError, RecordingError
from ..options import FilterName, PolicyName, Sensing
from .closing_many import close_several
from .material import material_json, show_material
from .options import (
    AS_DECLARED,
    AS_RECORDED,
    AsJson,
    Disturb,
    Name,
    Out,
    Parameters,
    PathArgument,
    PathArguments,
    RecordingOptions,
    RecordingSettings,
    SchedulerUrl,
    Settings,
    in_ns,
)
from .settings import configured, declared
from .survey import doubt
from .terminal import INTERRUPTED, console, deferred_interrupt, log, progress, show, stop
from .workers import workers

if TYPE_CHECKING:
    from jiggle_mj.estimator import Estimator
    from jiggle_mj.estimator.perception import FrameMask, TissueMask

    from ..recording.reader import Recording


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
    settings: Settings = AS_DECLARED,
    overwrite: bool = False,
    as_json: AsJson = False,
) -> None:
    """Simulate a scene, estimate where its tissue is attached, score the estimate and write a report.

    Args:
        scene: name of a shipped scene (arc, line, ...), or path of a scene file.
        out: folder for run.mcap, run.truth.mcap, estimate.mcap, result.json and report.html.
        sensing: what the estimator sees: stereo images; noisy tracked points of the tissue; noisy vertices of the
            reference mesh (particles); a noisy cloud of other points in each frame.
        policy: policy that chooses the pulls; the one that the scene names if left out. corners pulls as the scene's
            programme says; information chooses informative pulls, one-grasp does so without a second grasp; detach
            cuts the attachments that it finds, suture sews; sl-d, lg-d, lg-h and pmp-DIRECTION are the paper's, which
            move one grasp.
        steps: largest number of actions of a policy; 40 if left out, 400 for detach and suture.
        estimator: implicit is ours; explicit is the paper's filter and adam the paper's baseline; nnls and unscented
            are further baselines.
        seed: seed of the sensing noise.
        disturb: a disturbance that the estimator is not told of, such as gravity=0.5; may be repeated.
            docs/DISTURBANCES.md lists the names.
        settings: what is declared to the estimator, and how it is set.
        overwrite: replace the results in the folder; they are removed when the run begins.
        as_json: print result.json to stdout.
    """
    from jiggle_mj.eval.runs.acting import most_actions
    from jiggle_mj.eval.runs.experiment import run_scene
    from jiggle_mj.scenes import disturbed, load_scene

    from ..recording.bag_refusal import refuse_bag

    refuse_bag(Path(scene))
    scene_to_run = disturbed(load_scene(scene), disturb)
    config = configured(settings.config, settings.set, estimator)
    n_actions = most_actions(scene_to_run, policy, steps)
    with deferred_interrupt() as stopped, progress(n_actions, f"run {scene_to_run.name}") as on_frame:
        figures = run_scene(
            scene_to_run,
            out,
            seed=seed,
            sensing=sensing,
            policy=policy,
            steps=steps,
            config=config,
            declare=declared(settings.declare),
            overwrite=overwrite,
            on_frame=on_frame,
            stop=stopped,
        )
    show(figures, out, as_json)
    if stopped():
        stop(f"interrupted; the results until then are in {out}", INTERRUPTED)


def estimate(
    recording: PathArgument,
    /,
    *,
    out: Out,
    estimator: FilterName = "implicit",
    settings: RecordingSettings = AS_RECORDED,
    allow_truncated: bool = False,
    overwrite: bool = False,
    as_json: AsJson = False,
) -> None:
    """Estimate where the tissue is attached from a recording, simulated or real, and write a report.

    Args:
        recording: an MCAP file of observations.
        out: folder for estimate.mcap, result.json and report.html.
        estimator: implicit is ours; explicit is the paper's filter and adam the paper's baseline; nnls and unscented
            are further baselines.
        settings: what is declared of the tissue, how the estimator is set, and which pixels are tissue.
        allow_truncated: use the complete frames of a recording that was cut off.
        overwrite: replace the results in the folder.
        as_json: print result.json to stdout.
    """
    from jiggle_mj.eval.runs.experiment import run_estimator
    from jiggle_mj.eval.runs.mask_files import mask_shown

    from ..recording.reader import Recording

    config, declare = configured(settings.config, settings.set, estimator), declared(settings.declare)
    tolerance_ns = in_ns(settings.pairing_tolerance)
    source = Recording.open(recording, allow_truncated=allow_truncated, tolerance_ns=tolerance_ns)
    mask = _mask(settings, source)
    with mask_shown(out), progress(len(source), f"estimate {recording.name}") as on_frame:
        figures = run_estimator(
            recording,
            out,
            config=config,
            declare=declare,
            mask=mask,
            overwrite=overwrite,
            allow_truncated=allow_truncated,
            allow_implausible=settings.allow_implausible,
            tolerance_ns=tolerance_ns,
            on_frame=on_frame,
            log=doubt,
        )
    show(figures, out, as_json)


def identify(
    source: PathArgument,
    /,
    *,
    parameter: Parameters = (),
    settings: RecordingSettings = AS_RECORDED,
    allow_truncated: bool = False,
    as_json: AsJson = False,
) -> None:
    """Identify the sheet's weight and bending stiffness, relative to its membrane stiffness.

    Args:
        source: an MCAP file of observations; or the output folder of 'run' or 'estimate', whose frames are used again
            without tracking them, with the settings of that estimate.
        parameter: weight or bending; the other stays as declared. Both if left out. May be repeated.
        settings: what is declared of the tissue, how the estimator is set, and which pixels are tissue.
        allow_truncated: use the complete frames of a recording that was cut off.
        as_json: print the ratios, the refusals and the resulting declaration to stdout as JSON.
    """
    from ..material import check_ratios

    check_ratios(parameter)
    passes = itertools.count(1)

    def on_pass(factors: dict[str, float]) -> None:
        console.print(f"pass {next(passes)}: {_factors(factors)}", highlight=False)

    if source.is_dir():
        from jiggle_mj.eval.runs.identifying import identify_folder

        _refuse_for_folder(settings, allow_truncated=allow_truncated)
        declare = declared(settings.declare)
        material = identify_folder(source, parameters=parameter, declare=declare, on_pass=on_pass, log=log)
    else:
        material = _followed(source, settings, allow_truncated=allow_truncated).identify(parameter, on_pass=on_pass)
    show_material(material)
    if as_json:
        print(json.dumps(material_json(material)))


def close_loop(
    recordings: PathArguments,
    /,
    *,
    out: Out,
    jobs: int | None = None,
    executor: SchedulerUrl = None,
    truth: Path | None = None,
    suggest: bool = False,
    joint: bool = False,
    settings: RecordingSettings = AS_RECORDED,
    allow_truncated: bool = False,
    overwrite: bool = False,
    as_json: AsJson = False,
) -> None:
    """Find which physical effect the model lacks for a recording, refit with it, and report the error before and after.

    Of several recordings of one sheet, the effects and the errors are compared.

    Args:
        recordings: MCAP files of observations; truth files beside their recordings are left out.
        out: folder for discrepancy.json, discrepancy.html, corrected.toml and parameters.yaml. Of several recordings,
            a folder of its name holds these of each; complete ones are kept. report.html and results.json compare.
        jobs: number of recordings at a time; the number of usable cores if left out. Like --executor it makes even a
            single recording one of several.
        executor: Dask scheduler whose workers do it instead; all of them share the recordings and the folder.
        truth: a truth file, to score the detected attachments before and after; it is read after the verdict.
        suggest: where several effects explain the frames, search the next pull that discriminates between them.
        joint: fit effects of the tissue to all recordings together as well; joint.json and a corrected_joint.toml in
            each folder say what that gives.
        settings: what is declared of the tissue, how the estimator is set, and which pixels are tissue.
        allow_truncated: use the complete frames of a recording that was cut off.
        overwrite: replace the results in the folder.
        as_json: print discrepancy.json to stdout, or results.json of several recordings.
    """
    from jiggle_mj.eval.report.discrepancy_page import story
    from jiggle_mj.eval.runs.closing_many import without_truth
    from jiggle_mj.eval.runs.closing_the_loop import PAGE
    from jiggle_mj.eval.runs.closing_the_loop import close_loop as close
    from jiggle_mj.eval.runs.mask_files import mask_shown

    from ..recording.reader import Recording

    config, declare = configured(settings.config, settings.set, "implicit"), declared(settings.declare)
    tolerance_ns, given = in_ns(settings.pairing_tolerance), without_truth(recordings)
    if len(given) != 1 or jobs is not None or executor is not None or joint:
        if truth is not None:
            raise OptionError(f"--truth {truth}: it is of one recording; leave it out, or give that recording alone.")
        close_several(
            given,
            out,
            workers(jobs, executor),
            as_json=as_json,
            suggestion=suggest,
            joint=joint,
            config=config,
            declare=declare,
            mask=_named_mask(settings),
            allow_truncated=allow_truncated,
            allow_implausible=settings.allow_implausible,
            tolerance_ns=tolerance_ns,
            overwrite=overwrite,
        )
        return
    (recording,) = given
    source = Recording.open(recording, allow_truncated=allow_truncated, tolerance_ns=tolerance_ns)
    mask = _mask(settings, source)
    with mask_shown(out), progress(len(source), f"follow {recording.name}") as on_frame:
        discrepancy = close(
            recording,
            out,
            truth=truth,
            suggestion=suggest,
            config=config,
            declare=declare,
            mask=mask,
            allow_truncated=allow_truncated,
            allow_implausible=settings.allow_implausible,
            tolerance_ns=tolerance_ns,
            overwrite=overwrite,
            on_frame=on_frame,
            log=lambda text: console.print(text, highlight=False),
        )
    console.print(discrepancy["verdict"], style="bold")
    for sentence in story(discrepancy):
        console.print(sentence, highlight=False)
    console.print(f"report: {out / PAGE}")
    if as_json:
        print(json.dumps(discrepancy))


def score(
    directory: PathArgument,
    /,
    *,
    truth: Path,
    recording: Path | None = None,
    allow_truncated: bool = False,
    as_json: AsJson = False,
) -> None:
    """Score an estimate against the true attachments, and add them to its report.

    Args:
        directory: output folder of `run` or `estimate`.
        truth: the truth file, for example run.truth.mcap.
        recording: the recording that was estimated, for the pictures of the report; if left out, it is searched beside
            the truth and in the folder.
        allow_truncated: use the complete frames of a truth that was cut off.
        as_json: print result.json to stdout.
    """
    from jiggle_mj.eval.runs.scoring import score_directory

    if directory.exists() and not truth.exists():
        raise RecordingError(f"{truth} does not exist; 'import' writes one where recording.toml has a [truth].")
    figures = score_directory(directory, truth, recording=recording, allow_truncated=allow_truncated, log=console.print)
    show(figures, directory, as_json)


def _followed(recording: Path, settings: RecordingOptions, *, allow_truncated: bool) -> "Estimator":
    """Return an estimator that has followed a recording.

    Raises:
        JiggleError: what any of the parts raises.
    """
    from jiggle_mj.estimator import Estimator
    from jiggle_mj.eval.runs.check_before import check_before
    from jiggle_mj.eval.runs.mask_files import mask_shown
    from jiggle_mj.eval.runs.settings_used import with_declared

    from .. import episode
    from ..recording.reader import Recording

    config, declare = configured(settings.config, settings.set, "implicit"), declared(settings.declare)
    tolerance_ns = in_ns(settings.pairing_tolerance)
    source = Recording.open(recording, allow_truncated=allow_truncated, tolerance_ns=tolerance_ns)
    mask = _mask(settings, source)
    check_before(source, recording, declare, allow_implausible=settings.allow_implausible, log=doubt)
    estimator = Estimator(with_declared(source.declaration, declare), source.camera, config=config, mask=mask)
    with mask_shown(Path()), progress(len(source), f"estimate {recording.name}") as on_frame:
        episode.estimate(source, estimator, on_frame=on_frame)
    return estimator


def _refuse_for_folder(settings: RecordingOptions, *, allow_truncated: bool) -> None:
    """Refuse options that say how a recording is followed, where none is.

    Raises:
        OptionError: one is given.
    """
    given = [item.name for item in fields(settings) if getattr(settings, item.name) != getattr(AS_RECORDED, item.name)]
    refused = [name for name in (*given, *(["allow_truncated"] if allow_truncated else [])) if name != "declare"]
    if refused:
        option = refused[0].replace("_", "-")
        raise OptionError(f"--{option}: an estimate is used as it was made; leave it out, or give the recording.")


def _factors(factors: dict[str, float]) -> str:
    return ", ".join(f"{name} x {factor:.3g}" for name, factor in factors.items())


def _mask(settings: RecordingOptions, source: "Recording") -> "TissueMask | FrameMask | None":
    """Return the mask that the options name; None without one.

    Raises:
        OptionError: it cannot be read, or the recording has no images.
    """
    if settings.mask is not None and source.camera is None:
        raise OptionError(f"--mask {settings.mask}: the recording has no images; leave it out.")
    return _named_mask(settings)


def _named_mask(settings: RecordingOptions) -> "TissueMask | FrameMask | None":
    from jiggle_mj.eval.runs.mask_files import mask_named

    return None if settings.mask is None else mask_named(settings.mask)
