"""Sizes of the errors that no effect stands for, which are free in every hypothesis, and their prior.

Force errors of the model, smooth force fields, the tool's reports, the steps of the tracker's walk and the tool's
measured force each have a variance, over the assumed one. Its logarithm is normal where only what is assumed is wrong,
or, with the same probability, larger by any amount: then the model lacks something that has no name here.
"""

from dataclasses import dataclass, fields

import numpy as np
from scipy.special import log_ndtr
from scipy.stats import norm

USUAL_LOG_SD = 1.0
"""Standard deviation of the logarithm of a variance about the assumed one, where nothing is missing [nat]."""
LARGER_LOG_SD = 4.0
"""The same, upwards alone, where something is missing [nat]."""


@dataclass(frozen=True, kw_only=True)
class NoiseScales:
    """Variances of the errors, over the assumed ones."""

    force: float = 1.0
    """Variance of the model's force errors."""
    fields: float = 1.0
    """Variance of the smooth force fields."""
    tool: float = 1.0
    """Variance of the tool's residual."""
    walk: float = 1.0
    """Variance of the steps of the tracker's walk."""
    pull: float | None = None
    """Variance of the measured force of the tool; None where none was measured."""

    @property
    def values(self) -> tuple[float, ...]:
        """Return the variances in the order of the fields."""
        values = (getattr(self, one.name) for one in fields(self))
        return tuple(value for value in values if value is not None)

    def log_prior(self) -> float:
        """Return the log density of their logarithms [nat]."""
        return sum(log_prior(value) for value in self.values)

    @property
    def larger(self) -> float:
        """Return the probability that any of them is larger because something is missing; the walk has a name."""
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
