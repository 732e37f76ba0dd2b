"""The Gaussian over all s for any choice of components, against dense algebra."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.belief.dual_gaussian import FIRST_BLOCK, DualGaussian
from jiggle_mj.estimator.belief.prior import PriorConfig

N = 2 * FIRST_BLOCK + 7
"""Particles; with many of them attached there are several blocks of measurements, the last in part."""
CENTRE, SD = np.array([0.0, 0.03, 0.3]), np.array([3e-3, 9e-3, 0.09])
ROUNDING = np.finfo(float).eps * 1e3 * 1e4 * N**0.5
"""Relative error of the evidence about one s, 2.6e-8: precisions of free and attached differ by a factor of 1e3, and
those of the evidence by 1e4; N roundings add up. How much of it there is depends on the processor."""


def evidence() -> tuple[np.ndarray, np.ndarray]:
    """Return precision and shift of frames that show some particles well, others hardly and the first not at all."""
    draw = np.random.default_rng(0)
    rows = draw.normal(size=(3 * N, N)) * np.logspace(0, 2, N)
    rows[:, 0] = 0
    return rows.T @ rows, rows.T @ draw.normal(size=3 * N)


def components(attached: int) -> np.ndarray:
    draw = np.random.default_rng(attached)
    found = np.zeros(N, int)
    found[draw.permutation(N)[:attached]] = draw.integers(1, 3, attached)
    return found


def dual() -> DualGaussian:
    precision, shift = evidence()
    return DualGaussian.build(
        jnp.asarray(precision), jnp.asarray(shift), centre=jnp.asarray(CENTRE), sd=jnp.asarray(SD)
    )


def dense(component: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return precision and shift of the evidence of all others about each s, from the covariance of all."""
    precision, shift = evidence()
    covariance = np.linalg.inv(precision + np.diag(SD[component] ** -2))
    mean, variance = covariance @ (shift + (CENTRE / SD**2)[component]), np.diag(covariance)
    return 1 / variance - SD[component] ** -2, mean / variance - (CENTRE / SD**2)[component]


def check(gaussian, component: np.ndarray) -> None:
    cavity = gaussian.cavity(jnp.arange(N), jnp.asarray(component))
    precision, shift = dense(component)
    np.testing.assert_allclose(1 / cavity.variance[1:], precision[1:], rtol=ROUNDING)
    np.testing.assert_allclose((cavity.mean / cavity.variance)[1:], shift[1:], rtol=ROUNDING, atol=ROUNDING)
    assert cavity.variance[0] > 1e4


@pytest.mark.parametrize("attached", [0, 5, FIRST_BLOCK, N])
def test_the_evidence_of_all_others_about_each_particle_is_that_of_the_dense_formula(attached):
    component = components(attached)
    check(eqx.filter_jit(dual().measured)(jnp.asarray(component)), component)


def test_a_change_of_one_component_is_as_if_all_were_measured_anew():
    """From free to attached, back, and from one component to another, across the border of a block."""
    component = components(FIRST_BLOCK - 1)
    gaussian = eqx.filter_jit(dual().measured)(jnp.asarray(component))
    changed = eqx.filter_jit(lambda gaussian, i, old, new: gaussian.changed(i, old, new))
    free, attached = np.flatnonzero(component == 0), np.flatnonzero(component)
    for i, new in [(free[3], 2), (attached[0], 0), (attached[1], 3 - component[attached[1]]), (free[4], 1)]:
        gaussian = changed(gaussian, *map(jnp.asarray, (i, component[i], new)))
        component[i] = new
    check(gaussian, component)


def test_a_free_particle_that_is_as_stiff_as_an_attached_one_is_refused():
    """It would be a measurement of negative precision."""
    with pytest.raises(ValueError, match=r"PriorConfig\.spike must be below 0\.0009"):
        PriorConfig(spike=9e-4)
