"""Fits effects of the tissue to several recordings of one sheet together, after the loop was closed over each.

1. Sets of effects that one recording was fitted with and another was not are fitted there, if they may be likely.
2. The evidence of all recordings with the same parameters decides (`joint_hypotheses`).
3. Each recording is fitted again with these parameters, and its own effects. A set with which the reported part of any
   recording is predicted worse than with what is declared is not taken.
"""

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from jiggle_mj.estimator.attribution.hypotheses import Log
from jiggle_mj.estimator.attribution.joint_fits import FixedFit, title
from jiggle_mj.estimator.attribution.joint_hypotheses import (
    Effects,
    EffectsPrior,
    JointHypothesis,
    Recordings,
    Sited,
    decide_jointly,
    joint_hypotheses,
    within_reach,
)
from jiggle_mj.estimator.attribution.kept_fits import KeptFit, KeptLoop
from jiggle_mj.estimator.attribution.verdict import EvidenceVerdict
from jiggle_mj.estimator.effects import LIBRARY, Effect
from jiggle_mj.run_each import run_each

from .closing_order import ClosingOrder
from .joint_orders import FitSets, FixSizes, Order, execute
from .kept_files import FITS, read_fits
from .same_sheet import refuse_other_shapes


@dataclass(frozen=True, kw_only=True)
class JointlyClosed:
    """What several recordings say together."""

    library: Mapping[str, Effect]
    """Effects by name."""
    kept: Mapping[str, KeptLoop]
    """The closed loop of each recording by its name."""
    before: Mapping[str, float | None]
    """Error of the reported part of each with what is declared [m]; None without such a part."""
    hypotheses: list[JointHypothesis]
    """The sets of shared effects that all recordings were fitted with, the likeliest first."""
    decision: EvidenceVerdict
    """What their evidences say."""
    taken: JointHypothesis
    """The set that is taken."""
    fixed: Mapping[str, FixedFit]
    """Fit of each recording with its parameters."""
    refused: Mapping[str, str]
    """The reason, by the title of each set that is likelier and not taken."""

    @property
    def prior(self) -> EffectsPrior:
        """Return the prior of the effects."""
        return next(iter(self.kept.values())).prior


def close_jointly(
    orders: Mapping[str, ClosingOrder], before: Mapping[str, float | None], executor: Executor, log: Log
) -> JointlyClosed:
    """Return which effects of the tissue several recordings share.

    Args:
        orders: the recordings by name, after the loop was closed over each and its fits were kept.
        before: error of the reported part of each with what is declared [m]; None without such a part.
        executor: works on several recordings at a time.
        log: gets a line for each step.

    Raises:
        OptionError: the recordings are not of one sheet; see `refuse_other_shapes`.
        OutputError: the fits of a recording cannot be read.
        JiggleError: what following a recording raises.
    """
    kept = {name: read_fits(order.folder / FITS) for name, order in orders.items()}
    refuse_other_shapes({name: one.rest for name, one in kept.items()})
    prior = next(iter(kept.values())).prior
    fits = {name: list(one.fits) for name, one in kept.items()}
    wanted = within_reach(recorded(fits), {name: one.scores for name, one in kept.items()}, prior)
    if lacking := lacking_sets(fits, wanted):
        log(f"fitting {', '.join(map(title, wanted))} to the recordings that lack them: {', '.join(lacking)}")
        sizes = sizes_found(fits)
        tasks = {name: FitSets(order=orders[name], wanted=sets, sizes=sizes) for name, sets in lacking.items()}
        for name, found in _executed(tasks, executor).items():
            fits[name] += found
    hypotheses = joint_hypotheses(recorded(fits), prior)
    decision = decide_jointly(hypotheses, prior)
    candidates = [one for one in hypotheses if set(one.shared) <= set(hypotheses[decision.best].shared)]
    to_fix = {name: _to_fix(candidates, name, fits[name]) for name in orders}
    tasks = {name: FixSizes(order=orders[name], fixed=each) for name, each in to_fix.items() if each}
    if tasks:
        sets = ", ".join(title(one.shared) for one in candidates)
        log(f"fitting {', '.join(tasks)} with sizes that hold for all: {sets}")
    fixed = {name: list[FixedFit]() for name in orders} | _executed(tasks, executor)
    taken, of_each, refused = carried_over_jointly(candidates, fixed, before)
    for what, why in refused.items():
        log(f"{what} is not taken: {why}")
    tested = next(iter(orders.values())).options["library"]
    return JointlyClosed(
        library={effect.name: effect for effect in (*LIBRARY, *tested)},
        kept=kept,
        before=before,
        hypotheses=hypotheses,
        decision=decision,
        taken=taken,
        fixed=of_each,
        refused=refused,
    )


