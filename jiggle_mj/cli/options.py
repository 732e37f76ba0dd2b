"""Options that several verbs share, as tyro reads them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ..errors import OptionError
from ..recording.pairing import MAX_PAIRING_TOLERANCE_MS

PathArgument = Annotated[Path, tyro.conf.Positional]
PathArguments = Annotated[tuple[Path, ...], tyro.conf.Positional]
Name = Annotated[str, tyro.conf.Positional]
RowsName = Literal["inside", "together", "images", "outside", "nothing", "layouts"]
Out = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
AsJson = Annotated[bool, tyro.conf.arg(name="json")]
SchedulerUrl = Annotated[str | None, tyro.conf.arg(metavar="dask://HOST:PORT")]
Disturb = tyro.conf.UseAppendAction[Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME[=MAGNITUDE]")]]
Parameters = tyro.conf.UseAppendAction[Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME")]]
PAIRING_TOLERANCE_MS = 5.0
"""Largest difference of the stamps of one frame if none is given [ms]; a robot's sensors stamp a few ms apart."""


def in_ns(tolerance_ms: float) -> int:
    """Return a pairing tolerance [ns].

    Raises:
        OptionError: below 0, or above `MAX_PAIRING_TOLERANCE_MS`.
    """
    if not 0 <= tolerance_ms <= MAX_PAIRING_TOLERANCE_MS:
        raise OptionError(
            f"--pairing-tolerance {tolerance_ms:g}: must be from 0 to {MAX_PAIRING_TOLERANCE_MS:g} milliseconds."
        )
    return round(tolerance_ms * 1e6)


@dataclass(frozen=True, kw_only=True)
class SettingOptions:
    """Options on what is assumed of the tissue, and on the estimator's settings."""

    declare: tyro.conf.UseAppendAction[Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE|FILE.toml")]] = ()
    """A property of the tissue that you know, such as membrane_stiffness=20 [N/m], or a file of them, such as the
    corrected.toml of close-loop; over what the recording or scene declares. May be repeated."""
    config: Path | None = None
    """A TOML file with settings of the estimator; its tables are those of EstimatorConfig."""
    set: tyro.conf.UseAppendAction[Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE")]] = ()
    """A setting of the estimator by its dotted name, such as perception.stereo.min_depth=0.05; over the file. May be
    repeated."""


@dataclass(frozen=True, kw_only=True)
class RecordingOptions(SettingOptions):
    """Options on how a recording is taken."""

    mask: Annotated[str | None, tyro.conf.arg(metavar="FILE|DIR|grabcut")] = None
    """Which pixels are tissue; by colour if left out. An image or .npy, white where the sheet is in the left image at
    rest; a .npz or a folder with a mask of every frame; or grabcut, what differs in colour from the image's
    surroundings (docs/USAGE.md)."""
    pairing_tolerance: Annotated[float, tyro.conf.arg(metavar="MS")] = PAIRING_TOLERANCE_MS
    """Largest difference between the stamps of the images of one frame [ms]."""
    allow_implausible: bool = False
    """Go on where the check before an estimate refuses the recording."""


Settings = tyro.conf.OmitArgPrefixes[SettingOptions]
RecordingSettings = tyro.conf.OmitArgPrefixes[RecordingOptions]
AS_DECLARED, AS_RECORDED = SettingOptions(), RecordingOptions()
"""Their defaults: nothing is added or changed."""
