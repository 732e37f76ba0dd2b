"""`run`, `estimate`, `identify`, `close-loop` and `score`: what looks for attachments, and for what the model lacks."""

import json
from dataclasses import asdict
from pathlib import Path

from rich.table import Table

from ..options import FilterName, PolicyName, Sensing
from .options import AsJson, Disturb, Name, Out, PathArgument
from .terminal import console, patient, progress, show, stop


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
    overwrite: bool = False,
    as_json: AsJson = False,
) -> None:
    """The main job: reference tissue, stereo, estimate, score, report.

    Args:
        scene: a shipped scene (arc, line, ...) or the path of a scene file.
        out: folder for run.mcap, run.truth.mcap, estimate.mcap, result.json and report.html.
        sensing: what the estimator sees: images; noisy tracked points of the tissue; noisy vertices of the reference; a
            noisy cloud of other points in each frame.
        policy: who chooses the pulls, if not whom the scene names: corners is its programme; information is ours,
            one-grasp is ours without letting go; detach cuts what it finds, suture sews; sl-d, lg-d, lg-h and pmp-WAY
            are the paper's, which move one grasp.
        steps: how many actions a policy may take: 40 if left out, 400 of detach and suture.
        estimator: implicit is ours; explicit is the paper's filter, adam its baseline; nnls and unscented are others'.
        seed: of the sensing noise.
        disturb: something that nobody tells the estimator of, such as gravity=0.5; any number of times. The names are
            in docs/DISTURBANCES.md.
        overwrite: replace results that are already in the folder, from the moment that the run begins.
        as_json: print result.json to stdout.
    """
    from jiggle_mj.estimator import EstimatorConfig
    from jiggle_mj.eval.runs.acting import most_actions
    from jiggle_mj.eval.runs.experiment import run_scene
    from jiggle_mj.scenes import disturbed, load_scene

    loaded, config = disturbed(load_scene(scene), disturb), EstimatorConfig(filter=estimator)
    with patient() as stopped, progress(most_actions(loaded, policy, steps), f"run {loaded.name}") as on_frame:
        figures = run_scene(
            loaded,
            out,
            seed=seed,
            sensing=sensing,
            policy=policy,
            steps=steps,
            config=config,
            overwrite=overwrite,
            on_frame=on_frame,
            stop=stopped,
        )
    show(figures, out, as_json)
    if stopped():
        stop(f"interrupted; what was seen until then is in {out}", 130)


def estimate(
    recording: PathArgument,
    /,
    *,
    out: Out,
    estimator: FilterName = "implicit",
    allow_truncated: bool = False,
    overwrite: bool = False,
    as_json: AsJson = False,
) -> None:
    """Estimate from a recording, which holds observations only.

    Args:
        recording: an MCAP file.
        out: folder for estimate.mcap, result.json and report.html.
        estimator: implicit is ours; explicit is the paper's filter, adam its baseline; nnls and unscented are others'.
        allow_truncated: use what is whole of a recording that was cut off.
        overwrite: replace results that are already in the folder.
        as_json: print result.json to stdout.
    """
    from jiggle_mj.estimator import EstimatorConfig
    from jiggle_mj.eval.runs.experiment import run_estimator

    from ..recording.reader import Recording

    length = len(Recording.open(recording, allow_truncated=allow_truncated))
    with progress(length, f"estimate {recording.name}") as on_frame:
        figures = run_estimator(
            recording,
            out,
            config=EstimatorConfig(filter=estimator),
            overwrite=overwrite,
            allow_truncated=allow_truncated,
            on_frame=on_frame,
        )
    show(figures, out, as_json)


