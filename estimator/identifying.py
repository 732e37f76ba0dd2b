"""Identification of the sheet of an estimator, or of an estimate whose frames were kept."""

from collections.abc import Callable, Sequence

import jax
import numpy as np
from jaxtyping import Float

from jiggle_mj.argument_checks import as_array
from jiggle_mj.errors import OptionError
from jiggle_mj.estimate import KeptFrames, Sheet
from jiggle_mj.material import Material, check_ratios, material
from jiggle_mj.observation import Declaration

from .blas import one_thread
from .config import EstimatorConfig
from .filters.implicit import ImplicitFilter
from .filters.kept_frames import resumed
from .identification import identify
from .tracked_sheet import TrackedSheet

OnPass = Callable[[dict[str, float]], None]
"""Function that is called with each ratio's factor after each pass, for progress."""


def identify_tracked(
    tracked: TrackedSheet, declaration: Declaration, parameters: Sequence[str], *, on_pass: OnPass
) -> Material:
    """Return the parameters of a sheet whose filter is released; its state becomes the one that goes with them.

    The surface that is seen is taken to be within the declared thickness: half of it is one standard deviation.

    Raises:
        OptionError: the sheet has no parameter of a name; or effects are declared, with which each frame has its own
            energy.
        ValueError: the filter is not 'implicit'.
        PerceptionError: no finite belief explains the frames with the changed sheet.
    """
    if declaration.effects:
        raise OptionError(f"the sheet cannot be identified with declared effects ({', '.join(declaration.effects)}).")
    found = identify(
        tracked.filter.by_forces("can identify the sheet"),
        tracked.state,
        faces=tracked.sheet.faces,
        height_sd=declaration.thickness / 2,
        parameters=parameters,
        on_pass=on_pass,
    )
    tracked.take(found.state, found.summary)
    return material(declaration, found.factors, found.log_sd, found.trades_with, converged=found.converged)


def identify_kept(
    declaration: Declaration,
    sheet: Sheet,
    frames: KeptFrames,
    *,
    stiffness: Float[np.ndarray, " n"],
    config: EstimatorConfig | None = None,
    parameters: Sequence[str] = (),
    on_pass: OnPass = lambda _: None,
) -> Material:
    """Return the sheet's own parameters from the frames of an estimate, which are not tracked again.

    Args:
        declaration: the tissue as the user declares it.
        sheet: the particles.
        frames: `Estimator.kept_frames`, or of `read_estimate`.
        stiffness: the estimate of each b, where the frames are linearised first [N/m].
        config: the settings of the estimate.
        parameters: as in `Estimator.identify`.
        on_pass: as in `Estimator.identify`.

    Raises:
        ValueError: the settings are of another filter than 'implicit', or the frames are of another sheet.
        OptionError: the sheet has no parameter of a name.
    """
    check_ratios(parameters)
    config, b = config or EstimatorConfig(), as_array(stiffness, "stiffness", (len(sheet.rest),))
    if frames.x.shape[1:] != sheet.rest.shape:
        raise ValueError(f"the frames are of {frames.x.shape[1]} particles, and the sheet of {len(sheet.rest)}.")
    with jax.enable_x64(True), one_thread():
        tracked = TrackedSheet.build(sheet, declaration, config, identified=True)
        if not isinstance(tracked.filter, ImplicitFilter):
            raise ValueError(f"only the filter 'implicit' can identify the sheet; this one is {tracked.filter.name!r}.")
        tracked.state, _ = tracked.filter.release(resumed(tracked.filter, tracked.state.key, frames, b))
        return identify_tracked(tracked, declaration, parameters, on_pass=on_pass)
