"""What is predicted of a pull: the gain against Monte Carlo, scenarios against the belief, loads by hand."""

import os
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.belief.spike_and_slab import Mixture
from jiggle_mj.estimator.planning.information_policy import underrated
from jiggle_mj.estimator.planning.outcomes import at_once, outcomes
from jiggle_mj.estimator.planning.pull_predictor import CandidatePull, PullPredictor, expected_fall
from tests.support.small_sheet import GRIP_RADIUS, NOISE, attached, corners, sheet, sheet_balance, sheet_prior

POINT_PRECISION = jnp.eye(3) / NOISE**2
KNOWN = 0.09
ALL = jnp.ones(sheet().n, dtype=bool)


@pytest.fixture(scope="module")
def predictor() -> PullPredictor:
    """Half of the sheet was seen: the disc in the middle holds, and what surrounds it is free."""
    belief, near = sheet_prior(), np.linalg.norm(sheet().rest, axis=1) < 20e-3
    precision = jnp.diag(jnp.where(near, 5e-3**-2, 0.0))
    belief = belief.add(precision, precision @ jnp.where(attached(), KNOWN, 0.0))
    swept = eqx.filter_jit(belief.swept)(20)
    return PullPredictor.build(sheet_balance(1e-4), swept, POINT_PRECISION, ALL)


def lift(height: float) -> CandidatePull:
    held = np.linalg.norm(sheet().rest - corners()[0], axis=1) <= GRIP_RADIUS
    rest, held = jnp.asarray(sheet().rest), jnp.asarray(held)
    return CandidatePull(start=rest, held=held, force_unknown=held, to=rest + jnp.array([[0.0, 0.0, height]]))


def test_what_is_asked_about_adds_up_to_all(predictor):
    precision = jnp.eye(sheet().n) / 0.02**2
    near = jnp.asarray(np.linalg.norm(sheet().rest, axis=1) < 10e-3)
    gain = eqx.filter_jit(PullPredictor.gain)
    parts = [gain(eqx.tree_at(lambda one: one.about, predictor, about), precision) for about in (near, ~near)]
    assert min(parts) > 0
    np.testing.assert_allclose(sum(parts), gain(predictor, precision), rtol=1e-12)


def test_the_expected_fall_is_that_of_simulated_measurements():
    """Of ln of the variance left, by drawing s and its measurement 20000 times and taking Bayes's rule on each."""
    weight = np.array([[0.9, 0.2, 0.999], [0.06, 0.5, 5e-4], [0.04, 0.3, 5e-4]])
    mean = np.array([[0.0, 0.0, 0.0], [0.03, 0.1, 0.05], [0.1, 0.4, 0.2]])
    sd = np.array([[3e-4] * 3, [0.01, 0.03, 0.01], [0.03, 0.1, 0.05]])
    noise = np.array([0.01, 0.2, 0.05]) ** 2
    rng, draws = np.random.default_rng(0), 20_000
    part = np.array([[rng.choice(3, p=weight[:, i]) for i in range(3)] for _ in range(draws)])
    s = np.take_along_axis(mean, part, axis=0) + np.take_along_axis(sd, part, axis=0) * rng.normal(size=part.shape)
    read = s + np.sqrt(noise) * rng.normal(size=s.shape)
    total = sd**2 + noise
    log = np.log(weight) - 0.5 * np.log(total) - 0.5 * (read[:, None] - mean) ** 2 / total
    told = np.exp(log - log.max(axis=1, keepdims=True))
    told /= told.sum(axis=1, keepdims=True)
    centre, width = mean + sd**2 / total * (read[:, None] - mean), sd**2 * noise / total
    middle = (told * centre).sum(axis=1)
    left = (told * (width + (centre - middle[:, None]) ** 2)).sum(axis=1)
    average = (weight * mean).sum(axis=0)
    before = (weight * (sd**2 + (mean - average) ** 2)).sum(axis=0)
    drawn = 0.5 * np.log(before) - 0.5 * np.log(left)
    found = expected_fall(
        Mixture(weight=jnp.asarray(weight), mean=jnp.asarray(mean), sd=jnp.asarray(sd)), jnp.asarray(noise)
    )
    np.testing.assert_allclose(found, drawn.mean(axis=0), atol=0.05)


