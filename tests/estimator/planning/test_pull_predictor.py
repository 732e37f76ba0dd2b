"""Predicted pulls: the gain against Monte Carlo, scenarios against the belief, loads of attachments by hand."""

import os
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.belief.spike_and_slab import Mixture
from jiggle_mj.estimator.filters.evidence import Evidence
from jiggle_mj.estimator.planning.outcomes import outcomes, outcomes_in_batches
from jiggle_mj.estimator.planning.plan_safety import observed_energy_ratio
from jiggle_mj.estimator.planning.pull_predictor import CandidatePull, PullPredictor, expected_fall
from tests.support.small_sheet import GRIP_RADIUS, NOISE, attached, corners, fields, sheet, sheet_balance, sheet_prior

POINT_PRECISION = jnp.eye(3) / NOISE**2
KNOWN = 0.09
"""Bounded stiffness of what is attached."""
ALL = jnp.ones(sheet().n, dtype=bool)
N_DRAWS = 20_000
"""Simulated measurements."""
FALL_ERROR = 0.05
"""Error of a mean over `N_DRAWS`, and of a quadrature over five nodes [nat]."""
N_SCENARIOS = 200
SHARE_ERROR = 0.12
"""Three and a half standard errors of a share near 1/2 in `N_SCENARIOS`."""
ROUNDING = 1e-6
"""Relative difference of a covariance that is inverted twice."""
MEAN_ERROR = 0.01
"""Error of the mean of s in `N_SCENARIOS` of a standard deviation of 0.005, and how far the prior moves it."""


@pytest.fixture(scope="module")
def predictor() -> PullPredictor:
    """Return a predictor after the inner half was observed: the disc in the middle is attached, the ring is free."""
    belief, near = sheet_prior(), np.linalg.norm(sheet().rest, axis=1) < 20e-3
    precision = jnp.diag(jnp.where(near, 5e-3**-2, 0.0))
    belief = belief.add(precision, precision @ jnp.where(attached(), KNOWN, 0.0))
    swept = eqx.filter_jit(belief.swept)(20)
    return PullPredictor.build(sheet_balance(1e-4), swept, POINT_PRECISION, ALL)


def lift(height: float) -> CandidatePull:
    held = np.linalg.norm(sheet().rest - corners()[0], axis=1) <= GRIP_RADIUS
    rest, held = jnp.asarray(sheet().rest), jnp.asarray(held)
    return CandidatePull(start=rest, held=held, force_unknown=held, to=rest + jnp.array([[0.0, 0.0, height]]))


def test_gains_about_two_halves_add_up_to_the_gain_about_all(predictor):
    precision = jnp.eye(sheet().n) / 0.02**2
    near = jnp.asarray(np.linalg.norm(sheet().rest, axis=1) < 10e-3)
    gain = eqx.filter_jit(PullPredictor.gain)
    parts = [gain(eqx.tree_at(lambda p: p.about, predictor, about), precision) for about in (near, ~near)]
    assert min(parts) > 0
    np.testing.assert_allclose(sum(parts), gain(predictor, precision), rtol=1e-12)  # two sums of the same terms


