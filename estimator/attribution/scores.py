"""Score statistics of all effects at a fit, with stiffnesses, nuisance parameters and smooth fields marginalised.

With V the marginal information about an effect's parameters, g its score at theta and the prior theta ~ N(0, Theta),

    ln Z = [h^T (V + Theta^-1)^-1 h - theta^T Theta^-1 theta - ln |I + Theta V|] / 2,    h = g - Theta^-1 theta,

is the log evidence of each site over the likelihood at theta. That of the effect's absence is subtracted: 0, as theta
is then 0; or, where the effect is a nuisance parameter too, ln Z of the prior that it has as such. These Bayes factors
are averaged over the sites. An effect whose derivatives at 0 show little of it is also fitted from its initial guesses,
for a few steps.

The errors have their likeliest variances, so that the score of one effect is a lower bound of what a fit gains by it:
without it, all that it would explain counts as errors. The residuals of the tool and of its force are so few that this
bound is low. Their variances are the assumed ones where the likeliest are larger.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from ..belief.gaussian_information import GaussianInformation
from ..effects.effect import Effect
from .every_frame import directions, linearised, misfit_under
from .gauss_newton import (
    Fitted,
    evaluated,
    fit_at,
    gauss_newton,
    linearise_at,
    moved,
    promised_log_posterior,
)
from .normal_equations import reduced, without_stiffnesses
from .problem import Point

INITIAL_GUESS_STEPS = 2
"""Gauss-Newton steps of a fit from an initial guess of an effect."""
MIN_SCORE = 2.0
"""Log Bayes factor of one step from which an effect is fitted [nat]. It is a lower bound of what a fit gains: the least
of an effect that is named was 3.0."""
MAX_START_MISFIT = 4.0
"""Largest misfit at an initial guess with which the fit is tried [misfits without the effect]."""
SINGULAR = 1e-9
"""Share of the trace that is added to an information matrix before it is inverted: some directions have none."""
MIN_TRACE = 1e-30
"""Trace that a smaller one is taken as, so that an effect without any information has a finite inverse."""


@dataclass(frozen=True, kw_only=True)
class Score:
    """Score of one effect."""

    name: str
    """Name of the effect."""
    log_bayes_factor: float
    """Log Bayes factor against its absence, linearised at 0; or from an initial guess, if that is larger [nat]."""
    site: int
    """Likeliest site."""
    theta: Float[np.ndarray, " p"]
    """Change of its parameters at that site in a linear step."""
    p_value: float
    """P-value of the score statistic if the effect is absent, for the best of all sites; of the likelihood ratio for a
    fit from an initial guess."""
    began: Point | None = None
    """Start of a fit with the effect; None for the linear step."""
    kept: float
    """Share of the information about it that is left after marginalising, at 0, in the worst direction."""


def scores(fitted: Fitted) -> list[Score]:
    """Return the scores of all effects that are not in the fit, the likeliest first."""
    fitted = _with_usual_tool(fitted)
    problem, n = fitted.problem, len(fitted.site_precision)
    along = directions(problem, np.arange(problem.sheet.size))
    equations = linearised(problem, fitted.point, fitted.weights, fitted.residuals, along)
    square = reduced(problem, equations, problem.sheet.size)
    left, whole = without_stiffnesses(square, fitted.site_precision), square[n:, n:]
    found = [
        _over_sites([_score(fitted, effect, site, left, whole) for site in range(effect.sites)])
        for effect in problem.sheet.library
        if not np.isin(problem.sheet.place(effect.name), fitted.named).any()
    ]
    return sorted((_from_initial_guesses(fitted, one) for one in found), key=lambda one: -one.log_bayes_factor)


def _with_usual_tool(fitted: Fitted) -> Fitted:
    """Return a fit with variances of the residuals of the tool and of its force that are not larger than assumed."""
    last = fitted.problem.scales
    scales = replace(last, tool=min(last.tool, 1.0), pull=None if last.pull is None else min(last.pull, 1.0))
    if scales == last:
        return fitted
    problem = fitted.problem.with_scales(scales)
    at = evaluated(problem, fitted.point, fitted.weights, fitted.residuals)
    return fit_at(at, fitted.named, fitted.equations)


def parameters_sd(fitted: Fitted) -> Float[np.ndarray, " named"]:
    """Return the standard deviations of the effects' parameters in a fit, with everything else marginalised."""
    if not len(fitted.named):
        return np.zeros(0)
    d, sd = len(fitted.named), fitted.problem.sd(fitted.named)
    free = without_stiffnesses(fitted.square, fitted.site_precision).named(named=d, nuisance=len(sd) - d)
    V = free.with_independent("nuisance", sd[d:] ** -2).marginal("named").precision
    scaled = GaussianInformation(precision=V * np.outer(sd[:d], sd[:d]) + np.eye(d), shift=np.zeros(d))
    return sd[:d] * np.sqrt(np.asarray(scaled.variances()))


