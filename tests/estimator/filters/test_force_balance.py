"""A frame's evidence about the attachments agrees with the dense formula, from free to welded."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.filters.config import FilterConfig
from jiggle_mj.estimator.filters.evidence import Evidence
from jiggle_mj.estimator.filters.force_balance import ForceBalance
from jiggle_mj.estimator.physics.surrogate import surrogate
from jiggle_mj.observation import Declaration
from tests.support.small_sheet import (
    DECLARATION,
    attached,
    dense,
    equilateral,
    jittered,
    lifts,
    sharing,
    sheet,
    sheet_balance,
    sheet_energy,
)
from tests.support.small_sheet import observed as evidence

K = DECLARATION.membrane_stiffness
FORCE_SD, FORCE_LEVEL, ANCHOR_SD = 1e-4, 24e-3, 1e-4
N = sheet().n
CONFIG = FilterConfig()
DENSE_ROUNDING = 1e-7
"""Relative rounding of the dense formula, which inverts 3n x 3n matrices of stiffnesses and precisions [1]."""
VECTOR_ROUNDING = 1e-6
"""The same for products of those inverses with residual forces, which cancel in part [1]."""
SLOPE_LEFT = 1e-4
"""Share of the slope that a line search in steps of a tenth leaves."""
DIFFERENCE_ROUNDING = 1e-8
"""Rounding of a central difference of forces, exact otherwise as r is linear in s [N]."""


@eqx.filter_jit
def information(balance: ForceBalance, x, s, evidence: Evidence):
    frame = balance.linearise(x, s, evidence)
    return balance.information(frame, balance.fit(frame))


@pytest.fixture
def balance() -> ForceBalance:
    return sheet_balance(FORCE_SD, FORCE_LEVEL)


@pytest.mark.parametrize("shared", [False, True])
def test_information_equals_the_dense_formula(balance, shared):
    """Precision, score and chi2 are D^T N^-1 D, -D^T N^-1 e and e^T N^-1 e over free particles, with N = V + H R H^T.

    tau grows, from FORCE_SD, with the sum of the forces of the elements around a particle. D is shrunk by a multiple of
    the share that its error makes up, by the covariance of x given all that was seen. Noise that neighbours share is
    part of R.
    """
    frame = lifts()[3]
    white, x = evidence(frame, 1), frame.x
    seen = sharing(white) if shared else white
    s = np.random.default_rng(0).uniform(0, 1, N)
    s[:5] = 1
    found = information(balance, jnp.asarray(x), jnp.asarray(s), seen)

    free, each = np.repeat(~frame.held, 3), np.repeat(s, 3)
    internal = np.asarray(eqx.filter_jit(sheet_energy().internal_gradient)(jnp.asarray(x)))
    stiff = dense(sheet_energy().layout, eqx.filter_jit(sheet_energy().hessian)(jnp.asarray(x), jnp.zeros(N)))
    d = x - sheet().rest
    H = (1 - each)[:, None] * stiff + np.diag(each * K)
    R = np.zeros((3 * N, 3 * N))
    D = np.zeros((3 * N, N))
    for i in range(N):
        R[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = np.linalg.inv(
            np.asarray(white.precision)[i] + CONFIG.position_precision_floor * np.eye(3)
        )
        D[3 * i : 3 * i + 3, i] = K * d[i] - internal[i]
    if seen.fields is not None:
        R += np.kron(seen.seen_fields @ seen.seen_fields.T, np.eye(3))
    flow = np.zeros(N)
    for term in sheet_energy().terms:
        forces = np.asarray(eqx.filter_jit(term.gradient)(jnp.asarray(x[np.asarray(term.vertices)])))
        np.add.at(flow, np.asarray(term.vertices), np.linalg.norm(forces, axis=2))
    tau = np.sqrt(FORCE_SD**2 + (FORCE_SD / CONFIG.force_sd_floor * flow / FORCE_LEVEL) ** 2)
    assert tau.max() > 1.3 * tau.min()
    V = np.diag(((1 - each) * np.repeat(tau, 3)) ** 2 + (each * K * ANCHOR_SD) ** 2)
    W = np.where(free, 1 / np.diagonal(V), 0)
    covariance = np.linalg.inv(np.linalg.inv(R) + H.T @ (W[:, None] * H))
    dD_dx = K * np.eye(3 * N) - stiff
    error = np.diagonal(dD_dx @ covariance @ dD_dx.T).reshape(N, 3).sum(axis=1)
    D *= np.maximum(1 - CONFIG.error_weight * error / np.sum(D**2, axis=0), 0)
    e = ((1 - each) * internal.ravel() + each * K * d.ravel() + H @ (np.asarray(seen.y) - x).ravel())[free]
    D, N_inverse = D[free], np.linalg.inv((V + H @ R @ H.T)[np.ix_(free, free)])
    expected = D.T @ N_inverse @ D
    np.testing.assert_allclose(found.precision, expected, atol=DENSE_ROUNDING * np.abs(expected).max())
    score = -D.T @ N_inverse @ e
    np.testing.assert_allclose(found.score, score, atol=VECTOR_ROUNDING * np.abs(score).max())
    np.testing.assert_allclose(found.chi2, e @ N_inverse @ e, rtol=VECTOR_ROUNDING)
    np.testing.assert_allclose(found.shift, score + expected @ s, atol=VECTOR_ROUNDING * np.abs(expected @ s).max())


def test_dr_ds_is_the_derivative_of_the_residual_force(balance):
    frame = lifts()[3]
    seen, x = evidence(frame, 1), jnp.asarray(frame.x)
    s, step = jnp.asarray(np.random.default_rng(1).uniform(0, 1, N)), 1e-6
    linearised = eqx.filter_jit(balance.linearise)
    ahead, behind, here = (linearised(x, s + move, seen) for move in (step, -step, 0.0))
    difference = (ahead.unbalanced - behind.unbalanced) / (2 * step)
    np.testing.assert_allclose(here.dr_ds, difference, atol=DIFFERENCE_ROUNDING)


def test_at_a_weld_the_reaction_force_shows(balance):
    """A welded particle at the rim does not move; one frame gives its s a standard deviation of 0.2 all the same."""
    frame, s = lifts(np.inf)[7], jnp.asarray(attached().astype(float))
    moved = np.linalg.norm(frame.x - sheet().rest, axis=1)
    assert moved[attached()].max() < 1e-5
    found = information(balance, jnp.asarray(frame.x), s, evidence(frame, 2))
    assert np.diagonal(found.precision)[attached()].max() > 1 / 0.2**2


def test_twenty_frames_in_which_nothing_moved_leave_s_unknown(balance):
    """Every D is then error, which must not add up over frames: 0.29 is the standard deviation of any s in [0, 1]."""
    frame = lifts()[0]
    np.testing.assert_array_equal(frame.x, sheet().rest)
    search = eqx.filter_jit(lambda seen: balance.approach(seen.y, jnp.zeros(N), seen).x)
    seen = [evidence(frame, seed) for seed in range(20)]
    found = [information(balance, search(one), jnp.zeros(N), one).precision for one in seen]
    assert np.median(np.sum([np.diagonal(one) for one in found], axis=0)[~frame.held]) < 1 / 0.5**2


def test_a_search_that_is_cut_off_says_so(balance):
    """From what was seen, crumpled by its noise, it takes several steps; one is not enough."""
    seen, s = evidence(lifts()[3], 3), jnp.zeros(N)
    search = eqx.filter_jit(lambda balance: balance.approach(seen.y, s, seen).converged)
    assert search(balance)
    assert not search(replace(balance, config=FilterConfig(max_state_steps=1)))


def test_steps_end_where_the_cost_has_no_slope(balance):
    """With shared noise, at fixed weights: the slope of what was seen and that of the forces cancel."""
    white, s = evidence(lifts()[3], 3), jnp.zeros(N)
    seen = sharing(white)
    frame = eqx.filter_jit(balance.approach)(jnp.asarray(lifts()[3].x), s, seen)
    for _ in range(30):
        x = eqx.filter_jit(balance.polish)(frame, s)
        frame = eqx.filter_jit(balance.linearise)(x, s, seen)
    R = np.zeros((3 * N, 3 * N))
    for i, precision in enumerate(np.asarray(white.precision)):
        R[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = np.linalg.inv(precision)
    shared = np.asarray(seen.seen_fields)
    R += np.kron(shared @ shared.T, np.eye(3))
    by_seen = np.linalg.solve(R, np.asarray(seen.y - frame.x).ravel())
    by_force = eqx.filter_jit(jax.grad(lambda x: 0.5 * jnp.sum(frame.weight[:, None] * balance.unbalanced(x, s) ** 2)))(
        frame.x
    )
    np.testing.assert_allclose(by_seen, np.asarray(by_force).ravel(), atol=SLOPE_LEFT * np.abs(by_seen).max())


def test_evidence_only_sharpens(balance):
    """Each frame's information is positive semi-definite."""
    frame = lifts()[3]
    found = information(balance, jnp.asarray(frame.x), jnp.zeros(N), evidence(frame, 3))
    values = np.linalg.eigvalsh(np.asarray(found.precision))
    rounding = 1e-9 * values.max()
    assert values.min() > -rounding and values.max() > 1e3


