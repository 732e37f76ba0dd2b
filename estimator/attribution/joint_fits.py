"""Fits that begin where a closed loop ended: sets of effects that others found, and all but their parameters again."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ..effects import Effect
from .close_loop import filter_states
from .dataset import Dataset
from .evidence import log_model_evidence
from .fit import fit
from .gauss_newton import gauss_newton, linearise_at, moved, start
from .held_out import predict_held_out
from .hypotheses import HOPELESS, Log
from .joint_hypotheses import Effects, Sited
from .kept_fits import KeptFit, KeptLoop, places
from .problem import Problem
from .scores import parameters_sd


@dataclass(frozen=True, kw_only=True)
class FixedFit:
    """A fit with given parameters of the shared effects."""

    shared: Effects
    """The shared effects."""
    own: Effects
    """Effects of this recording alone."""
    theta: Float[np.ndarray, " k"]
    """Parameters of the latter."""
    sd: Float[np.ndarray, " k"]
    """Their standard deviations."""
    rms: float | None
    """Error of the part that chose no effect [m]; None without one."""


def fit_sets(
    dataset: Dataset,
    library: tuple[Effect, ...],
    kept: KeptLoop,
    wanted: Sequence[Effects],
    sizes: Mapping[Sited, Float[np.ndarray, " d"]],
    log: Log,
) -> list[KeptFit]:
    """Return fits of sets of shared effects that a recording lacks, alone and beside its likeliest own effects.

    Args:
        dataset: the recording.
        library: as when the loop was closed.
        kept: the closed loop.
        wanted: the sets.
        sizes: parameters of effects in other recordings, at which a fit may begin.
        log: receives progress messages.
    """
    problem, (used, _) = Problem.build(dataset, library), dataset.parts
    frames = problem.frames(used)
    observed = filter_states(problem, dataset, frames)
    found, known = list[KeptFit](), {one.effects: one for one in kept.fits}
    likeliest = max(kept.fits, key=lambda one: one.recorded.log_posterior(kept.prior))
    for shared in sorted(wanted, key=len):
        for own in dict.fromkeys([(), likeliest.recorded.own]):
            effects = tuple(sorted((*shared, *own)))
            if effects in known:
                continue
            inside = [one for one in known.values() if set(one.effects) <= set(effects)]
            nearest = max(inside, key=lambda one: one.recorded.log_posterior(kept.prior))
            before = nearest.restored(problem, frames)
            named = places(problem, effects)
            new = [one for one in effects if one not in nearest.effects]
            size = np.concatenate([sizes.get(one, np.zeros(len(places(problem, (one,))))) for one in new])
            fits = fit(
                problem,
                named,
                [moved(before.assumed, places(problem, tuple(new)), size), *observed.starts(named)],
                frames,
                before=before,
                worth=before.likeliest.log_posterior - HOPELESS,
            )
            log_evidence = log_model_evidence(fits.likeliest)
            log(f"{title(effects)}: ln Z {log_evidence:.1f}")
            if np.isfinite(log_evidence):
                known[effects] = KeptFit.of(effects, fits, log_evidence)
                found.append(known[effects])
    return found


def with_fixed(
    dataset: Dataset, library: tuple[Effect, ...], one: KeptFit, theta: Float[np.ndarray, " d"], log: Log
) -> FixedFit:
    """Return a fit with other parameters of the shared effects, at which all else is fitted again.

    Args:
        dataset: the recording.
        library: as when the loop was closed.
        one: the fit of its own parameters, from which this one begins.
        theta: parameters of the shared effects, one effect after the other.
        log: receives progress messages.
    """
    problem, (used, spare) = Problem.build(dataset, library), dataset.parts
    shared, own = places(problem, one.recorded.shared), places(problem, one.recorded.own)
    nuisance = ~np.isin(problem.own, shared)
    problem = replace(problem, own=problem.own[nuisance], own_sd=problem.own_sd[nuisance])
    problem = problem.with_scales(one.likeliest.scales)
    at, frames = one.likeliest.theta.copy(), problem.frames(used)
    at[shared] = theta
    begun = start(problem, at, one.likeliest.s, one.likeliest.states, frames)
    fitted = gauss_newton(linearise_at(problem, own, begun, frames))
    rms = None if spare is None else predict_held_out(fitted, spare).rms
    error = "" if rms is None else f": {1e3 * rms:.2f} mm on the part that chose no effect"
    log(f"{title(one.effects)} with the size in all recordings{error}")
    return FixedFit(
        shared=one.recorded.shared,
        own=one.recorded.own,
        theta=fitted.point.theta[own],
        sd=parameters_sd(fitted),
        rms=rms,
    )


def title(effects: Effects) -> str:
    """Return the names of effects as text."""
    return " and ".join(name for name, _ in effects) or "nothing"
