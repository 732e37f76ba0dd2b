"""What holds for every filter: updates sharpen the belief, repeat to the byte, ignore what was not seen, and leave out
a frame that no state explains."""

import copy
from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.belief.gaussian_belief import GaussianBelief
from jiggle_mj.estimator.filters.adam import RATE, AdamShooting
from jiggle_mj.estimator.filters.evidence import Evidence, Pull
from jiggle_mj.estimator.filters.explicit import MultipleShooting
from jiggle_mj.estimator.filters.filter import Filter, FilterState
from jiggle_mj.estimator.filters.nnls import NonNegativeLeastSquares
from jiggle_mj.estimator.filters.posterior_summary import Update
from jiggle_mj.estimator.filters.unscented import ReducedUnscented
from jiggle_mj.estimator.physics.simulator import simulator
from jiggle_mj.estimator.physics.xpbd import XPBD
from tests.support.small_sheet import DECLARATION, corners, lifts, sheet, sheet_energy, sheet_filter

NOISE = 2e-4
K = DECLARATION.membrane_stiffness
N = sheet().n
KEY = jax.random.key(0)
HIDDEN_ROUNDING = 1e-9
"""Rounding by which numbers of no weight may change sums, relative and absolute."""


def gaussian(*, mean: float = 1e-4) -> dict[str, Any]:
    """Return the prior of the filters over stiffnesses, with a standard deviation of 1 N/m."""
    return {"prior": GaussianBelief.prior(N, mean=mean, sd=1.0), "prior_sd": 1.0}


def implicit() -> Filter:
    return sheet_filter(6e-4)


def explicit() -> Filter:
    return MultipleShooting(**gaussian(), simulator=shooting(), grip_stiffness=3 * K, samples=2)


def adam() -> Filter:
    return AdamShooting(**gaussian(), simulator=shooting(), grip_stiffness=3 * K, samples=2, rate=RATE * K)


@cache
def shooting() -> XPBD:
    return simulator(sheet(), DECLARATION)


@cache
def nnls() -> Filter:
    return NonNegativeLeastSquares.build(sheet_energy(), **gaussian(), force_sd=6e-4)


def unscented() -> Filter:
    return ReducedUnscented.build(sheet(), sheet_energy(), **gaussian(), grip_stiffness=3 * K, force_tolerance=1.5e-4)


FILTERS = (implicit, explicit, adam, nnls, unscented)
MOSTLY_QUICK = (implicit, explicit, nnls, *(pytest.param(one, marks=pytest.mark.slow) for one in (adam, unscented)))


def frame(number: int, hidden: np.ndarray | None = None, lie: float = 0.0) -> Evidence:
    """Return frame `number` of the first lift; hidden particles have no precision, and `lie` [m] is added to them."""
    now, before = lifts()[number], lifts()[number - 1]
    y = now.x + NOISE * np.random.default_rng(number).normal(size=now.x.shape)
    precision = np.broadcast_to(np.eye(3) / NOISE**2, (N, 3, 3)).copy()
    if hidden is not None:
        precision[hidden] = 0
        y[hidden] += lie
    held = jnp.asarray(now.held)
    length = np.linalg.norm(sheet().rest - corners()[0], axis=1)
    pull = Pull(before=jnp.asarray(before.x), tip=jnp.asarray(now.tip), length=jnp.asarray(length))
    return Evidence(y=jnp.asarray(y), precision=jnp.asarray(precision), held=held, force_unknown=held, pull=pull)


def run(filter: Filter, frames: list[Evidence]) -> tuple[FilterState, list[Update]]:
    """Return the state after all frames, and the update of each."""
    state, outcomes = filter.init(KEY), []
    for one in frames:
        start = jnp.where(one.precision[:, :1, 0] > 0, one.y, jnp.asarray(sheet().rest))
        state, out = filter.update(state, one, start)
        outcomes.append(out)
    return state, outcomes