def carried_over_jointly(
    candidates: list[JointHypothesis],
    fixed: Mapping[str, list[FixedFit]],
    before: Mapping[str, float | None],
) -> tuple[JointHypothesis, dict[str, FixedFit], dict[str, str]]:
    """Return the first set with which no recording's reported part is predicted worse, and why those before are not.

    A recording whose own effects make it worse is left without them.

    Args:
        candidates: sets of shared effects, the likeliest first; the empty one is among them.
        fixed: fits of each recording with the parameters of these sets, those with its own effects first.
        before: error of each recording's reported part with what is declared [m]; None without such a part.
    """
    refused = dict[str, str]()
    for one in candidates:
        chosen = dict[str, FixedFit]()
        for name, error in before.items():
            fits = [fit for fit in fixed[name] if fit.shared == one.shared]
            fits += [] if one.shared else [declared_fit(error)]
            no_worse = [fit for fit in fits if error is None or fit.rms is None or not fit.rms > error]
            if not no_worse:
                assert error is not None
                least = min(fit.rms for fit in fits if fit.rms is not None)
                errors = f"{1e3 * least:.4g} mm with it and {1e3 * error:.4g} mm with what is declared"
                refused[title(one.shared)] = f"{name} is predicted to {errors}"
                break
            chosen[name] = no_worse[0]
        if len(chosen) == len(before):
            return one, chosen, refused
    raise ValueError("the empty set is not among the candidates.")


def declared_fit(rms: float | None) -> FixedFit:
    """Return what is declared as a fit, with its error [m]."""
    return FixedFit(shared=(), own=(), theta=np.zeros(0), sd=np.zeros(0), rms=rms)


def recorded(fits: Mapping[str, list[KeptFit]]) -> Recordings:
    """Return what fits say, by recording."""
    return {name: [one.recorded for one in each] for name, each in fits.items()}


def lacking_sets(fits: Mapping[str, list[KeptFit]], wanted: list[Effects]) -> dict[str, list[Effects]]:
    """Return the sets of shared effects that each recording lacks, by its name."""
    found = {
        name: [shared for shared in wanted if all(one.recorded.shared != shared for one in each)]
        for name, each in fits.items()
    }
    return {name: sets for name, sets in found.items() if sets}


def sizes_found(fits: Mapping[str, list[KeptFit]]) -> dict[Sited, Float[np.ndarray, " _d"]]:
    """Return the parameters of each effect of the tissue in the smallest hypothesis that has it."""
    found = dict[Sited, Float[np.ndarray, " _d"]]()
    for one in sorted((one.recorded for each in fits.values() for one in each), key=lambda one: len(one.shared)):
        if len(one.shared) == 1:
            found.setdefault(one.shared[0], one.information.theta)
    return found


def _to_fix(
    candidates: list[JointHypothesis], name: str, fits: list[KeptFit]
) -> list[tuple[KeptFit, Float[np.ndarray, " _d"]]]:
    """Return the fits of a recording to begin from: that of each set, then without its own effects."""
    found = list[tuple[KeptFit, Float[np.ndarray, " _d"]]]()
    for one in candidates:
        likeliest = one.fits[name]
        for own in dict.fromkeys([likeliest.own, ()]):
            having = (fit for fit in fits if (fit.recorded.shared, fit.recorded.own) == (one.shared, own))
            found += [(fit, one.posterior.theta) for fit in having if fit.effects]
    return found


def _executed(tasks: Mapping[str, Order], executor: Executor) -> dict[str, list[Any]]:
    """Return what each order returns, by the recording's name; the first failure is raised."""
    found = dict[str, list[Any]]()
    run_each(
        execute,
        tasks,
        executor,
        on_done=lambda name, why: None,
        fails_alone=lambda failure: False,
        on_result=found.__setitem__,
    )
    return found