def test_a_look_that_tells_nothing_gains_nothing_and_a_sharper_one_more(predictor):
    n = sheet().n
    gains = [float(predictor.gain(precision * jnp.eye(n))) for precision in (0.0, 1e2, 1e4, 1e6)]
    assert gains[0] == pytest.approx(0, abs=1e-4)
    assert (np.diff(gains) > 0).all()


def test_scenarios_are_the_belief_and_no_stiffer_where_nobody_knows(predictor):
    s = predictor.scenarios(jax.random.key(0), 200, unknown=0.5)
    mixture, inner = predictor.belief.mixture(), attached()
    assert s.shape == (200, sheet().n) and (s >= 0).all()
    np.testing.assert_allclose((s > 0).mean(axis=0), mixture.attached, atol=0.12)
    np.testing.assert_allclose(s[:, inner].mean(axis=0), KNOWN, atol=0.01)
    surely = mixture.attached > 0.5
    assert s[:, ~surely].max() <= float(predictor.belief.bounded(jnp.array([0.5]))[0]) + 1e-12


def test_a_pull_at_what_is_attached_loads_it_more_the_higher_it_goes(predictor):
    s = jnp.where(attached(), KNOWN, 0.0)
    low, high = (eqx.filter_jit(predictor.outcome)(lift(height), s) for height in (6e-3, 18e-3))
    b = 30.0 * KNOWN / (1 - KNOWN)
    away = np.linalg.norm(high.x - sheet().rest, axis=1)[attached()]
    assert high.energy == pytest.approx(0.5 * b * (away**2).sum() / sheet().n)
    assert high.force == pytest.approx(b * away.max())
    assert high.energy > low.energy and high.force > low.force and high.gain > low.gain > 0


@pytest.mark.parametrize(("stretched", "times"), [(1.0, 1.0), (2.0, 4.0), (0.5, 1.0)])
def test_an_energy_that_was_underrated_counts_as_often_as_it_is_seen(predictor, stretched, times):
    """Attachments that are seen twice as far from their anchors as predicted hold four times the energy."""
    s, rest = jnp.where(attached(), KNOWN, 0.0), jnp.asarray(sheet().rest)
    pull = lift(12e-3)
    predicted = eqx.filter_jit(predictor.outcome)(pull, s, informative=False).x
    seen = eqx.tree_at(lambda one: one.start, pull, rest + stretched * (predicted - rest))
    one = jax.tree.map(lambda leaf: leaf[None], seen)
    assert underrated(predictor, one, s[None], least=1e-12) == pytest.approx(times, rel=1e-2)
    assert underrated(predictor, one, s[None], least=1.0) == 1.0


def test_free_tissue_bears_nothing(predictor):
    found = eqx.filter_jit(predictor.outcome)(lift(18e-3), jnp.zeros(sheet().n))
    assert found.energy == 0 and found.force == 0 and found.gain > 0


@pytest.mark.slow
def test_pulls_dealt_out_to_two_devices_have_the_outcomes_of_one():
    """In a process of its own, as JAX has one CPU device unless told otherwise before it starts.

    With no more threads than devices, XLA on a CPU would wait for itself.
    """
    said = subprocess.run(
        [sys.executable, __file__],
        env=os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", "NPROC": "8", "JAX_ENABLE_X64": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert said.stdout.split() == ["2", "devices"]


def _dealt() -> None:
    """Three pulls in three scenarios: nine pairs, which two devices cannot share evenly."""
    belief = sheet_prior()
    predicted = PullPredictor.build(sheet_balance(1e-4), belief, POINT_PRECISION, ALL)
    s = predicted.scenarios(jax.random.key(0), 3, unknown=1.0)
    candidates = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(lift, (0.005, 0.01, 0.015)))
    together, apart = (of(predicted, candidates, s, informative=False) for of in (at_once, outcomes))
    for one, other in zip(jax.tree.leaves(together), jax.tree.leaves(apart), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9)
    print(len(jax.devices()), "devices")


if __name__ == "__main__":
    _dealt()
