"""The estimate in a folder, used again to identify the sheet: its frames are not tracked again."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jiggle_mj.episode import ESTIMATE, RESULT
from jiggle_mj.errors import OptionError, OutputError, RecordingError
from jiggle_mj.estimator import EstimatorConfig
from jiggle_mj.estimator.identifying import OnPass, identify_kept
from jiggle_mj.material import Material
from jiggle_mj.nested_settings import nested, with_settings
from jiggle_mj.observation import Declaration
from jiggle_mj.recording.estimate import EstimateRecording, read_estimate
from jiggle_mj.toml_kinds import table

from ..metrics.result_file import Json, read_result, refuse_other_figures
from .settings_used import with_declared


def identify_folder(
    directory: Path,
    *,
    parameters: Sequence[str] = (),
    declare: Mapping[str, Any] | None = None,
    on_pass: OnPass = lambda _: None,
    log: Callable[[str], None] = lambda _: None,
) -> Material:
    """Identify the sheet of an estimate from what its folder holds, with the settings that it was made with.

    Args:
        directory: output folder of `run` or `estimate`.
        parameters: as in `Estimator.identify`.
        declare: properties of the tissue by name, over those of the estimate; see `Declaration`.
        on_pass: as in `Estimator.identify`.
        log: gets a line on what is used again.

    Raises:
        OutputError: the folder holds no complete estimate, or one whose frames are not kept.
        RecordingError: a file is damaged.
        OptionError: there is no such parameter or property, or the estimate is of another filter than 'implicit'.
    """
    figures, estimated = read_result(directory / RESULT), read_estimate(directory / ESTIMATE)
    refuse_other_figures(figures, estimated, directory)
    declaration, config = _settings(figures, directory / RESULT)
    if config.filter != "implicit":
        raise OptionError(
            f"{directory} is an estimate of the filter {config.filter!r}, and only 'implicit' can identify the sheet; "
            "give the recording instead."
        )
    if estimated.detection is None or estimated.frames is None:
        raise OutputError(f"{directory / ESTIMATE} {_why_no_frames(estimated)}; give the recording instead.")
    frames = estimated.frames
    log(f"{len(frames.grasp)} frames in {frames.grasp[-1] + 1} grasps of {directory} are used again, as tracked there")
    return identify_kept(
        with_declared(declaration, declare),
        estimated.sheet,
        frames,
        stiffness=estimated.detection.stiffness,
        config=config,
        parameters=parameters,
        on_pass=on_pass,
    )


def _why_no_frames(estimated: EstimateRecording) -> str:
    if estimated.detection is None:
        return "ends before its belief"
    return (
        "does not keep its frames (an older version wrote it, or it is of clouds, of tissue that was cut or sewn, with "
        "declared effects, or too large)"
    )


def _settings(figures: Json, path: Path) -> tuple[Declaration, EstimatorConfig]:
    """Return the declaration and the settings that a result says were used.

    Raises:
        RecordingError: they are not those of this version.
    """
    try:
        used = table(figures["settings"])
        declared = {name: table(item)["value"] for name, item in table(used["declaration"]).items()}
        return (
            with_settings(Declaration(), declared, where="declaration"),
            with_settings(EstimatorConfig(), nested(table(used["estimator"])), where="estimator"),
        )
    except (OptionError, KeyError, TypeError) as failure:
        raise RecordingError(
            f"{path} holds settings that this version does not know ({failure}); estimate the recording again."
        ) from failure