def test_the_expected_fall_is_that_of_simulated_measurements():
    """The mean fall of 1/2 ln of the posterior variance, by drawing s and its measurement, and Bayes's rule on each."""
    weight = np.array([[0.9, 0.2, 0.999], [0.06, 0.5, 5e-4], [0.04, 0.3, 5e-4]])
    mean = np.array([[0.0, 0.0, 0.0], [0.03, 0.1, 0.05], [0.1, 0.4, 0.2]])
    sd = np.array([[3e-4] * 3, [0.01, 0.03, 0.01], [0.03, 0.1, 0.05]])
    noise = np.array([0.01, 0.2, 0.05]) ** 2
    rng = np.random.default_rng(0)
    part = np.array([[rng.choice(3, p=weight[:, i]) for i in range(3)] for _ in range(N_DRAWS)])
    s = np.take_along_axis(mean, part, axis=0) + np.take_along_axis(sd, part, axis=0) * rng.normal(size=part.shape)
    measured = s + np.sqrt(noise) * rng.normal(size=s.shape)
    total = sd**2 + noise
    log = np.log(weight) - 0.5 * np.log(total) - 0.5 * (measured[:, None] - mean) ** 2 / total
    posterior = np.exp(log - log.max(axis=1, keepdims=True))
    posterior /= posterior.sum(axis=1, keepdims=True)
    centre, variance = mean + sd**2 / total * (measured[:, None] - mean), sd**2 * noise / total
    middle = (posterior * centre).sum(axis=1)
    after = (posterior * (variance + (centre - middle[:, None]) ** 2)).sum(axis=1)
    average = (weight * mean).sum(axis=0)
    before = (weight * (sd**2 + (mean - average) ** 2)).sum(axis=0)
    drawn = 0.5 * np.log(before) - 0.5 * np.log(after)
    found = expected_fall(
        Mixture(weight=jnp.asarray(weight), mean=jnp.asarray(mean), sd=jnp.asarray(sd)), jnp.asarray(noise)
    )
    np.testing.assert_allclose(found, drawn.mean(axis=0), atol=FALL_ERROR)


def test_an_observation_without_information_gains_nothing_and_a_more_precise_one_more(predictor):
    """Without information the predictor takes a precision of 1e-6, and a quadrature, for each particle."""
    n = sheet().n
    gains = [float(predictor.gain(precision * jnp.eye(n))) for precision in (0.0, 1e2, 1e4, 1e6)]
    assert gains[0] == pytest.approx(0, abs=1e-4)
    assert (np.diff(gains) > 0).all()


def test_scenarios_follow_the_belief_and_unknown_attachments_are_no_stiffer_than_allowed(predictor):
    s = predictor.scenarios(jax.random.key(0), N_SCENARIOS, unknown=0.5)
    mixture, inner = predictor.belief.mixture(), attached()
    assert s.shape == (N_SCENARIOS, sheet().n) and (s >= 0).all()
    np.testing.assert_allclose((s > 0).mean(axis=0), mixture.attached, atol=SHARE_ERROR)
    np.testing.assert_allclose(s[:, inner].mean(axis=0), KNOWN, atol=MEAN_ERROR)
    surely = mixture.attached > 0.5
    assert s[:, ~surely].max() <= float(predictor.belief.bounded(jnp.array([0.5]))[0]) + 1e-12


def test_a_higher_pull_loads_attachments_more_and_by_their_springs(predictor):
    s = jnp.where(attached(), KNOWN, 0.0)
    low, high = (eqx.filter_jit(predictor.outcome)(lift(height), s) for height in (6e-3, 18e-3))
    b = 30.0 * KNOWN / (1 - KNOWN)
    distance = np.linalg.norm(high.x - sheet().rest, axis=1)[attached()]
    assert high.energy == pytest.approx(0.5 * b * (distance**2).sum() / sheet().n)
    assert high.force == pytest.approx(b * distance.max())
    assert high.energy > low.energy and high.force > low.force and high.gain > low.gain > 0


@pytest.mark.parametrize(("stretched", "times"), [(1.0, 1.0), (2.0, 4.0), (0.5, 1.0)])
def test_the_observed_energy_ratio_is_the_square_of_the_stretch_and_at_least_one(predictor, stretched, times):
    """Attachments observed twice as far from their anchors as predicted hold four times the energy.

    To 1 %: the predicted equilibrium is searched from another start, and converges to its tolerance.
    """
    s, rest = jnp.where(attached(), KNOWN, 0.0), jnp.asarray(sheet().rest)
    pull = lift(12e-3)
    predicted = eqx.filter_jit(predictor.outcome)(pull, s, informative=False).x
    observed = eqx.tree_at(lambda p: p.start, pull, rest + stretched * (predicted - rest))
    batch = jax.tree.map(lambda leaf: leaf[None], observed)
    assert observed_energy_ratio(predictor, batch, s[None], min_energy=1e-12) == pytest.approx(times, rel=1e-2)
    assert observed_energy_ratio(predictor, batch, s[None], min_energy=1.0) == 1.0


