"""The paper's filter agrees with the textbook's formulas, ignores missing particles, and works on its own simulator."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.belief.gaussian_belief import GaussianBelief
from jiggle_mj.estimator.filters.evidence import Evidence, Pull
from jiggle_mj.estimator.filters.explicit import non_negative, update
from jiggle_mj.estimator.filters.shots import ShotHistory, Shots, draw_samples, predicted
from jiggle_mj.estimator.physics.environment import Grip
from jiggle_mj.estimator.physics.membrane import EdgeMembrane
from jiggle_mj.estimator.physics.xpbd import XPBD, hinge_springs
from tests.support.small_sheet import GRIP_RADIUS, equilateral, jittered

MESH = jittered(equilateral(6, 6), 0.1)
SPRINGS = (EdgeMembrane.build(MESH, stiffness=30.0), hinge_springs(MESH, stiffness=1.0))
SIMULATOR, SWEEPS = XPBD.build(MESH, SPRINGS, areal_density=1.0, time_step=0.02), 20
NOISE, STIFFNESS = 1e-4, 3.0
ATTACHED = np.linalg.norm(MESH.rest, axis=1) < 9e-3


def updated(belief: GaussianBelief, shots: Shots, b: jax.Array | None = None) -> GaussianBelief:
    """Return the belief after an update linearised at b, by default at the mean where that is not negative."""
    return update(SIMULATOR, belief, jnp.maximum(belief.mean(), 0) if b is None else b, shots, sweeps=SWEEPS)[0]


def shots(truth: np.ndarray, seed: int) -> list[Shots]:
    """Return six steps of 4 mm of each of four corner lifts, simulated by f, with noise on what is observed."""
    rng, samples = np.random.default_rng(seed), []
    step = jax.jit(lambda x, grip: SIMULATOR.step(x, jnp.asarray(truth), grip, sweeps=SWEEPS))
    for outward in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        corner = MESH.rest[np.argmax(MESH.rest[:, :2] @ np.array(outward))] + 1e-3
        grip = Grip.build(jnp.asarray(MESH.rest), jnp.asarray(corner), radius=GRIP_RADIUS, stiffness=100.0)
        x = seen = MESH.rest
        for height in 4e-3 * np.arange(1, 7):
            tip = jnp.asarray(corner + np.array([0, 0, height]))
            x = step(jnp.asarray(seen), eqx.tree_at(lambda g: g.tip, grip, tip))
            noisy = np.asarray(x) + NOISE * rng.normal(size=x.shape)
            samples.append(one_shot(seen, tip, grip, noisy))
            seen = noisy
    return samples


def one_shot(start, tip, grip, end) -> Shots:
    return Shots(
        start=jnp.asarray(start)[None],
        tip=tip[None],
        length=grip.length[None],
        stiffness=jnp.asarray(grip.stiffness)[None],
        end=jnp.asarray(end)[None],
        precision=jnp.broadcast_to(jnp.eye(3) / NOISE**2, (1, MESH.n, 3, 3)),
    )


def stacked(samples: list[Shots]) -> Shots:
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *samples)


@pytest.fixture(scope="module")
def lift() -> list[Shots]:
    return shots(STIFFNESS * ATTACHED, 0)


def test_an_update_is_the_papers_equations(lift):
    """Three stacked samples agree with K = Sigma J^T (J Sigma J^T + V)^-1, J by finite differences."""
    belief = GaussianBelief.prior(MESH.n, mean=0.5, sd=1.0)
    three = stacked([lift[1], lift[8], lift[5]])
    after, _, nis = update(SIMULATOR, belief, belief.mean(), three, sweeps=SWEEPS)
    found_mean, found_covariance = after.moments()

    mean, covariance = (np.asarray(part) for part in belief.moments())
    simulate = jax.jit(lambda b: predicted_stack(three, b).ravel())
    h, tolerance = 1e-5, 1e-4  # of the central differences, whose error comes with J into every figure
    J = np.stack([(simulate(mean + h * d) - simulate(mean - h * d)) / (2 * h) for d in np.eye(MESH.n)], axis=1)
    S = J @ covariance @ J.T + NOISE**2 * np.eye(len(J))
    K = covariance @ J.T @ np.linalg.inv(S)
    innovation = np.asarray(three.end).ravel() - np.asarray(simulate(mean))
    expected_mean = mean + K @ innovation
    expected_covariance = (np.eye(MESH.n) - K @ J) @ covariance
    np.testing.assert_allclose(found_mean, expected_mean, atol=tolerance)
    np.testing.assert_allclose(found_covariance, expected_covariance, atol=tolerance)
    np.testing.assert_allclose(nis, innovation @ np.linalg.solve(S, innovation) / len(S), rtol=tolerance)


def predicted_stack(samples: Shots, b) -> jax.Array:
    return jax.lax.map(lambda shot: predicted(SIMULATOR, shot, b, sweeps=SWEEPS), samples)


def test_a_missing_particle_has_no_influence(lift):
    belief = GaussianBelief.prior(MESH.n, mean=0.0, sd=1.0)
    unseen = lift[3].precision.at[0, 7].set(0.0)
    one = eqx.tree_at(lambda s: s.precision, lift[3], unseen)
    other = eqx.tree_at(lambda s: s.end, one, one.end.at[0, 7].add(0.3))
    np.testing.assert_array_equal(updated(belief, one).precision, updated(belief, other).precision)
    np.testing.assert_allclose(updated(belief, one).shift, updated(belief, other).shift, rtol=1e-12)  # rounding


def filtered(samples: list[Shots]) -> tuple[GaussianBelief, np.ndarray]:
    """Return belief and constrained mean after one sample in each frame, from the paper's prior mean."""
    belief, b = GaussianBelief.prior(MESH.n, mean=1e-4, sd=3.0), jnp.zeros(MESH.n)
    for sample in samples:
        belief = updated(belief, sample, b)
        b = non_negative(belief, b)
    return belief, np.asarray(b)


