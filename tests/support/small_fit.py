"""A small attribution problem and fits of it with given numbers, for tests that need no predictions."""

from dataclasses import replace
from functools import cache

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jiggle_mj.estimator.attribution.gauss_newton import Fitted
from jiggle_mj.estimator.attribution.grasped_frames import ClosedFrame, Timed
from jiggle_mj.estimator.attribution.problem import Point, Problem
from jiggle_mj.estimator.attribution.sheet import PredictedSheet
from jiggle_mj.estimator.belief.gaussian_belief import GaussianBelief
from jiggle_mj.estimator.effects import LIBRARY
from jiggle_mj.estimator.effects.frame_history import FrameHistory
from jiggle_mj.estimator.effects.sheet_model import centred
from jiggle_mj.estimator.filters.posterior_summary import Convergence, PosteriorSummary
from tests.support.small_sheet import sheet, sheet_balance, sheet_prior


@cache
def small_problem() -> Problem:
    """Return the problem of one frame of the small sheet at rest, without nuisance parameters."""
    rest, n = sheet().rest, sheet().n
    frame = ClosedFrame(
        y=jnp.asarray(rest),
        visible=jnp.ones(n, dtype=bool),
        precision=jnp.zeros((n, 3, 3)),
        held=jnp.zeros(n, dtype=bool),
        force_unknown=jnp.zeros(n, dtype=bool),
        rotated=jnp.asarray(rest),
        displacement=jnp.zeros(3),
        by_points=jnp.asarray(False),
        held_sd=jnp.zeros(()),
    )
    reports = ((0.0, np.zeros(3)),)
    timed = Timed(frame=frame, index=0, grasp=1, part=0, time=0.0, closed=0.0, state=rest, reports=reports)
    balance = sheet_balance(1e-4)
    return Problem(
        sheet=PredictedSheet(balance=balance, view=centred(sheet()), library=LIBRARY),
        history=FrameHistory([timed], rest),
        prior=sheet_prior(),
        assumed_noise=np.zeros((n, 0)),
        prior_sd=np.concatenate([np.ravel(effect.prior_sds) for effect in LIBRARY]),
        own=np.zeros(0, dtype=int),
        own_sd=np.zeros(0),
        force_sd=balance.force_sd,
    )


def small_fit(
    *, theta: np.ndarray | None = None, named: np.ndarray | None = None, log_likelihood: float = 0.0
) -> Fitted:
    """Return a fit of given parameters, with one particle and no frames."""
    theta = np.zeros(1) if theta is None else theta
    named = np.arange(len(theta)) if named is None else named
    point = Point(theta=theta, s=np.zeros(1), states=np.zeros((0, 1, 3)), seen=np.zeros((0, 1, 3)))
    nothing, zero = jnp.zeros(1), jnp.zeros(())
    summary = PosteriorSummary(
        belief=GaussianBelief.prior(1, mean=0.0, sd=1.0),
        b=nothing,
        sd=nothing,
        probability=nothing,
        entropy=zero,
        convergence=Convergence.CONVERGED.code,
    )
    return Fitted(
        problem=small_problem(),
        point=point,
        named=named,
        free=named,
        square=np.zeros((len(named) + 2, len(named) + 2)),
        equations={},
        weights={},
        residuals={},
        summary=summary,
        log_likelihood=0.0,
    )


def with_hidden(problem: Problem, hidden: dict[int, list[int]]) -> Problem:
    """Return a problem in which some frames do not observe some particles."""
    timed = list(problem.history.frames)
    for k, particles in hidden.items():
        visible = timed[k].frame.visible.at[jnp.asarray(particles)].set(False)
        timed[k] = replace(timed[k], frame=eqx.tree_at(lambda f: f.visible, timed[k].frame, visible))
    return problem.with_frames(timed)
