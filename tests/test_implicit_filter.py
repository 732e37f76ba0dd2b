"""The implicit filter: attachments on its own engine, the dense formula, missing particles, honest uncertainty."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jiggle_mj.estimator.belief import BoundaryBelief
from jiggle_mj.estimator.filters.evidence import Evidence
from jiggle_mj.estimator.filters.implicit import FAINT, ImplicitFilter
from scipy.stats import chi2
from small_sheet import DECLARATION, STIFFNESS, Lift, attached, dense, lifts, sheet, sheet_energy

NOISE, GRIP_SD = 1e-4, 1.5e-3
"""[m]."""
K = DECLARATION.membrane_stiffness
FORCE_SD = 1e-4
"""[N]; small, as the data come from the filter's own model."""
PRIOR_SD = STIFFNESS / 2
"""[N/m]."""
THRESHOLD = STIFFNESS / 3
"""[N/m]."""

update = ImplicitFilter.update


@eqx.filter_jit
def information(implicit: ImplicitFilter, x, b, evidence: Evidence):
    frame = implicit._linearise(x, b, evidence)
    return implicit._information(frame, b, implicit._residual(frame)[1])


@eqx.filter_jit
def normalised_innovation(implicit: ImplicitFilter, x, b, evidence: Evidence, belief: BoundaryBelief):
    frame = implicit._linearise(x, b, evidence)
    residual, whitened = implicit._residual(frame)
    gained, shift = implicit._information(frame, b, whitened)
    after = jnp.linalg.cholesky(belief.add(gained, shift).precision)
    return implicit._normalised_innovation(frame, residual, whitened, gained, belief.mean() - b, after, evidence)


@pytest.fixture(scope="module")
def implicit() -> ImplicitFilter:
    return ImplicitFilter.build(sheet(), sheet_energy(), force_sd=FORCE_SD, grip_stiffness=3 * K)


def evidence(frame: Lift, seed: int, unseen: np.ndarray | None = None) -> Evidence:
    """Noisy positions, and held particles as the tip says."""
    noisy = frame.x + NOISE * np.random.default_rng(seed).normal(size=frame.x.shape)
    sd = np.where(frame.held, GRIP_SD, NOISE)
    precision = np.eye(3) / sd[:, None, None] ** 2
    if unseen is not None:
        precision = np.where(unseen[:, None, None], 0.0, precision)
    held = jnp.asarray(frame.held)
    return Evidence(y=jnp.asarray(noisy), precision=jnp.asarray(precision), held=held, loaded=held)


def run(implicit: ImplicitFilter, frames: tuple[Lift, ...], seed: int):
    belief, b, outcomes = BoundaryBelief.prior(sheet().n, mean=0.0, sd=PRIOR_SD), jnp.zeros(sheet().n), []
    for k, frame in enumerate(frames):
        seen = evidence(frame, 100 * seed + k)
        out = update(implicit, belief, b, seen, seen.y)
        belief, b = out.belief, out.b
        outcomes.append(out)
    return outcomes[-1]


@pytest.fixture(scope="module")
def runs(implicit):
    return [run(implicit, lifts(), seed) for seed in range(8)]


def test_the_attached_particles_are_found_and_no_others(runs):
    """Four corner lifts with 0.1 mm of noise, on the filter's own engine; at most one particle in 81 is wrong a run."""
    wrong = [int(np.sum((np.asarray(out.b) > THRESHOLD) != attached())) for out in runs]
    assert max(wrong) <= 1, wrong


def test_a_free_sheet_has_no_attachment(implicit):
    for seed in range(2):
        assert not (np.asarray(run(implicit, lifts(0.0), seed).b) > THRESHOLD).any()


def test_errors_are_as_large_as_stated(runs):
    """NEES per degree of freedom over eight seeds; the issue asks for 0.5 to 2. Its chi-square band would be 0.89-1.11,
    but truth here is no draw from the prior."""
    truth = STIFFNESS * attached()
    nees = []
    for out in runs:
        mean, covariance = (np.asarray(part) for part in out.belief.moments())
        nees.append((mean - truth) @ np.linalg.solve(covariance, mean - truth) / len(truth))
    low, high = chi2.ppf([0.005, 0.995], len(truth) * len(runs)) / (len(truth) * len(runs))
    assert 0.5 * low < np.mean(nees) < 2 * high, nees