def test_no_unseen_particle_is_less_certain_than_the_floor():
    """A fine sheet without weight is held beyond its seen quarter: variances span twelve orders of magnitude."""
    mesh = jittered(equilateral(30, 16, 1.5e-3), 0.1)
    energy = surrogate(mesh, Declaration(gravity=(0.0, 0.0, 0.0), bed=False))
    balance = ForceBalance.build(
        mesh, energy, reference=K, force_sd=5e-5, force_level=FORCE_LEVEL, anchor_sd=ANCHOR_SD, grip_stiffness=3 * K
    )
    along = mesh.rest[:, 0] - mesh.rest[:, 0].min()
    seen, from_tip = along < 11e-3, np.linalg.norm(mesh.rest - mesh.rest[along.argmax()] / 2, axis=1)
    held, pulled = jnp.asarray(from_tip < 3e-3), jnp.asarray(from_tip < 6e-3)
    sd = np.where(seen, 2e-5, 1.5e-3)[:, None, None]
    precision = jnp.asarray(np.where((seen | np.asarray(held))[:, None, None], np.eye(3) / sd**2, 0.0))
    x = jnp.asarray(mesh.rest)
    evidence = Evidence(y=x, precision=precision, held=held, force_unknown=pulled)
    fit = eqx.filter_jit(lambda: balance.fit(balance.linearise(x, jnp.zeros(mesh.n), evidence)))()
    variance = np.diagonal(np.asarray(fit.covariance.diagonal), axis1=1, axis2=2)
    assert 0 < variance.min() < 1e-9
    assert 0.1 < variance.max() <= 1 / CONFIG.position_precision_floor + 1e-6
