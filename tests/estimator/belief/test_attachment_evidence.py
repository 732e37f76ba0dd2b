"""The evidence of a model with the attachments integrated out, against sums and quadrature."""

from itertools import product

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import logit, logsumexp
from scipy.stats import truncnorm

from jiggle_mj.estimator.belief.attachment_belief import AttachmentBelief
from jiggle_mj.estimator.belief.attachment_evidence import log_evidence
from jiggle_mj.estimator.belief.attachment_prior import AttachmentPrior
from jiggle_mj.estimator.belief.spike_and_slab import SpikeAndSlab

COMPONENTS, SPREAD, SPIKE = (0.05, 0.3), 0.5, 5e-3
STIFFNESS = SpikeAndSlab.build(spike=SPIKE, components=COMPONENTS, spread=SPREAD, dirichlet_strength=1e12, partial=0.0)
"""With so many equal particles beforehand that the weights stay as they are."""
H = logit(0.1)
"""Log odds of a particle without attached neighbours."""
GRID = np.concatenate([np.linspace(0, 0.05, 1200, endpoint=False), np.linspace(0.05, 1, 1500)])
"""Values of s for quadrature, finer where a free particle's are."""

swept = eqx.filter_jit(AttachmentBelief.swept)


def chain(n: int, *, coupling: float) -> AttachmentBelief:
    """Return the belief over particles in a row before any evidence."""
    edges = np.column_stack([np.arange(n - 1), np.arange(1, n)])
    prior = AttachmentPrior.build(n, edges, stiffness=STIFFNESS, probability=0.1, coupling=coupling)
    return AttachmentBelief.before(prior, reference=30.0)


def found(precision: np.ndarray, shift: np.ndarray, *, coupling: float) -> float:
    belief = swept(chain(len(shift), coupling=coupling).add(jnp.asarray(precision), jnp.asarray(shift)), 80)
    return float(log_evidence(belief))


def densities() -> np.ndarray:
    """Return ln of exp(h a) p(s | a) on the grid, for a of 0 and 1."""
    parts = [truncnorm.logpdf(GRID, 0, 1 / SPIKE, scale=SPIKE)]
    parts += [
        truncnorm.logpdf(GRID, -1 / SPREAD, (1 - mean) / (SPREAD * mean), loc=mean, scale=SPREAD * mean)
        for mean in COMPONENTS
    ]
    return np.array([parts[0], H + logsumexp(np.array(parts[1:]) - np.log(len(COMPONENTS)), axis=0)])


def integral(log_values: np.ndarray) -> np.ndarray:
    """Return the logarithm of the integral over the last axis, by the trapezium rule."""
    largest = log_values.max()
    return np.log(np.trapezoid(np.exp(log_values - largest), GRID)) + largest


@pytest.mark.parametrize("coupling", [0.0, 1.5])
def test_independent_measurements_on_a_tree_are_exact(coupling: float):
    mean, variance = np.array([0.0, 0.02, 0.15, 0.4]), np.array([1e-4, 2e-4, 1e-3, 1e-2])
    single = np.array(
        [
            [integral(one - 0.5 * GRID**2 / v + GRID * m / v) for one in densities()]
            for m, v in zip(mean, variance, strict=True)
        ]
    )
    states = [np.array(state) for state in product((0, 1), repeat=len(mean))]
    exact = logsumexp([single[np.arange(len(a)), a].sum() + coupling * np.sum(a[1:] * a[:-1]) for a in states])
    assert found(np.diag(1 / variance), mean / variance, coupling=coupling) == pytest.approx(exact, abs=2e-3)


@pytest.mark.parametrize(("share", "error"), [(0.0, 5e-3), (0.3, 0.02), (0.6, 0.1)])
def test_two_particles_whose_evidence_is_correlated(share: float, error: float):
    """The more either may bear the load alone, the less a Gaussian site stands for both peaks."""
    sd, mean = np.array([0.02, 0.03]), np.array([0.1, 0.15])
    precision = np.linalg.inv(np.outer(sd, sd) * np.array([[1, -share], [-share, 1]]))
    shift = precision @ mean
    first, second = logsumexp(densities(), axis=0)[:, None], logsumexp(densities(), axis=0)[None]
    s, t = GRID[:, None], GRID[None]
    quadratic = 0.5 * (precision[0, 0] * s**2 + 2 * precision[0, 1] * s * t + precision[1, 1] * t**2)
    exponent = first + second - quadratic + shift[0] * s + shift[1] * t
    exact = integral(np.array([integral(row) for row in exponent]))
    assert found(precision, shift, coupling=0.0) == pytest.approx(exact, abs=error)
