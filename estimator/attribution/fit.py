"""Fit a hypothesis: stiffnesses, the parameters of its effects and the sizes of the errors, in turn.

With errors of the assumed size the fit comes first, because with errors as large as the residual of a wrong start the
frames say little. From there the sizes are estimated too; or from the likeliest fit without one of the effects, if the
normal equations promise more there.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from .every_frame import following, weighted_together
from .gauss_newton import (
    Fitted,
    better_point,
    candidate_steps,
    evaluated,
    fit_at,
    gauss_newton,
    linearise_at,
    linearised_fit,
    promised_log_posterior,
    start,
    weigh,
)
from .likeliest_scales import with_likeliest_scales
from .problem import Point, Problem
from .refinement import refined


class Fits(NamedTuple):
    """Two fits of one hypothesis."""

    assumed: Fitted
    """With errors of the assumed size; further effects are searched for from it."""
    likeliest: Fitted
    """With errors of the likeliest size."""


def fit(
    problem: Problem,
    named: np.ndarray,
    starts: list[Point],
    frames: list[int],
    *,
    before: Fits | None = None,
    worth: float = -np.inf,
    log: Callable[[str], None] = lambda _: None,
) -> Fits:
    """Return the fits of named parameters, nuisance parameters and all stiffnesses to some frames.

    Args:
        problem: what is fitted to.
        named: parameters of the effects in the model.
        starts: points that the fit may begin at; it begins at the likeliest.
        frames: frames to fit to.
        before: fits without some of the parameters to the same frames, which are starts too.
        worth: log posterior [nat]; a fit that cannot reach it, as far as its normal equations tell, ends early.
        log: receives progress messages.
    """
    problem = problem.with_scales(problem.assumed_scales)
    begun = [weigh(problem, point, frames) for point in starts]
    begun += [] if before is None else [before.assumed]
    likelihoods = np.nan_to_num([one.log_likelihood for one in begun], nan=-np.inf)
    assumed = gauss_newton(linearised_fit(begun[int(np.argmax(likelihoods))], named), log=log)
    likeliest = _with_likeliest_scales(assumed, log)
    if before is not None:
        likeliest = max(likeliest, linearised_fit(before.likeliest, named), key=promised_log_posterior)
    if promised_log_posterior(likeliest) > worth:
        likeliest = _refined(gauss_newton(likeliest, log=log), log)
    return Fits(assumed=assumed, likeliest=likeliest)


def fit_to_more(fits: Fits, frames: list[int], before: Fits | None) -> Fits:
    """Return fits to more frames, with errors of the likeliest size.

    They begin where the fits ended, or at the likeliest fit to all those frames without one of the effects, if the
    normal equations promise more there; with the scales of that fit, or without one with those of the fits.
    """
    last = fits.likeliest
    problem = (before or fits).likeliest.problem
    begun = start(problem, last.point.theta, last.point.s, last.point.states, frames)
    now = linearise_at(problem, last.named, begun, frames)
    if before is not None:
        now = max(now, linearised_fit(before.likeliest, last.named), key=promised_log_posterior)
    return fits._replace(likeliest=_refined(gauss_newton(now)))


def _refined(now: Fitted, log: Callable[[str], None] = lambda _: None) -> Fitted:
    """Return a fit after refining steps, under its likeliest scales."""
    return _with_likeliest_scales(refined(now, log=log), log)


def _with_likeliest_scales(now: Fitted, log: Callable[[str], None] = lambda _: None) -> Fitted:
    """Return a fit's point under its likeliest scales."""
    at = with_likeliest_scales(now)
    log(f"errors: {at.problem.scales}")
    return fit_at(at, now.named, now.equations) if at.weights is now.weights else linearised_fit(at, now.named)


def without(fitted: Fitted, part: int) -> Fitted:
    """Return one more step from a fit without the frames of one part.

    The likeliest set of attachments is no candidate: of many equally likely sets, fewer frames would take another one
    at random.
    """
    now = weighed_without(fitted, part)
    better = better_point(now, candidate_steps(now, likeliest_set=False))
    return now if better is None else replace(now, point=better.point, log_likelihood=better.log_likelihood)


def weighed_without(fitted: Fitted, part: int) -> Fitted:
    """Return a fit's point without the frames of one part, as if they had never been."""
    problem, every = fitted.problem, fitted.weights
    kept = [k for k in every if problem.history.frames[k].part != part]
    follow = [k for k in kept if (problem.last_seen(k, kept) != problem.last_seen(k, every)).any()]
    weights = {k: every[k] if k not in follow else following(problem, every[k], k, kept) for k in kept}
    residuals = weighted_together(problem, weights, {k: fitted.residuals[k].own for k in kept})
    at = evaluated(problem, fitted.point, weights, residuals)
    kept_equations = {k: fitted.equations[k] for k in kept}
    return linearised_fit(at, fitted.named) if follow else fit_at(at, fitted.named, kept_equations)
