"""The implicit filter finds attachments from soft to welded on its own engine, with uncertainties that hold."""

import copy
from dataclasses import replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.filters.config import FilterConfig
from jiggle_mj.estimator.filters.evidence import Evidence
from jiggle_mj.estimator.filters.implicit import ImplicitFilter, ImplicitState
from jiggle_mj.estimator.filters.posterior_summary import Convergence
from jiggle_mj.eval.metrics.detection_metrics import dilate
from tests.support.small_sheet import (
    STIFFNESS,
    Lift,
    attached,
    follow,
    lifts,
    nees,
    observed,
    sharing,
    sheet,
    sheet_filter,
)

FORCE_SD = 1e-4
"""Standard deviation of the force error [N]; small, as the data come from the filter's own model."""
SOFT_TO_RIGID = (STIFFNESS, pytest.param(10 * STIFFNESS, marks=pytest.mark.slow), np.inf)
"""0.1 and 1 times the membrane stiffness, and a weld [N/m]."""
SEEDS = range(3)


def implicit() -> ImplicitFilter:
    return sheet_filter(FORCE_SD)


def before_any_frame(filter: ImplicitFilter, b: np.ndarray | None = None) -> ImplicitState:
    """Return the state before the first frame, with other stiffnesses to linearise at [N/m]."""
    state = filter.init(jax.random.key(0))
    return state if b is None else replace(state, summary=replace(state.summary, b=jnp.asarray(b)))


def run(frames: tuple[Lift, ...], seed: int):
    """Return the last update over all lifts, and the posterior at the end."""
    _, update, summary = follow(implicit(), frames, [observed(frame, 100 * seed + k) for k, frame in enumerate(frames)])
    return update, summary


@cache
def runs(stiffness: float) -> list[Any]:
    """Return the runs of several seeds: rigid attachments show in some more than in others."""
    return [run(lifts(stiffness), seed) for seed in SEEDS]


@pytest.mark.parametrize("stiffness", SOFT_TO_RIGID)
def test_the_attached_particles_are_found_and_no_others(stiffness):
    """Four corner lifts with 0.1 mm of noise show the rim; particles inside a stiff patch have no load and cannot show.

    Beside a weld hardly anything moves: single neighbours may seem attached, and some of its rim may seem free. So the
    bar is 0.5 of a weld's rim, and 0.9 of a soft one's: 14 of 24 show, and one or two more or less are chance. So is
    the mean of P(attached) there: 0.60 by long chains, 0.58 over six seeds, from 0.50 to 0.74.
    """
    probability, around = np.array([summary.probability for _, summary in runs(stiffness)]), rim()
    found = probability > 0.5
    assert found[:, around].mean() >= (0.9 if stiffness <= STIFFNESS else 0.5)
    assert probability[:, around].mean() > (0.6 if stiffness <= STIFFNESS else 0.5)
    assert not (found & ~dilate(attached(), sheet().faces, 1)).any()
    if stiffness <= STIFFNESS:
        assert ((found != attached()).sum(axis=1) <= 1).all()


def rim() -> np.ndarray:
    """Return the attached particles with a free neighbour."""
    edges, held = sheet().edges, attached()
    mixed = edges[held[edges].sum(axis=1) == 1]
    return held & np.isin(np.arange(sheet().n), mixed)


@pytest.mark.parametrize("stiffness", SOFT_TO_RIGID)
def test_intervals_hold_the_truth(stiffness):
    """The intervals hold 90 % over all particles; most of those of a weld are open-ended."""
    lower, upper = np.moveaxis([summary.belief.interval() for _, summary in runs(stiffness)], 1, 0)
    truth = np.where(attached(), stiffness, 0.0)
    holds = (lower <= truth) & (truth <= upper)
    assert holds.mean() >= 0.9
    assert np.isinf(upper[:, attached()]).mean() > 0.5 or np.isfinite(stiffness)


def test_a_free_sheet_has_no_attachment():
    for seed in range(2):
        _, summary = run(lifts(0.0), seed)
        assert not (np.asarray(summary.probability) > 0.5).any()


def test_errors_are_as_large_as_their_covariance_claims():
    """NEES per degree of freedom of s is about 1 where the truth is no bound of s.

    The bars are wide, as three runs hold few independent errors: those of one run's particles are correlated.
    """
    assert 0.3 < np.mean([nees(summary.belief) for _, summary in runs(STIFFNESS)]) < 2


