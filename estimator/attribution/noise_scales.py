"""Sizes of the errors that no effect stands for, which are free in every hypothesis, and their prior.

Force errors of the model, smooth force fields, the tool's reports, the noise that neighbours share, the tool's measured
force and, where the noise is assumed, all errors together each have a variance, over the assumed one. Its logarithm is
normal where only what is assumed is wrong, or, with the same probability, larger by any amount: then the model lacks
something that has no name here. The autocorrelation of the errors from frame to frame may be anything from 0 to 1, all
with the same density.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from scipy.optimize import OptimizeResult, minimize_scalar
from scipy.special import log_ndtr
from scipy.stats import norm

USUAL_LOG_SD = 1.0
"""Standard deviation of the logarithm of a variance about the assumed one, where nothing is missing [nat]."""
LARGER_LOG_SD = 4.0
"""The same, upwards alone, where something is missing [nat]."""
LOG_RANGE = (-3.0, 14.0)
"""Range of the logarithms of all variances [nat]. Where a sheet was measured in one plane, or the tool is the mean of
what it holds, some residuals are 0, and the likelihood would rise towards a variance of 0."""


@dataclass(frozen=True, kw_only=True)
class NoiseScales:
    """Variances of the errors, over the assumed ones."""

    force: float = 1.0
    """Variance of the model's force errors."""
    fields: float = 1.0
    """Variance of the smooth force fields."""
    tool: float = 1.0
    """Variance of the tool's residual."""
    smooth: float = 1.0
    """Variance of the noise that neighbours share."""
    pull: float | None = None
    """Variance of the measured force of the tool; None where none was measured."""
    noise: float | None = None
    """Variance of all errors of positions and of the forces on them; None, as assumed, where the noise was measured."""
    autocorrelation: float = 0.0
    """Autocorrelation of the errors of a frame and of the next one; no variance."""

    @property
    def variances(self) -> dict[str, float]:
        """Return the variances by name."""
        values = {one.name: getattr(self, one.name) for one in fields(self) if one.name != "autocorrelation"}
        return {name: value for name, value in values.items() if value is not None}

    def __str__(self) -> str:
        """Return the variances and the autocorrelation as text."""
        sizes = ", ".join(f"{name} {value:.2g}" for name, value in self.variances.items())
        return f"{sizes} times the assumed variance, autocorrelation {self.autocorrelation:.3g}"

    def log_prior(self) -> float:
        """Return the log density of the variances' logarithms and of the autocorrelation [nat]."""
        return sum(log_prior(value) for value in self.variances.values())

    @property
    def larger(self) -> float:
        """Return the probability that any of them is larger because something is missing; the noise has a name."""
        unnamed = [value for value in (self.force, self.fields, self.tool, self.pull) if value is not None]
        return 1 - float(np.prod([1 - np.exp(_log_larger(value) - log_prior(value)) for value in unnamed]))


def log_prior(variance: float) -> float:
    """Return the log density of the logarithm of a variance over the assumed one [nat]."""
    usual = np.log(0.5) + float(norm.logpdf(np.log(variance), scale=USUAL_LOG_SD))
    return float(np.logaddexp(usual, _log_larger(variance)))


def _log_larger(variance: float) -> float:
    """Return the part of the density of a variance that is larger because something is missing.

    It rises smoothly from the assumed variance on, as the normal distribution function of the usual spread does.
    """
    size = np.log(variance)
    return float(norm.logpdf(size, scale=LARGER_LOG_SD) + log_ndtr(size / USUAL_LOG_SD))


def likeliest_variance(squared: float, degrees: float) -> float:
    """Return the likeliest variance of a number of residuals, from their squared sum."""
    return likeliest_under(lambda variance: -0.5 * (squared / variance + degrees * float(np.log(variance))))


def likeliest_under(log_likelihood: Callable[[float], float]) -> float:
    """Return the variance of largest posterior under a log likelihood of it [nat]."""

    def minus(log_variance: float) -> float:
        return -log_likelihood(float(np.exp(log_variance))) - log_prior(float(np.exp(log_variance)))

    found: OptimizeResult = minimize_scalar(minus, bounds=LOG_RANGE, method="bounded", options={"xatol": 1e-5})
    return float(np.exp(found["x"]))