def test_the_state_is_closer_to_the_truth_than_what_was_seen(implicit):
    """The sheet's physics filters the noise."""
    frame = lifts()[3]
    seen = evidence(frame, 5)
    belief = BoundaryBelief.prior(sheet().n, mean=STIFFNESS / 2, sd=PRIOR_SD)
    out = update(implicit, belief, jnp.asarray(STIFFNESS * attached()), seen, seen.y)
    free = ~frame.held
    rms = [np.sqrt(np.mean((np.asarray(x) - frame.x)[free] ** 2)) for x in (out.x, seen.y)]
    assert rms[0] < 0.8 * rms[1]


def test_information_equals_the_dense_formula(implicit):
    """D^T (tau^2 I + H R H)^-1 D over particles that are not held, the shift D^T N^-1 (D b - g - H (y - x)), and
    the innovation at the mean of a belief, squared against N + D Sigma D^T."""
    frame = lifts()[3]
    seen = evidence(frame, 1)
    b = jnp.asarray(np.random.default_rng(0).uniform(0, 1, sheet().n))
    gained, shift = information(implicit, jnp.asarray(frame.x), b, seen)

    n, free = sheet().n, np.repeat(~frame.held, 3)
    H = dense(sheet_energy().layout, sheet_energy().hessian(jnp.asarray(frame.x), b))
    R = np.zeros((3 * n, 3 * n))
    for i in range(n):
        R[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = np.linalg.inv(np.asarray(seen.precision)[i] + FAINT * np.eye(3))
    N = float(implicit.force_sd) ** 2 * np.eye(3 * n) + H @ R @ H
    D = np.zeros((3 * n, n))
    for i in range(n):
        D[3 * i : 3 * i + 3, i] = frame.x[i] - sheet().rest[i]
    D, N = D[free], N[np.ix_(free, free)]
    expected = D.T @ np.linalg.solve(N, D)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(gained, expected, atol=1e-7 * scale)

    g = np.asarray(sheet_energy().gradient(jnp.asarray(frame.x), b)).ravel()
    residual = (g + H @ (np.asarray(seen.y) - frame.x).ravel())[free]
    expected_shift = expected @ np.asarray(b) - D.T @ np.linalg.solve(N, residual)
    np.testing.assert_allclose(shift, expected_shift, atol=1e-6 * np.abs(expected_shift).max())

    belief = BoundaryBelief.prior(n, mean=0.2, sd=PRIOR_SD)
    innovation = residual + D @ (0.2 - np.asarray(b))
    squared = innovation @ np.linalg.solve(N + PRIOR_SD**2 * D @ D.T, innovation)
    nis = normalised_innovation(implicit, jnp.asarray(frame.x), b, seen, belief)
    np.testing.assert_allclose(nis, squared / (3 * n - 3 * frame.held.sum()), rtol=1e-6)


def test_a_missing_particle_has_no_influence(implicit):
    """Whatever stands in y where the precision is zero, the outcome is the same."""
    frame = lifts()[3]
    unseen = np.zeros(sheet().n, bool)
    unseen[[3, 20, 44, 60]] = True
    seen = evidence(frame, 2, unseen)
    other = Evidence(
        y=jnp.where(jnp.asarray(unseen)[:, None], seen.y + 0.3, seen.y),
        precision=seen.precision,
        held=seen.held,
        loaded=seen.loaded,
    )
    belief, b = BoundaryBelief.prior(sheet().n, mean=0.0, sd=PRIOR_SD), jnp.zeros(sheet().n)
    one, two = (update(implicit, belief, b, e, jnp.asarray(frame.x)) for e in (seen, other))
    for name in ("x", "b", "nis"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    np.testing.assert_array_equal(one.belief.precision, two.belief.precision)


def test_evidence_only_sharpens(implicit):
    """Each frame's information is positive semi-definite, so the entropy falls."""
    frame = lifts()[3]
    gained, _ = information(implicit, jnp.asarray(frame.x), jnp.zeros(sheet().n), evidence(frame, 3))
    values = np.linalg.eigvalsh(np.asarray(gained))
    assert values.min() > -1e-9 * values.max()
    assert values.max() > PRIOR_SD**-2
