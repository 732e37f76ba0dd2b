"""Noise learned from residuals is kept where it is right, and inflated where it is too small."""

from functools import reduce
from operator import add

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.filters.force_balance import ForceBalance
from jiggle_mj.estimator.filters.noise import ForceResiduals, Noise
from jiggle_mj.estimator.filters.posterior_summary import PosteriorSummary
from tests.support.small_sheet import NOISE, attached, follow, lifts, observed, sharing, sheet_balance, sheet_filter

FORCE_SD = 1e-3
DRAWS = 60


@pytest.fixture(scope="module", params=[False, True], ids=["white", "shared"])
def drawn(request: pytest.FixtureRequest) -> list[ForceResiduals]:
    """Return residuals of frames with errors drawn from the model, at a lifted state with s = 0.5 attached."""
    balance, truth = sheet_balance(FORCE_SD), lifts()[3]
    seen, s = observed(truth, 0), jnp.asarray(0.5 * attached())
    seen = sharing(seen) if request.param else seen
    frame = eqx.filter_jit(balance.linearise)(jnp.asarray(truth.x), s, seen)

    @eqx.filter_jit
    def residuals(balance: ForceBalance, draw: jax.Array) -> ForceResiduals:
        own, others = jax.random.normal(draw, (2, *frame.x.shape))
        smooth = jax.random.normal(draw, (6, 3))
        sd = jnp.where(frame.weight > 0, 1 / jnp.sqrt(frame.weight), 0.0)
        seen_sd = 1 / jnp.sqrt(seen.white_precision[:, 0, 0])
        innovation = seen_sd[:, None] * others
        if seen.fields is not None:
            innovation = innovation + seen.seen_fields @ smooth
        y = jnp.where(seen.seen[:, None], frame.x + innovation, 0.0)
        off_balance = eqx.tree_at(lambda one: (one.unbalanced, one.evidence.y), frame, (sd[:, None] * own, y))
        return balance.residuals(off_balance, balance.fit(off_balance))

    return [residuals(balance, key) for key in jax.random.split(jax.random.key(0), DRAWS)]


def test_squares_equal_the_degrees_of_freedom_where_the_noise_is_right(drawn):
    """For forces and positions separately, over single frames and over their sum.

    The bar of the mean is four standard errors. One sum has the scatter of a single frame, and the same bar of 0.3.
    """
    for name in ("force", "position"):
        ratio = [float(jnp.sum(getattr(one, name) ** 2) / getattr(one, f"{name}_degrees")) for one in drawn]
        assert np.mean(ratio) == pytest.approx(1, abs=4 * np.std(ratio) / np.sqrt(DRAWS)), name
        assert np.std(ratio) < 0.3, name
    together = reduce(add, drawn)
    assert float(jnp.sum(together.force**2) / together.force_degrees) == pytest.approx(1, abs=0.3)
    assert Noise().learned(drawn) == Noise()


def test_an_error_that_persists_counts_by_its_sum(drawn):
    """Ten frames with the same error count as one of them, not as ten."""
    persistent = reduce(add, [drawn[0]] * 10)
    single = float(jnp.sum(drawn[0].force ** 2) / drawn[0].force_degrees)
    assert Noise().learned([persistent]).force == pytest.approx(10 * single)


def test_noise_is_never_smaller_than_assumed_and_stays_where_it_is_about_right(drawn):
    tenth = 0.1 * drawn[0].force, 0.1 * drawn[0].position
    small = eqx.tree_at(lambda one: (one.force, one.position), drawn[0], tenth)
    assert Noise().learned([small]) == Noise()
    assert Noise(force=4.0, position=9.0).learned([small]) == Noise()
    assert Noise(force=4.0, position=9.0).learned(drawn) == Noise(force=4.0, position=9.0)


@pytest.fixture(scope="module")
def runs() -> dict[int, tuple[Noise, PosteriorSummary]]:
    return {times: run(times) for times in (1, 4)}


@pytest.mark.parametrize("times", [1, 4])
def test_the_filter_finds_how_noisy_positions_are(runs, times):
    noise, summary = runs[times]
    assert summary.converged
    assert noise.position == pytest.approx(times**2, rel=0.2)


def test_positions_noisier_than_stated_do_not_make_the_filter_report_what_is_not_there(runs):
    """It misses what it can no longer see. Without learning it reports free particles too, and is overconfident."""
    _, learned = runs[4]
    _, assumed = run(4, learns_noise=False)
    wrong = [int((found(one) & ~attached()).sum()) for one in (learned, assumed)]
    assert wrong[0] == 0 < wrong[1]
    assert surprise(learned) < 0.6 * surprise(assumed)


def run(times: float, *, learns_noise: bool = True) -> tuple[Noise, PosteriorSummary]:
    """Return noise and posterior after all lifts, with that many times the stated noise."""
    filter, rng = sheet_filter(1e-4, learns_noise=learns_noise), np.random.default_rng(1)
    noisy = [frame.x + times * NOISE * rng.normal(size=frame.x.shape) for frame in lifts()]
    seen = [
        eqx.tree_at(lambda one: one.y, observed(frame, 0), jnp.asarray(y))
        for frame, y in zip(lifts(), noisy, strict=True)
    ]
    state, _, summary = follow(filter, lifts(), seen)
    return filter.noise(state), summary


def found(summary: PosteriorSummary) -> np.ndarray:
    return np.asarray(summary.probability) > 0.5


def surprise(summary: PosteriorSummary) -> float:
    """Return the mean negative log probability of the truth by P(attached) [nat]."""
    of_truth = np.where(attached(), summary.probability, 1 - np.asarray(summary.probability))
    return float(-np.mean(np.log(of_truth)))


def test_an_error_that_all_grasps_share_counts_by_its_sum_over_all():
    """The same residual in g grasps adds up to |sum|^2 that is g times what the noise of each grasp allows."""
    unit = ForceResiduals(
        force=jnp.zeros((10, 3)),
        force_degrees=jnp.asarray(30.0),
        position=jnp.ones((10, 3)),
        position_degrees=jnp.asarray(30.0),
    )
    opposite = eqx.tree_at(lambda residuals: residuals.position, unit, -unit.position)
    assert Noise.shared([unit] * 4) == Noise(force=1.0, position=4.0)
    assert Noise.shared([unit, opposite]) == Noise()
