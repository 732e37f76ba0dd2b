"""Evidence of a fitted hypothesis: ln p(observations), with attachments, parameters and sizes of the errors integrated.

    ln Z = ln p(y | s, theta, phi) + ln p(theta) + ln p(phi) - 1/2 ln |Hessian / 2 pi| + ln int p(s) ...

The parameters by Laplace's method at the fit [Tierney & Kadane 1986, doi:10.1080/01621459.1986.10478240], the
attachments by expectation propagation (`belief.attachment_evidence`), and the sizes phi at their likeliest values,
which are as many in every hypothesis. A parameter at its bound is not integrated.
"""

import jax.numpy as jnp
import numpy as np

from ..belief.attachment_evidence import log_evidence
from ..belief.gaussian_information import GaussianInformation
from .gauss_newton import Fitted

SWEEPS = 15
"""Sweeps of expectation propagation, after which the sites have settled."""
NEAR_BOUND = 1e-9
"""Distance from its bound up to which a parameter is at it [prior standard deviations]."""


def log_model_evidence(fitted: Fitted) -> float:
    """Return ln Z of a fit [nat], up to a constant of the frames; minus infinity where it is no number."""
    problem, point, n = fitted.problem, fitted.point, len(fitted.point.s)
    free, sd = fitted.free, problem.sd(fitted.named)
    inside = point.theta[free] > problem.lower_bounds(free) + NEAR_BOUND * sd
    joint = GaussianInformation.from_normal_equations(fitted.square, s=n, theta=len(free))
    joint = joint.with_independent("theta", sd**-2, -point.theta[free] / sd**2)
    precision, slope = np.asarray(joint.precision), np.asarray(joint.shift)
    of_theta = precision[n:, n:][np.ix_(inside, inside)]
    beside = precision[:n, n:][:, inside]
    # what the parameters leave of the slope in s; their own counts for nothing, as the fit did not go along it
    solved = np.linalg.solve(of_theta, np.column_stack([beside.T, slope[n:][inside]]))
    information, shift = precision[:n, :n] - beside @ solved[:, :-1], slope[:n] - beside @ solved[:, -1]
    scaled = of_theta * np.outer(sd[inside], sd[inside])
    log_prior = -0.5 * np.sum((point.theta[free] / sd) ** 2) - 0.5 * np.linalg.slogdet(scaled)[1]
    about = -0.5 * point.s @ information @ point.s - shift @ point.s
    belief = problem.prior.add(jnp.asarray(information), jnp.asarray(shift + information @ point.s)).swept(SWEEPS)
    found = fitted.log_likelihood + log_prior + problem.scales.log_prior() + about + float(log_evidence(belief))
    return float(found) if np.isfinite(found) else -np.inf
