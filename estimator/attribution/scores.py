"""Which effects a fit's misfit looks like: score statistics at the fit, with all that may vary anyway marginalised.

With V the information about an effect's parameters that is left when stiffnesses, the sheet's own parameters and smooth
force fields are marginalised, g its score and theta ~ N(0, Theta) before,

    ln BF = g^T (V + Theta^-1)^-1 g / 2 - ln |I + Theta V| / 2

for each place where it may be, and the mean of the BFs over the places. An effect that shows little of itself in its
derivatives at 0 is also tried from its natural size, with a few steps of a fit.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from ..belief.gaussian_information import GaussianInformation
from ..effects.effect import Effect
from .every_frame import cost_under, directions, linearised
from .fit import Fitted, fit, gains_over, moved
from .normal_equations import reduced, without_stiffnesses
from .problem import Point, Problem

STEPS = 2
"""Of a fit from an effect's natural size."""
HOPELESS = 4.0
"""How many times the cost without it may be missed at that size before it is not tried."""


@dataclass(frozen=True, kw_only=True)
class Score:
    """Of one effect."""

    name: str
    log_bayes_factor: float
    """Against its absence, linearly; or from its natural size, where that is more."""
    site: int
    """Where it is likeliest."""
    theta: Float[np.ndarray, " p"]
    """By how much its parameters there would change, in that step."""
    p_value: float
    """Of the score statistic where the effect is absent, for the best of all its places; of the likelihood ratio, where
    it was tried from its natural size."""
    began: Point | None = None
    """Where a fit with it may begin, if not with that step."""
    kept: float
    """Share of the information about it that is left in the worst direction when the rest is marginalised, at 0."""


def scores(problem: Problem, fitted: Fitted) -> list[Score]:
    """Every effect of the library that was not fitted already, the likeliest first."""
    n, every = len(fitted.site_precision), directions(problem, np.arange(problem.sheet.size))
    equations = linearised(problem, fitted.around, fitted.weights, every)
    square = reduced(problem, equations, problem.sheet.size)
    left, whole = without_stiffnesses(square, fitted.site_precision), square[n:, n:]
    found = [
        _best([_one(problem, fitted, effect, site, left, whole) for site in range(effect.sites)])
        for effect in problem.sheet.library
        if not np.isin(problem.sheet.place(effect.name), fitted.named).any()
    ]
    return sorted((_from_initial_guesses(problem, fitted, one) for one in found), key=lambda one: -one.log_bayes_factor)


def occam(problem: Problem, fitted: Fitted) -> tuple[float, Float[np.ndarray, " named"]]:
    """Ln |I + Theta V| / 2 of a fit's named parameters, and their standard deviations."""
    if not len(fitted.named):
        return 0.0, np.zeros(0)
    d, sd = len(fitted.named), problem.sd(fitted.named)
    free = without_stiffnesses(fitted.square, fitted.site_precision).named(named=d, nuisance=len(sd) - d)
    V = free.with_independent("nuisance", sd[d:] ** -2).marginal("named").precision
    scaled = GaussianInformation(precision=V * np.outer(sd[:d], sd[:d]) + np.eye(d), shift=np.zeros(d))
    return 0.5 * float(scaled.log_det()), sd[:d] * np.sqrt(np.asarray(scaled.variances()))


def bayes_factor(problem: Problem, better: Fitted, plain: Fitted, sites: int) -> tuple[float, float]:
    """By how much a fit is likelier than another, and ln BF: less what its effect at one of `sites` costs [nat].

    Of a fit that cannot be weighed both are minus infinity.
    """
    if not np.isfinite(better.cost):
        return -np.inf, -np.inf
    likelier = min(gains_over(problem, better, plain))
    return likelier, float(likelier - (occam(problem, better)[0] - occam(problem, plain)[0]) - np.log(sites))


def _one(
    problem: Problem, fitted: Fitted, effect: Effect, site: int, left: GaussianInformation, whole: np.ndarray
) -> Score:
    """Return the score at one place, from the information with s marginalised, and the products of all columns."""
    mine = problem.sheet.place(effect.name, site)
    others = ~np.isin(fitted.free, mine)
    rest, sd_rest = fitted.free[others], problem.sd(fitted.named)[others]
    joint = left.restricted(effect=mine, nuisance=rest)
    joint = joint.with_independent("nuisance", sd_rest**-2, -fitted.around.theta[rest] / sd_rest**2)
    own, sd, eye = joint.marginal("effect"), problem.prior_sd[mine], np.eye(len(mine))
    unit, scaled = own.precision * np.outer(sd, sd), own.shift * sd
    posterior = GaussianInformation(precision=unit + eye, shift=scaled)
    theta = posterior.mean()
    senseless = effect.non_negative and theta[0] < 0
    evidence = (0.0 if senseless else 0.5 * scaled @ theta) - 0.5 * posterior.log_det()
    faint = 1e-9 * max(float(np.trace(unit)), 1e-30)
    statistic = float(scaled @ np.linalg.solve(unit + faint * eye, scaled))
    raw = whole[np.ix_(mine, mine)] * np.outer(sd, sd)
    kept = np.linalg.eigvals(np.linalg.solve(raw + 1e-9 * max(np.trace(raw), 1e-30) * eye, unit)).real.min()
    return Score(
        name=effect.name,
        log_bayes_factor=float(evidence),
        site=site,
        theta=sd * theta,
        p_value=float(chi2.sf(statistic, len(mine))),
        kept=float(np.clip(kept, 0, 1)),
    )


def _from_initial_guesses(problem: Problem, fitted: Fitted, score: Score) -> Score:
    """An effect's score, or that of a few steps from its natural size, where that is more."""
    effect = problem.sheet.effect(score.name)
    if not effect.initial_guesses:
        return score
    at = problem.sheet.place(effect.name, score.site)
    parts = {problem.history.frames[k].part for k in fitted.equations}
    begun = [moved(problem, fitted, at, np.array(one)) for one in effect.initial_guesses]
    costs = [cost_under(problem, fitted.weights, point) for point in begun]
    if min(costs) > HOPELESS * fitted.cost:
        return score
    best = begun[int(np.argmin(costs))]
    found = fit(problem, np.append(fitted.named, at), best, parts, passes=STEPS)
    likelier, gain = bayes_factor(problem, found, fitted, effect.sites)
    if gain <= score.log_bayes_factor:
        return score
    return replace(
        score,
        log_bayes_factor=gain,
        theta=found.point.theta[at],
        p_value=float(chi2.sf(2 * max(likelier, 0.0), len(at))),
        began=found.point,
    )


def _best(sites: list[Score]) -> Score:
    evidence = np.array([one.log_bayes_factor for one in sites])
    best = sites[int(np.argmax(evidence))]
    mean = best.log_bayes_factor + float(np.log(np.mean(np.exp(evidence - evidence.max()))))
    any_of = min(1.0, best.p_value * len(sites))
    return replace(best, log_bayes_factor=mean, p_value=any_of)
