"""Whether a measured force can be that of the tool: its sign, its axes, its unit.

The shape of the sheet predicts the force up to one factor. A sensor that reports the force on the other body, in other
axes or another unit fits the prediction far better once that is undone.
"""

import itertools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

APART = 0.5
"""Root mean square of the difference of measured and predicted force, over the measured one, above which it is doubted
[1], as for the tool's motion: a rotation by 29 degrees gives it."""
EXPLAINED = 0.5
"""Share of that difference which other axes may leave to be named [1]."""
MAX_FACTOR = 20.0
"""Factor between measured and predicted force above which its unit is doubted [1]: a declared stiffness may be off by
ten; mN are off by 1000, and gram-force by 100."""
SIGNIFICANT = 4.0
"""Squared norm above which a difference or a force is no noise [standard deviations of that of noise]."""
FACTOR_ERRORS = 2.0
"""Standard deviations of that factor by which it must be below a limit [1]."""
UNITS = ((1e3, "mN"), (1e2, "cN or gram-force"), (1e-3, "kN"))
"""Factor on a force in N, and the unit that gives it."""
DEAD = "the measured force shows nothing of what the sheet needs, but noise; is the sensor on, and recorded?"
"""Why a force is not used that stays at its offset."""


def doubt(
    predicted: Float[np.ndarray, "t 3"],
    pull: Float[np.ndarray, "t 3"],
    loads: Float[np.ndarray, "t 3"],
    sd: Float[np.ndarray, "t 3"],
    sd_given: Float[np.ndarray, "t 3"],
) -> str | None:
    """Return why measured forces are not those of the tool, with the likely reason; None where they may be.

    Args:
        predicted: force of the tool that sheet and attachments need, up to one factor for all frames [N].
        pull: measured force of the tool on the tissue [N].
        loads: the part of it that lifts the weight and presses on the bed [N].
        sd: standard deviation of the difference of each component [N].
        sd_given: the same with the attachments as they are believed; the sign shows by it, as no attachment pushes.
    """
    if not _is_significant(pull / sd_given):
        factor = _apart(predicted, pull, loads, sd)[1]
        information = max(float(np.sum((predicted / sd) ** 2)), np.finfo(float).tiny)  # about the factor
        dead = factor + FACTOR_ERRORS * information**-0.5 < 1 / MAX_FACTOR
        return DEAD if dead or _is_significant((pull - loads - factor * predicted) / sd) else None
    turned = -np.eye(3)
    apart, factor = _apart(predicted, pull, loads, sd_given)
    if apart > APART and _is_significant((pull - loads - factor * predicted) / sd_given):
        if _apart(predicted, pull @ turned, loads, sd_given)[0] <= EXPLAINED * apart:
            return f"the measured force fits the sheet {_words(turned)}; {_cure(turned)}"
    apart, factor = _apart(predicted, pull, loads, sd)
    if apart <= APART:
        return _wrong_unit(factor) if _is_significant(predicted / sd) else None
    if not _is_significant((pull - loads - factor * predicted) / sd):
        return None
    best, _, axes = min(
        ((*_apart(predicted, pull @ axes.T, loads, sd), axes) for axes in _signed_permutations()),
        key=lambda found: found[0],
    )
    if best <= EXPLAINED * apart:
        return f"the measured force fits the sheet {_words(axes)}; {_cure(axes)}"
    if factor > MAX_FACTOR and doubt(predicted, pull / factor, loads, sd, sd_given) is None:
        return _wrong_unit(factor)  # it fits by its own unit's errors, which are not those of a force so large
    return (
        f"the measured force differs from what the sheet needs by {apart:.0%} of it, whatever its scale and axes; is "
        "it the force on the tool, without the tool's own weight, in the frame 'frame_id'?"
    )


def _apart(
    predicted: Float[np.ndarray, "t 3"],
    pull: Float[np.ndarray, "t 3"],
    loads: Float[np.ndarray, "t 3"],
    sd: Float[np.ndarray, "t 3"],
) -> tuple[float, float]:
    """Return the share of the force that the best positive factor leaves, and that factor [true over declared]."""
    E, L = predicted / sd, (pull - loads) / sd
    factor = max(float(np.sum(E * L) / max(np.sum(E * E), np.finfo(float).tiny)), 0.0)
    measured = max(float(np.sum((pull / sd) ** 2)), 1.0)  # less is noise of one component, or no force at all
    return float(np.sqrt(np.sum((L - factor * E) ** 2) / measured)), factor


def _is_significant(scores: Float[np.ndarray, "t 3"]) -> bool:
    """Whether whitened numbers are larger than noise makes them: their squares have mean 1 and variance 2 then."""
    return float(np.sum(scores**2)) > scores.size + SIGNIFICANT * (2 * scores.size) ** 0.5


def _wrong_unit(factor: float) -> str | None:
    """Return which unit a force has that is this many times as large as the declared sheet needs."""
    factor = max(factor, np.finfo(float).tiny)
    if 1 / MAX_FACTOR <= factor <= MAX_FACTOR:
        return None
    unit = min(UNITS, key=lambda each: abs(np.log(factor / each[0])))[1]
    return (
        f"the measured force is {factor:.3g} times what the declared sheet needs; forces are in N (is it in {unit}?), "
        "and membrane_stiffness in N/m."
    )


def _signed_permutations() -> Iterator[Float[np.ndarray, "3 3"]]:
    """Yield all axes that are those of the world in another order, with other signs."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            axes = np.zeros((3, 3))
            axes[np.arange(3), order] = signs
            yield axes


def _words(axes: Float[np.ndarray, "3 3"]) -> str:
    if np.array_equal(axes, -np.eye(3)):
        return "with the opposite sign"
    parts = [("-" if row.sum() < 0 else "") + "xyz"[int(np.abs(row).argmax())] for row in axes]
    return f"with (x, y, z) = ({', '.join(parts)}) of what is reported"


def _cure(axes: Float[np.ndarray, "3 3"]) -> str:
    if np.array_equal(axes, -np.eye(3)):
        return "give the force of the tissue on the tool, not that of the tool on the tissue."
    return "give it in the axes of the world, or of a frame that /tf joins to the world."
