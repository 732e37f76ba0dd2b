"""Fits of a closed loop as arrays, from which later fits of the same recording begin.

A fit with its linearisation takes hundreds of megabytes. What is kept is its point, from which the linearisation is
computed again, and what it says of the parameters that recordings share.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from .close_loop import Closed
from .fit import Fits
from .gauss_newton import Fitted, linearise_at
from .joint_hypotheses import Effects, EffectsPrior, RecordedFit, Sited
from .noise_scales import NoiseScales
from .own_information import own_information, shared_prior
from .problem import Point, Problem


@dataclass(frozen=True, kw_only=True)
class KeptPoint:
    """Where a fit ended."""

    theta: Float[np.ndarray, " p"]
    """All parameters of the library."""
    s: Float[np.ndarray, " n"]
    """Bounded stiffnesses."""
    states: Float[np.ndarray, "frames n 3"]
    """Predicted states [m]."""
    scales: NoiseScales
    """Sizes of the errors."""

    @classmethod
    def of(cls, fitted: Fitted) -> "KeptPoint":
        """Return the point of a fit."""
        point = fitted.point
        return cls(theta=point.theta, s=point.s, states=point.states, scales=fitted.problem.scales)

    def restored(self, problem: Problem, named: Int[np.ndarray, " k"], frames: list[int]) -> Fitted:
        """Return the fit of named parameters that ended here."""
        point = Point(theta=self.theta, s=self.s, states=self.states, seen=np.full_like(self.states, np.nan))
        return linearise_at(problem.with_scales(self.scales), named, point, frames)


@dataclass(frozen=True, kw_only=True)
class KeptFit:
    """One hypothesis of a recording."""

    effects: Effects
    """Its effects, sorted."""
    assumed: KeptPoint
    """The fit with errors of the assumed size."""
    likeliest: KeptPoint
    """The fit with errors of the likeliest size."""
    recorded: RecordedFit
    """Its evidence, and what it says of shared parameters."""

    @classmethod
    def of(cls, effects: Effects, fits: Fits, log_evidence: float) -> "KeptFit":
        """Return the fits of some effects, of an evidence [nat]."""
        problem, likeliest = fits.likeliest.problem, fits.likeliest
        sensing = {name for name, _ in effects if problem.sheet.effect(name).sensing}
        shared = tuple(sorted(one for one in effects if one[0] not in sensing))
        recorded = RecordedFit(
            shared=shared,
            own=tuple(sorted(one for one in effects if one[0] in sensing)),
            larger_errors=problem.scales.larger,
            information=own_information(likeliest, places(problem, shared), log_evidence),
        )
        ends = {"assumed": KeptPoint.of(fits.assumed), "likeliest": KeptPoint.of(likeliest)}
        return cls(effects=tuple(sorted(effects)), recorded=recorded, **ends)

    def restored(self, problem: Problem, frames: list[int]) -> Fits:
        """Return the fits, linearised again."""
        named = places(problem, self.effects)
        return Fits(*(one.restored(problem, named, frames) for one in (self.assumed, self.likeliest)))


@dataclass(frozen=True, kw_only=True)
class KeptLoop:
    """All hypotheses of a recording."""

    rest: Float[np.ndarray, "n 3"]
    """Rest shape [m]."""
    n_parts: int
    """Number of parts that were fitted to."""
    prior: EffectsPrior
    """Prior of the effects that were looked for."""
    scores: Mapping[Sited, float]
    """Log Bayes factors of one step with each effect of the tissue where nothing is added [nat]: of its best site, if
    the others have none."""
    fits: list[KeptFit]
    """The hypotheses."""

    @classmethod
    def of(cls, closed: Closed) -> "KeptLoop":
        """Return what is kept of a closed loop: hypotheses of finite evidence that were fitted to all frames."""
        problem = closed.problem
        every = [one for one in closed.fitted_to_all if not one.added or np.isfinite(one.log_evidence)]
        effects = [tuple((added.effect.name, added.score.site) for added in one.added) for one in every]
        return cls(
            rest=np.asarray(problem.history.rest),
            n_parts=max(1, len(closed.folds[0])),
            prior=effects_prior(problem),
            scores={
                (one.name, one.site): one.log_bayes_factor + float(np.log(effect.sites))
                for one in closed.declared.scores
                if not (effect := problem.sheet.effect(one.name)).sensing
            },
            fits=[KeptFit.of(names, one.fits, one.log_evidence) for names, one in zip(effects, every, strict=True)],
        )


def places(problem: Problem, effects: Effects) -> Int[np.ndarray, " k"]:
    """Return the indices of the parameters of some effects, one effect after the other."""
    return np.concatenate([[], *(problem.sheet.place(name, site) for name, site in effects)]).astype(int)


def effects_prior(problem: Problem) -> EffectsPrior:
    """Return the prior of the effects of a problem."""
    library = problem.sheet.library
    every = {(one.name, site): problem.sheet.place(one.name, site) for one in library for site in range(one.sites)}
    tissue = {one.name for one in library if not one.sensing}
    return EffectsPrior(
        sites={one.name: one.sites for one in library},
        of_tissue={sited: shared_prior(problem, at) for sited, at in every.items() if sited[0] in tissue},
    )