def test_noise_that_neighbours_share_leaves_errors_as_large_as_claimed():
    """Taken for that of single particles, the same noise makes the belief sure and wrong: a NEES of 10 to 300."""
    found: dict[bool, list[float]] = {True: [], False: []}
    for seed in SEEDS:
        draw, seen = np.random.default_rng(seed), list[Evidence]()
        for k, frame in enumerate(lifts()):
            one = sharing(observed(frame, 100 * seed + k))
            assert one.fields is not None
            seen.append(replace(one, y=one.y + one.seen_fields @ draw.normal(size=(one.fields.shape[1], 3))))
        for counted, errors in found.items():
            evidence = seen if counted else [one.without_fields() for one in seen]
            errors.append(nees(follow(implicit(), lifts(), evidence)[2].belief))
    assert 0.3 < np.mean(found[True]) < 2
    assert all(alone > 5 * counted for counted, alone in zip(found[True], found[False], strict=True))


@pytest.mark.parametrize("stiffness", SOFT_TO_RIGID)
def test_innovations_are_as_large_as_expected(stiffness):
    """The NIS of the last frame is about 1; the bars are wide, as the force error is the same in all frames."""
    assert all(0.5 < float(out.nis) < 1.5 for out, _ in runs(stiffness))


def test_the_state_is_closer_to_the_truth_than_what_was_seen():
    """The sheet's physics filters the noise."""
    frame, filter = lifts()[3], implicit()
    seen = observed(frame, 5)
    _, out = filter.update(before_any_frame(filter, STIFFNESS * attached()), seen, seen.y)
    free = ~frame.held
    rms = [np.sqrt(np.mean((np.asarray(x) - frame.x)[free] ** 2)) for x in (out.x, seen.y)]
    assert rms[0] < 0.8 * rms[1]


def test_a_missing_particle_has_no_influence():
    """Whatever stands in y where the precision is zero, the outcome is the same."""
    frame = lifts()[3]
    unseen = np.zeros(sheet().n, bool)
    unseen[[3, 20, 44, 60]] = True
    seen = observed(frame, 2, unseen)
    other = Evidence(
        y=jnp.where(jnp.asarray(unseen)[:, None], seen.y + 0.3, seen.y),
        precision=seen.precision,
        held=seen.held,
        force_unknown=seen.force_unknown,
    )
    outs = []
    for one in (seen, other):
        filter = implicit()
        outs.append(filter.update(before_any_frame(filter), one, jnp.asarray(frame.x))[1])
    for name in ("x", "b", "nis", "probability"):
        np.testing.assert_array_equal(getattr(outs[0], name), getattr(outs[1], name))


def test_a_release_without_a_frame_since_the_last_changes_nothing():
    frame, filter = lifts()[3], implicit()
    seen = observed(frame, 5)
    state, _ = filter.update(before_any_frame(filter), seen, seen.y)
    state, summary = filter.release(state)
    assert summary is not None
    again, nothing = filter.release(state)
    assert nothing is None and again is state


def test_the_reason_says_whether_the_search_was_cut_off():
    """From what was seen, crumpled by its noise, the search takes several steps; one is not enough."""
    frame, filter = lifts()[3], implicit()
    short = replace(filter.declared_balance, config=FilterConfig(max_state_steps=1, smooth_force=1e9))
    reasons = []
    for one in (filter, replace(filter, declared_balance=short)):
        _, out = one.update(before_any_frame(one), observed(frame, 3), observed(frame, 3).y)
        reasons.append(out.reason)
        assert bool(out.converged) == (out.reason is Convergence.CONVERGED)
    assert reasons == [Convergence.CONVERGED, Convergence.SEARCH_CUT_OFF]


def test_the_state_is_a_pytree_that_an_update_leaves_alone():
    """A copy of a state gives the same bytes as the state, and neither is changed by an update."""
    filter, frames = implicit(), lifts()[2:4]
    first = before_any_frame(filter)
    state, _ = filter.update(first, observed(frames[0], 1), observed(frames[0], 1).y)
    assert first.grasps == () and len(state.grasps) == 1
    copied = copy.deepcopy(state)
    assert jax.tree.structure(copied) == jax.tree.structure(state)
    outs = [filter.update(one, observed(frames[1], 2), observed(frames[1], 2).y)[1] for one in (state, copied, state)]
    assert len({np.asarray(out.b).tobytes() for out in outs}) == 1
    assert len(state.grasps[0].frames) == 1