def test_attached_particles_rank_above_all_others_on_its_own_simulator(lift):
    """Prior and noise in x_m, which f ignores, shrink the estimates: half the truth would be too high a bar."""
    mean = filtered(lift)[1]
    assert mean[ATTACHED].min() > 2 * mean[~ATTACHED].max()


def test_what_is_seen_is_evidence_for_the_b_that_was_simulated(lift):
    """A sheet that moves as f(b = 0) is evidence for b = 0, without a shift, also where the mean is below 0."""
    belief, nothing = GaussianBelief.prior(MESH.n, mean=-0.5, sd=1.0), jnp.zeros(MESH.n)
    agreeing = eqx.tree_at(lambda shot: shot.end, lift[3], predicted_stack(lift[3], nothing))
    after = updated(belief, agreeing, nothing)
    assert np.diagonal(after.precision).max() > 2
    np.testing.assert_allclose(after.shift, belief.shift, atol=1e-9 * float(after.precision.max()))  # rounding


def test_the_latest_sample_is_always_drawn_and_none_from_before_the_cut():
    drawn = [draw_samples(5, 3, np.random.default_rng(seed)) for seed in range(50)]
    assert all(one[-1] == 5 and len(set(one.tolist())) == 3 for one in drawn)
    assert set(np.concatenate(drawn).tolist()) == {0, 1, 2, 3, 4, 5}
    assert draw_samples(0, 3, np.random.default_rng(0)).tolist() == [0]

    history = ShotHistory.empty(jax.random.key(0))
    for height in (1.0, 2.0, 3.0):
        history, _ = history.with_step(step(height), grip_stiffness=90.0).draw(3)
    history, after = history.forgotten(), []
    for height in (4.0, 5.0):
        history, drawn = history.with_step(step(height), grip_stiffness=90.0).draw(3)
        after.append(drawn)
    heights = [np.asarray(one.tip)[np.asarray(one.precision).any(axis=(1, 2, 3)), 2].tolist() for one in after]
    assert heights == [[4.0], [4.0, 5.0]]


def step(height: float) -> Evidence:
    """Return a frame that the height of its tip identifies [m]."""
    one, x = np.ones(MESH.n, bool), jnp.asarray(MESH.rest)
    pull = Pull(before=x, tip=jnp.asarray([0.0, 0.0, height]), length=jnp.ones(MESH.n))
    precision = jnp.broadcast_to(jnp.eye(3), (MESH.n, 3, 3))
    return Evidence(y=x, precision=precision, held=jnp.asarray(one), force_unknown=jnp.asarray(one), pull=pull)