@pytest.mark.bits
@pytest.mark.parametrize("make", MOSTLY_QUICK)
def test_every_filter_sharpens_stays_non_negative_and_repeats_itself(make):
    """Adam gives no uncertainty; the others lower the entropy with every frame."""
    frames = [frame(number) for number in (1, 2, 3)]
    first, second = run(make(), frames)[1], run(make(), frames)[1]
    entropies = [float(make().init(KEY).summary.entropy), *(float(out.entropy) for out in first)]
    if make is adam:
        for out in first:
            summary = (out.sd, out.entropy, out.nis, *out.belief.moments())
            assert all(np.isnan(np.asarray(part)).all() for part in summary)
    else:
        assert (np.diff(entropies) < 0).all()
        assert all(np.asarray(out.sd).max() <= 1 + 1e-9 or make is implicit for out in first)
        assert all(float(out.nis) > 0 for out in first)
    for out, again in zip(first, second, strict=True):
        assert out.x.shape == (N, 3) and out.b.shape == out.sd.shape == (N,)
        assert np.asarray(out.b).min() >= 0 and np.asarray(out.b).max() > 0
        assert np.isnan(np.asarray(out.probability)).all() or make is implicit
        for name in ("x", "b", "sd", "probability", "entropy", "nis"):
            assert np.asarray(getattr(out, name)).tobytes() == np.asarray(getattr(again, name)).tobytes()


@pytest.mark.parametrize("make", MOSTLY_QUICK)
def test_what_was_not_seen_does_not_matter(make):
    hidden = np.zeros(N, bool)
    hidden[[3, 20, 44, 60]] = True
    one, other = (run(make(), [frame(1), frame(2, hidden, lie)])[1][-1] for lie in (0.0, 0.3))
    np.testing.assert_allclose(other.belief.precision, one.belief.precision, rtol=HIDDEN_ROUNDING, atol=HIDDEN_ROUNDING)
    np.testing.assert_allclose(other.b, one.b, atol=HIDDEN_ROUNDING)


@pytest.mark.parametrize("make", FILTERS)
def test_a_frame_without_a_state_is_refused_and_left_out(make):
    """Later frames, and the opening of the jaws, go on as if it had not been there."""
    filter, good, bad = make(), [frame(1), frame(2)], frame(3)
    bad = eqx.tree_at(lambda one: one.y, bad, bad.y * jnp.nan)
    first, _ = run(filter, good[:1])
    without, refused = filter.update(first, bad, bad.y)
    assert not refused.explains_the_frame
    assert without.summary is first.summary
    state, after = filter.update(without, good[1], good[1].y)
    as_if = run(make(), good)[1][-1]
    np.testing.assert_array_equal(after.b, as_if.b)
    _, refined = filter.release(state)
    assert refined is None or refined.is_finite


@pytest.mark.parametrize("make", MOSTLY_QUICK)
def test_a_state_is_a_pytree_and_a_copy_of_it_goes_on_as_the_state_does(make):
    """Byte by byte; and an update leaves the state that it was given as it was."""
    filter = make()
    state, _ = run(filter, [frame(1), frame(2)])
    copied, leaves = copy.deepcopy(state), len(jax.tree.leaves(state))
    outs = [filter.update(one, frame(3), frame(3).y)[1] for one in (state, copied, state)]
    assert len({np.asarray(out.b).tobytes() for out in outs}) == 1
    assert len(jax.tree.leaves(state)) == len(jax.tree.leaves(copied)) == leaves


@pytest.mark.parametrize("make", [explicit, nnls])
def test_only_the_implicit_filter_predicts_pulls(make):
    with pytest.raises(ValueError, match=f"only the filter 'implicit' predicts pulls; this one is '{make.__name__}'"):
        make().by_forces("predicts pulls")
    assert implicit().by_forces("predicts pulls").name == "implicit"


@pytest.mark.parametrize("make", [explicit, adam, unscented])
def test_filters_that_simulate_need_the_step_that_led_to_the_frame(make):
    bare = Evidence(**{name: getattr(frame(1), name) for name in ("y", "precision", "held", "force_unknown")})
    with pytest.raises(ValueError, match=r"needs Evidence\.pull"):
        run(make(), [bare])
