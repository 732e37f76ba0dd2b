"""Content of `joint.json`, and the corrected model of each recording with what all of them share."""

import json
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jiggle_mj.estimator.attribution.close_loop import jackknife_sd
from jiggle_mj.estimator.attribution.corrected import CorrectedParameter, corrected_parameter
from jiggle_mj.estimator.attribution.joint_hypotheses import Effects, without_each
from jiggle_mj.estimator.attribution.problem import NUISANCE
from jiggle_mj.estimator.effects import Effect
from jiggle_mj.observation import Declaration
from jiggle_mj.recording.declaration import version_entry
from jiggle_mj.recording.output_files import write_text

from .closing_jointly import JointlyClosed, close_jointly
from .closing_order import ClosingOrder
from .corrected_files import CORRECTED_JOINT, corrected_text

JOINT = "joint.json"
"""Name of the file."""


def joint_result(closed: JointlyClosed) -> dict[str, Any]:
    """Return the result as numbers, strings and lists; lengths in metres, log Bayes factors in nat."""
    taken, decision, library = closed.taken, closed.decision, closed.library
    best = closed.hypotheses[decision.best]
    rivals = [closed.hypotheses[k] for k in decision.rivals] if taken is best else []
    return {
        **version_entry(),
        "verdict": decision.kind if taken is best else "effect-with-remainder" if taken.shared else "unexplained",
        "effects": _shared_effects(closed),
        "ambiguous_with": list(dict.fromkeys(name for one in rivals for name in one.names if name not in taken.names)),
        "posterior": [
            {
                "effects": _sited(one.shared, library),
                "probability": float(decision.probabilities[k]),
                "log_evidence": one.posterior.log_evidence,
                "recordings": {
                    name: {
                        "log_evidence": fit.information.log_evidence,
                        "theta": fit.information.theta.tolist(),
                        "own_effects": _sited(fit.own, library),
                    }
                    for name, fit in one.fits.items()
                },
            }
            for k, one in enumerate(closed.hypotheses)
        ],
        "refused": [{"effects": what, "why": why} for what, why in closed.refused.items()],
        "recordings": [
            {
                "name": name,
                "own_effects": _with_sizes(fixed.own, fixed.theta, own_sd(closed, name), library),
                "before_rms_m": closed.before[name],
                "after_rms_m": fixed.rms,
            }
            for name, fixed in closed.fixed.items()
        ],
    }


def write_jointly(
    directory: Path, orders: Mapping[str, ClosingOrder], executor: Executor, log: Callable[[str], None]
) -> dict[str, Any]:
    """Fit effects of the tissue to several recordings together, and return the content of joint.json, once written.

    Args:
        directory: for joint.json; each corrected_joint.toml goes to the folder of its recording.
        orders: the recordings by name, after the loop was closed over each and its fits were kept.
        executor: works on several recordings at a time.
        log: gets a line for each step.

    Raises:
        OutputError: a file cannot be read or written.
        JiggleError: what `close_jointly` raises.
    """
    before = {name: order.found()["held_out"]["before_rms_m"] for name, order in orders.items()}
    closed = close_jointly(orders, before, executor, log)
    for name, order in orders.items():
        _, declaration = order.opened()
        added = _corrected(closed, name, declaration)
        text = corrected_text(added, declaration, name=name, file=CORRECTED_JOINT)
        write_text(order.folder / CORRECTED_JOINT, text)
    found = joint_result(closed)
    write_text(directory / JOINT, json.dumps(found, indent=1) + "\n")
    return found


def _corrected(closed: JointlyClosed, recording: str, declaration: Declaration) -> dict[str, CorrectedParameter]:
    """Return the shared effects and those of one recording, by the name that a declaration gives them."""
    fixed, library = closed.fixed[recording], closed.library
    effects = (*closed.taken.shared, *fixed.own)
    sizes = _split(effects, np.concatenate([closed.taken.posterior.theta, fixed.theta]), library)
    return dict(
        corrected_parameter(library[name], site, size, declaration)
        for (name, site), size in zip(effects, sizes, strict=True)
    )


def shared_sd(closed: JointlyClosed) -> Float[np.ndarray, " d"]:
    """Return the standard deviations that are reported of the shared parameters.

    As in one recording, it is that of one part alone, since the model errs in part alike in all; or the spread between
    the recordings, if that is larger; with the prior of the nuisance parameter of the same name.
    """
    taken = closed.taken
    parts = sum(kept.n_parts for kept in closed.kept.values())
    without = [posterior.theta for posterior in without_each(taken, closed.prior).values()]
    spread = np.sqrt(len(without)) * jackknife_sd(without, len(taken.posterior.sd))
    return np.hypot(np.maximum(np.sqrt(parts) * taken.posterior.sd, spread), _nuisance_sd(closed, taken.shared))


def own_sd(closed: JointlyClosed, recording: str) -> Float[np.ndarray, " k"]:
    """Return the standard deviations that are reported of the parameters of one recording's own effects."""
    fixed = closed.fixed[recording]
    return np.hypot(np.sqrt(closed.kept[recording].n_parts) * fixed.sd, _nuisance_sd(closed, fixed.own))


def _nuisance_sd(closed: JointlyClosed, effects: Effects) -> Float[np.ndarray, " k"]:
    widths = (len(closed.library[name].prior_sd) for name, _ in effects)
    every = [NUISANCE.get(name, (0.0,) * width) for (name, _), width in zip(effects, widths, strict=True)]
    return np.concatenate([[], *every])


def _shared_effects(closed: JointlyClosed) -> list[dict[str, Any]]:
    """Return what is known of the shared effects."""
    taken = closed.taken
    found = _with_sizes(taken.shared, taken.posterior.theta, shared_sd(closed), closed.library)
    evidences = {one.shared: one.posterior.log_evidence for one in closed.hypotheses}
    shares = list(zip(closed.hypotheses, closed.decision.probabilities.tolist(), strict=True))
    for one, sited in zip(found, taken.shared, strict=True):
        without = evidences.get(tuple(other for other in taken.shared if other != sited))
        one["log_bayes_factor"] = None if without is None else evidences[taken.shared] - without
        one["probability"] = sum(share for other, share in shares if sited in other.shared)
    return found


def _with_sizes(
    effects: Effects, theta: Float[np.ndarray, " k"], sd: Float[np.ndarray, " k"], library: Mapping[str, Effect]
) -> list[dict[str, Any]]:
    """Return effects with their sizes, standard deviations and units."""
    sizes = zip(_sited(effects, library), _split(effects, theta, library), _split(effects, sd, library), strict=True)
    return [
        {**named, "theta": size.tolist(), "sd": spread.tolist(), "units": list(library[named["name"]].units)}
        for named, size, spread in sizes
    ]


def _sited(effects: Effects, library: Mapping[str, Effect]) -> list[dict[str, Any]]:
    """Return effects by name and site; None where there is only one."""
    return [{"name": name, "site": site if library[name].sites > 1 else None} for name, site in effects]


def _split(
    effects: Effects, values: Float[np.ndarray, " k"], library: Mapping[str, Effect]
) -> list[Float[np.ndarray, " _p"]]:
    """Return the values of the parameters of each effect."""
    return np.split(values, np.cumsum([len(library[name].prior_sd) for name, _ in effects])[:-1]) if effects else []