def test_free_tissue_has_no_attachment_loads(predictor):
    found = eqx.filter_jit(predictor.outcome)(lift(18e-3), jnp.zeros(sheet().n))
    assert found.energy == 0 and found.force == 0 and found.gain > 0


@pytest.mark.slow
def test_pulls_on_two_devices_have_the_outcomes_of_one():
    """In a process of its own, because JAX has one CPU device unless a flag is set before it starts.

    With no more threads than devices, XLA on a CPU would wait for itself.
    """
    finished = subprocess.run(
        [sys.executable, __file__],
        env=os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", "NPROC": "8", "JAX_ENABLE_X64": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert finished.stdout.split() == ["2", "devices"]


def compare_on_all_devices() -> None:
    """Compare three pulls in three scenarios: nine pairs, which two devices cannot share evenly.

    The batched program iterates all its pairs together, so that results agree to its convergence.
    """
    belief = sheet_prior()
    predicted = PullPredictor.build(sheet_balance(1e-4), belief, POINT_PRECISION, ALL)
    s = predicted.scenarios(jax.random.key(0), 3, unknown=1.0)
    candidates = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(lift, (0.005, 0.01, 0.015)))
    batched, separate = (of(predicted, candidates, s, informative=False) for of in (outcomes_in_batches, outcomes))
    for leaf, expected in zip(jax.tree.leaves(batched), jax.tree.leaves(separate), strict=True):
        np.testing.assert_allclose(leaf, expected, rtol=1e-6, atol=1e-9)
    print(len(jax.devices()), "devices")


if __name__ == "__main__":
    compare_on_all_devices()


def test_the_predicted_gain_counts_noise_that_neighbours_share(predictor):
    """It is the gain of the frame's own information with the same noise in it.

    Noise as smooth as this one bends the sheet less than white noise of the same size, and so hides less.
    """
    shared, pull, s = jnp.asarray(fields()), lift(5e-3), jnp.where(attached(), KNOWN, 0.0)
    x = jnp.asarray(predictor.equilibrium(pull, s).x)
    counted = eqx.tree_at(lambda one: one.shared_noise, predictor, shared, is_leaf=lambda leaf: leaf is None)
    total = NOISE**2 + np.where(pull.held, 0.0, np.sum(np.asarray(shared) ** 2, axis=1))
    seen = Evidence(
        y=x,
        precision=jnp.asarray(np.eye(3) / total[:, None, None]),
        held=pull.held,
        force_unknown=pull.force_unknown,
        fields=shared,
    )

    def gain(evidence: Evidence) -> float:
        frame = predictor.balance.linearise(x, s, evidence)
        return float(predictor.gain(predictor.balance.information(frame, predictor.balance.fit(frame)).precision))

    assert float(counted.gain_at(pull, s, x)) == pytest.approx(gain(seen), rel=ROUNDING)
    assert gain(seen) > gain(seen.without_fields())


def test_loads_are_those_of_the_sheet_that_the_force_of_the_tool_shows(predictor):
    """With a factor on all stiffnesses nothing moves otherwise, and energies and forces have it."""
    twice = eqx.tree_at(lambda p: p.stiffness_factor, predictor, jnp.asarray(2.0))
    s = jnp.where(attached(), KNOWN, 0.0)
    declared, found = (each.outcome(lift(6e-3), s, informative=False) for each in (predictor, twice))
    np.testing.assert_array_equal(declared.x, found.x)
    assert found.force == pytest.approx(2 * float(declared.force), rel=ROUNDING)
    assert found.energy == pytest.approx(2 * float(declared.energy), rel=ROUNDING)
