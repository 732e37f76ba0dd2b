"""Fit a hypothesis: stiffnesses, the parameters of its effects and the sizes of the errors, in turn.

With errors of the assumed size the fit comes first, because with errors as large as the residual of a wrong start the
frames say little. From there the sizes are estimated too. A fit with one effect more also begins at the likeliest one
without it, and the likelier end counts.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from .gauss_newton import (
    Fitted,
    better_point,
    candidate_steps,
    fit_at,
    gauss_newton,
    linearise_at,
    linearised_fit,
    promised_log_posterior,
    start,
    weigh,
    weighed_with,
)
from .likeliest_scales import likeliest_scales
from .noise_scales import NoiseScales
from .problem import Point, Problem
from .refinement import refined

MAX_SCALES = 2
"""Largest number of times that the sizes of the errors are estimated."""
SETTLED = float(np.log(2.0))
"""Change of the logarithm of the variances of forces and of their fields up to which they have settled [nat]."""


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
    likeliest = _with_scales(assumed, None if before is None else before.likeliest.problem.scales, worth, log)
    if before is not None:
        begun_there = linearised_fit(before.likeliest, named)
        if promised_log_posterior(begun_there) > max(worth, likeliest.log_posterior):
            other = _with_scales(gauss_newton(begun_there, log=log), None, worth, log)
            likeliest = max(likeliest, other, key=lambda one: one.log_posterior)
    likeliest = _refined(likeliest, worth, log)
    return Fits(assumed=assumed, likeliest=likeliest)


def fit_to_more(fits: Fits, frames: list[int]) -> Fits:
    """Return fits to more frames, begun where they ended with errors of the likeliest size."""
    last = fits.likeliest
    begun = start(last.problem, last.point.theta, last.point.s, last.point.states, frames)
    likeliest = _with_scales(
        gauss_newton(linearise_at(last.problem, last.named, begun, frames)), None, -np.inf, lambda _: None
    )
    return fits._replace(likeliest=_refined(likeliest, -np.inf, lambda _: None))


def _refined(now: Fitted, worth: float, log: Callable[[str], None]) -> Fitted:
    """Return a fit with errors of the likeliest size after refining steps, with their size estimated again."""
    if not promised_log_posterior(now) > worth:
        return now
    better = refined(now, log=log)
    return now if better is now else _with_scales(better, None, worth, log)


def _with_scales(now: Fitted, near: NoiseScales | None, worth: float, log: Callable[[str], None]) -> Fitted:
    """Return the fit with errors of the likeliest size, from one with others; their search begins `near` some too."""
    for count in range(MAX_SCALES):
        now, settled = _with_likeliest_scales(now, near if count == 0 else None, log)
        if settled or not promised_log_posterior(now) > worth:
            break
        now = gauss_newton(now, log=log)
    return now


def _with_likeliest_scales(now: Fitted, near: NoiseScales | None, log: Callable[[str], None]) -> tuple[Fitted, bool]:
    """Return a fit's point under its likeliest scales, searched near some, and whether they hardly changed."""
    scales, last = likeliest_scales(now, near=near), now.problem.scales
    log(f"variances {', '.join(f'{value:.3g}' for value in scales.values)} of the assumed ones")
    settled = np.allclose(np.log(scales.values[:2]), np.log(last.values[:2]), rtol=0, atol=SETTLED)
    return linearise_at(now.problem.with_scales(scales), now.named, now.point, list(now.equations)), settled


def without(fitted: Fitted, part: int) -> Fitted:
    """Return one more step from a fit without the frames of one part, from the normal equations that it has.

    The likeliest set of attachments is no candidate: of many equally likely sets, fewer frames would take another one
    at random.
    """
    kept = [k for k in fitted.equations if fitted.problem.history.frames[k].part != part]
    at = weighed_with(fitted.problem, fitted.point, {k: fitted.weights[k] for k in kept})
    now = fit_at(at, fitted.named, {k: fitted.equations[k] for k in kept})
    better = better_point(now, candidate_steps(now, likeliest_set=False))
    return now if better is None else replace(now, point=better.point, log_likelihood=better.log_likelihood)
