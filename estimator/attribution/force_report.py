"""Report the measured force of the tool: whether it makes stiffnesses absolute, and how well it is predicted."""

from typing import Any

import numpy as np

from .close_loop import Closed
from .dataset import Dataset
from .gauss_newton import Fitted
from .held_out import rms
from .held_out_force import measured_forces, predicted_forces
from .normal_equations import without_stiffnesses

MAX_LOG_SD = 0.35
"""Standard deviation of the logarithm of the factor on all stiffnesses above which the force does not determine it
[nat]: a factor of two either way, as in an estimate."""
NOT_DETERMINED = "it does not determine the factor on all stiffnesses to a factor of two."
"""Why stiffnesses stay relative where the force is too small, or too noisy."""


def force_report(closed: Closed, dataset: Dataset) -> dict[str, Any] | None:
    """Return the content of `force` in discrepancy.json; None where no force was measured.

    Forces are those on the tool; of the part that chose no effect they are predicted from the tool's reports.
    """
    if dataset.force_doubt is not None:
        return {"used": False, "why_not": dataset.force_doubt}
    if closed.problem.scales.pull is None:
        return None
    last = closed.final.fitted
    own_sd = _log_sd(last)
    frames = [k for k in range(len(dataset.frames)) if closed.problem.with_force([k])]
    before, after = (predicted_forces(one, frames) for one in (closed.declared.fitted, last))
    measured, part = measured_forces(last, frames), dataset.frames[-1].part
    spare = [row for row, k in enumerate(frames) if dataset.frames[k].part == part and k not in last.equations]
    errors = {"measured": measured, "before": measured - before, "after": measured - after}
    return {
        "used": True,
        "why_not": None if own_sd <= MAX_LOG_SD else NOT_DETERMINED,
        "stiffness_factor": float(np.exp(_log_factor(last, ("force_scale",)))),
        "stiffness_factor_log_sd": own_sd,
        "membrane_stiffness_n_per_m": dataset.estimator.declaration.membrane_stiffness
        * float(np.exp(_log_factor(last, ("force_scale", "stretch", "heterogeneity")))),
        "held_out_rms_n": {name: rms(one[spare]) if spare else None for name, one in errors.items()},
        "frames": [
            {
                "index": dataset.frames[k].index,
                "measured_n": measured[row].tolist(),
                "before_n": before[row].tolist(),
                "after_n": after[row].tolist(),
            }
            for row, k in enumerate(frames)
        ],
    }


def _log_factor(fitted: Fitted, names: tuple[str, ...]) -> float:
    """Return the sum of some effects' first parameters, logarithms of factors, with what is declared."""
    sheet, total = fitted.problem.sheet, 0.0
    for name in names:
        if any(effect.name == name for effect in sheet.library):
            declared = np.asarray(sheet.declared.get(name, np.zeros(1)))
            total += float(fitted.point.theta[sheet.place(name)[0]] + declared[0])
    return total


def _log_sd(fitted: Fitted) -> float:
    """Return the sd of the logarithm of the factor on all stiffnesses, with its prior as an effect [nat]."""
    problem = fitted.problem
    at = problem.sheet.place("force_scale")[0]
    own = fitted.free == at
    sd = np.where(own, problem.prior_sd[at], problem.sd(fitted.named))
    left = without_stiffnesses(fitted.square, fitted.site_precision)
    return float(np.asarray(left.with_independent("theta", sd**-2).variances())[own][0] ** 0.5)