def _score(
    fitted: Fitted, effect: Effect, site: int, left: GaussianInformation, whole: Float[np.ndarray, "p p"]
) -> Score:
    """Return the score at one site, from the information with s marginalised, and the products of all columns."""
    problem = fitted.problem
    mine = problem.sheet.place(effect.name, site)
    others, at = ~np.isin(fitted.free, mine), fitted.point.theta[mine]
    rest, sd_rest = fitted.free[others], problem.sd(fitted.named)[others]
    joint = left.restricted(effect=mine, nuisance=rest)
    joint = joint.with_independent("nuisance", sd_rest**-2, -fitted.point.theta[rest] / sd_rest**2)
    own, sd, eye = joint.marginal("effect"), problem.prior_sd[mine], np.eye(len(mine))
    unit, scaled = own.precision * np.outer(sd, sd), own.shift * sd
    lower = problem.lower_bounds(mine)[0]
    step, evidence = step_and_evidence(own, at, sd, lower)
    absent = np.zeros(len(mine))
    if (nuisance := np.isin(problem.own, mine)).any():
        absent = problem.own_sd[nuisance]
        evidence -= step_and_evidence(own, at, absent, lower)[1]
    regularisation = SINGULAR * max(float(np.trace(unit)), MIN_TRACE)
    covariance = np.linalg.inv(unit + regularisation * eye)
    best = at / sd + covariance @ scaled
    statistic = float(best @ np.linalg.solve(covariance + np.diag((absent / sd) ** 2), best))
    raw = whole[np.ix_(mine, mine)] * np.outer(sd, sd)
    kept = np.linalg.eigvals(np.linalg.solve(raw + SINGULAR * max(np.trace(raw), MIN_TRACE) * eye, unit)).real.min()
    return Score(
        name=effect.name,
        log_bayes_factor=evidence,
        site=site,
        theta=step,
        p_value=float(chi2.sf(statistic, len(mine))),
        kept=float(np.clip(kept, 0, 1)),
    )


def step_and_evidence(
    own: GaussianInformation, at: Float[np.ndarray, " p"], sd: Float[np.ndarray, " p"], lower: float
) -> tuple[Float[np.ndarray, " p"], float]:
    """Return the linear step of parameters from `at` under a prior, and its log evidence over the likelihood there.

    Where the first one would be below its lower bound, there is no step.
    """
    unit = own.precision * np.outer(sd, sd) + np.eye(len(sd))
    posterior = GaussianInformation(precision=unit, shift=own.shift * sd - at / sd)
    step = posterior.mean()
    if at[0] + sd[0] * step[0] < lower:
        step = np.zeros(len(sd))
    evidence = 0.5 * posterior.shift @ step - 0.5 * np.sum((at / sd) ** 2) - 0.5 * posterior.log_det()
    return sd * step, float(evidence)


def _from_initial_guesses(fitted: Fitted, score: Score) -> Score:
    """Return an effect's score, or that of a few steps from its best initial guess, if that is larger.

    The steps are taken only where the normal equations there promise more than the score, and enough to fit the effect.
    """
    problem = fitted.problem
    effect = problem.sheet.effect(score.name)
    if not effect.initial_guesses:
        return score
    at = problem.sheet.place(effect.name, score.site)
    starts = [moved(fitted, at, np.array(guess)) for guess in effect.initial_guesses]
    misfits = [misfit_under(problem, fitted.weights, point) for point in starts]
    if min(misfits) > MAX_START_MISFIT * fitted.square[-1, -1]:
        return score
    begun = linearise_at(problem, np.append(fitted.named, at), starts[int(np.argmin(misfits))], list(fitted.equations))
    if not promised_log_posterior(begun) - fitted.log_posterior > max(MIN_SCORE, score.log_bayes_factor):
        return score
    found = gauss_newton(begun, passes=INITIAL_GUESS_STEPS)
    likelier = (fitted.cost - found.cost) / 2
    sd = parameters_sd(found)[-len(at) :] / problem.prior_sd[at]
    gain = likelier + float(np.sum(np.log(sd)))
    if not gain > score.log_bayes_factor:
        return score
    return replace(
        score,
        log_bayes_factor=gain,
        theta=found.point.theta[at],
        p_value=float(chi2.sf(2 * max(likelier, 0.0), len(at))),
        began=found.point,
    )


def _over_sites(sites: list[Score]) -> Score:
    """Return the score of the best site, with the mean Bayes factor and the p-value of all sites."""
    evidence = np.array([one.log_bayes_factor for one in sites])
    best = sites[int(np.argmax(evidence))]
    mean = best.log_bayes_factor + float(np.log(np.mean(np.exp(evidence - evidence.max()))))
    any_of = min(1.0, best.p_value * len(sites))
    return replace(best, log_bayes_factor=mean, p_value=any_of)