def identify(recording: PathArgument, /, *, allow_truncated: bool = False, as_json: AsJson = False) -> None:
    """Weight and bending stiffness of the sheet over its membrane stiffness, from a recording.

    Args:
        recording: an MCAP file.
        allow_truncated: use what is whole of a recording that was cut off.
        as_json: print what was found to stdout.
    """
    from jiggle_mj.estimator import Estimator

    from .. import episode
    from ..recording.reader import Recording

    source = Recording.open(recording, allow_truncated=allow_truncated)
    estimator = Estimator(source.declaration, source.camera)
    with progress(len(source), f"estimate {recording.name}") as on_frame:
        episode.estimate(source, estimator, on_frame=on_frame)
    with console.status("weight and bending") as status:
        material = estimator.identify(
            on_pass=lambda factors: status.update(", ".join(f"{name} x {x:.3g}" for name, x in factors.items()))
        )
    table = Table("over the membrane stiffness", "unit", "declared", "found", "standard error", box=None)
    for name, ratio in material.ratios.items():
        known = ratio.refused is None
        found = (f"{ratio.declared * ratio.factor:.3g}", f"{100 * ratio.log_sd:.1f} %") if known else ("-", "-")
        table.add_row(name, ratio.unit, f"{ratio.declared:.3g}", *found)
    console.print(table)
    for name, why in material.refused.items():
        console.print(f"{name}: not identified; {why}.", highlight=False)
    found = material.declaration
    console.print(
        f"If the sheet weighs the declared {found.areal_density:g} kg/m^2: membrane_stiffness = "
        f"{found.membrane_stiffness:.3g} N/m, and thickness = {found.thickness:.3g} m for its bending.",
        highlight=False,
    )
    if as_json:
        ratios = {name: asdict(ratio) for name, ratio in material.ratios.items()}
        declared = {name: getattr(found, name) for name in ("membrane_stiffness", "thickness", "areal_density")}
        print(json.dumps({"ratios": ratios, "refused": material.refused, "declaration": declared}))


def close_loop(
    recording: PathArgument,
    /,
    *,
    out: Out,
    truth: Path | None = None,
    suggest: bool = False,
    allow_truncated: bool = False,
    overwrite: bool = False,
    as_json: AsJson = False,
) -> None:
    """What the model lacks of a recording: the residual, the effect behind it, and the error before and after.

    Args:
        recording: an MCAP file.
        out: folder for discrepancy.json and discrepancy.html.
        truth: a truth file, to score what is found attached before and after; opened when all is decided.
        suggest: where several effects explain the frames, look for the next pull that tells them apart.
        allow_truncated: use what is whole of a recording that was cut off.
        overwrite: replace results that are already in the folder.
        as_json: print discrepancy.json to stdout.
    """
    from jiggle_mj.eval.report.discrepancy_page import story
    from jiggle_mj.eval.runs.closing_the_loop import PAGE
    from jiggle_mj.eval.runs.closing_the_loop import close_loop as close

    from ..recording.reader import Recording

    length = len(Recording.open(recording, allow_truncated=allow_truncated))
    with progress(length, f"follow {recording.name}") as on_frame:
        found = close(
            recording,
            out,
            truth=truth,
            suggestion=suggest,
            allow_truncated=allow_truncated,
            overwrite=overwrite,
            on_frame=on_frame,
            log=lambda text: console.print(text, highlight=False, markup=False),
        )
    console.print(found["verdict"], style="bold")
    for sentence in story(found):
        console.print(sentence, highlight=False, markup=False)
    console.print(f"report: {out / PAGE}")
    if as_json:
        print(json.dumps(found))


def score(directory: PathArgument, /, *, truth: Path, recording: Path | None = None, as_json: AsJson = False) -> None:
    """Score an estimate against a truth file, and write the truth into its report.

    Args:
        directory: a folder that `run` or `estimate` filled.
        truth: the truth file, for example run.truth.mcap.
        recording: what was estimated, for the report's pictures; if left out, it is looked for beside the truth and in
            the folder.
        as_json: print result.json to stdout.
    """
    from jiggle_mj.eval.runs.experiment import score_directory

    show(score_directory(directory, truth, recording=recording, log=console.print), directory, as_json)
