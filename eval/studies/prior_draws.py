"""Attachments drawn from the prior of the implicit filter, by NumPy alone, so that they test its sampler.

The free and the attached follow an Ising prior, whose joint law is known; Gibbs sweeps draw from it. The stiffness of
the attached is stated only by conditionals, each particle's component given those of its neighbours, and these are the
conditionals of no joint law. So what is drawn is where sweeps over them lead, with the sheet's component weights drawn
once from their Dirichlet prior. The sampler of the posterior sweeps over the same conditionals.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.stats import truncnorm

from jiggle_mj.estimator.belief.attachment_prior import AttachmentPrior
from jiggle_mj.estimator.belief.spike_and_slab import SpikeAndSlab

SWEEPS = 100
"""Gibbs sweeps of a draw. From all free or all attached, the number of attached particles of a sheet of 149 has settled
after about 50."""


def draw_attachments(
    prior: AttachmentPrior, rng: np.random.Generator, *, sweeps: int = SWEEPS
) -> Float[np.ndarray, " n"]:
    """Return a draw of the bounded stiffnesses of a sheet, in [0, 1]; 0 where a particle is free.

    Args:
        prior: of which particles are attached, and how stiffly.
        rng: random numbers.
        sweeps: Gibbs sweeps from a start that is attached everywhere or nowhere with equal chance.
    """
    stiffness, neighbours = prior.stiffness, np.asarray(prior.neighbours)
    n, c = len(neighbours), len(np.asarray(stiffness.weights))
    strength = float(stiffness.dirichlet_strength)
    weights = rng.dirichlet(np.full(c, strength / c)) + np.finfo(float).tiny
    kernel = np.asarray(stiffness.border_kernel)
    share = kernel @ weights
    source = weights[:, None] * kernel.T / share[None]
    log_odds, coupling, sheet = np.asarray(prior.log_odds), float(prior.coupling), float(prior.sheet_strength)
    component = rng.choice(c, n, p=share / share.sum()) if rng.random() < 0.5 else np.full(n, -1)
    for _ in range(sweeps):
        for i in rng.permutation(n):
            beside = component[neighbours[i][neighbours[i] < n]]
            beside = beside[beside >= 0]
            odds = log_odds[i] + coupling * len(beside)
            if rng.random() > 1 / (1 + np.exp(-odds)):
                component[i] = -1
                continue
            count = source[:, beside].sum(axis=1)
            own = kernel @ (weights + (count - len(beside) * weights) / (sheet + len(beside)))
            component[i] = np.searchsorted(np.cumsum(own), rng.random() * own.sum())
    return _drawn_stiffness(component, stiffness, rng)


def _drawn_stiffness(
    component: Int[np.ndarray, " n"], stiffness: SpikeAndSlab, rng: np.random.Generator
) -> Float[np.ndarray, " n"]:
    """Return s of each particle: 0 where free, else from its component's normal within [0, 1]."""
    attached = np.flatnonzero(component >= 0)
    mean, sd = (np.asarray(part)[1 + component[attached]] for part in (stiffness.mean, stiffness.sd))
    s = np.zeros(len(component))
    s[attached] = truncnorm.rvs(-mean / sd, (1 - mean) / sd, loc=mean, scale=sd, random_state=rng)
    return s
