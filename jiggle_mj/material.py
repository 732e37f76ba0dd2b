"""The material ratios that a recording identifies, and those that it does not."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from .argument_checks import quoted
from .errors import OptionError
from .likely_name import did_you_mean
from .observation import Declaration

RATIOS = ("weight", "bending")
"""Names of the ratios to the membrane stiffness that positions identify."""
MAX_LOG_SD = np.log(2) / 2
"""Standard error of a factor's logarithm from which on it is refused: two of them are a factor of two either way."""
WHY_NO_MEMBRANE_STIFFNESS = (
    "positions alone give only ratios: one factor on every stiffness and on the weight changes no position. "
    "Weigh the tissue: the ratio of weight to membrane stiffness then gives the latter. Or measure one force"
)
"""Reason why the membrane stiffness itself is never identified."""
UNKNOWN_LOG_SD = 2.0
"""Standard error of a factor's logarithm from which on the frames are said to hold no evidence: a factor of 50 either
way, what is assumed before any frame."""
TRADES_ABOVE = 0.7
"""Correlation from which on a quantity is named beside a refusal: half of the variance is due to it."""


@dataclass(frozen=True, kw_only=True)
class Ratio:
    """Ratio of the weight or of the bending stiffness to the membrane stiffness."""

    declared: float
    """Ratio of the declared values [unit]."""
    unit: str
    """Unit of the ratio."""
    factor: float | None
    """Identified ratio over the declared one [1]; None where it is not identified."""
    log_sd: float
    """Standard error of the factor's logarithm: about its relative error, where the model is right."""
    refused: str | None
    """Reason why the factor is not identified; None where it is."""
    trades_with: str
    """What looks most alike in the frames when it changes: the other ratio, the attachments, the height of what is seen
    above the middle of the sheet, or friction with the bed."""
    correlation: float
    """Size of the correlation with that [1]; near 1 only both together are known."""


@dataclass(frozen=True, kw_only=True)
class Material:
    """Identified material of one sheet."""

    declared: Declaration
    """What the user declared."""
    ratios: dict[str, Ratio]
    """The ratios that were asked for, by name: `weight`, where there is gravity, and `bending`."""

    @property
    def refused(self) -> dict[str, str]:
        """Return the reason for each quantity that is not identified; the membrane stiffness itself never is."""
        why = {name: ratio.refused for name, ratio in self.ratios.items() if ratio.refused is not None}
        return why | {"membrane stiffness": WHY_NO_MEMBRANE_STIFFNESS}

    @property
    def declaration(self) -> Declaration:
        """Return the declaration with every reliable ratio applied; the weight stays as declared."""
        known = {name: ratio.factor for name, ratio in self.ratios.items() if ratio.factor is not None}
        return replace(
            self.declared,
            membrane_stiffness=self.declared.membrane_stiffness / known.get("weight", 1.0),
            thickness=self.declared.thickness * known.get("bending", 1.0) ** 0.5,
        )


def check_ratios(names: Iterable[str]) -> None:
    """Refuse names that no ratio has.

    Raises:
        OptionError: there is one, with the likeliest known name.
    """
    for name in names:
        if name not in RATIOS:
            near = did_you_mean(name, RATIOS)
            raise OptionError(f"parameter {quoted(name)}: only {' and '.join(RATIOS)} can be identified{near}")


def material(
    declared: Declaration,
    factors: dict[str, float],
    log_sd: dict[str, float],
    trades_with: dict[str, tuple[str, float]],
    *,
    converged: bool,
) -> Material:
    """Return the identified material; a factor that is not known to a factor of two is refused.

    Args:
        declared: the declaration that the factors are relative to.
        factors: factors of `weight` and `bending`, as far as they were asked for.
        log_sd: standard errors of their logarithms.
        trades_with: what each trades with most, and the size of the correlation.
        converged: whether the search converged.
    """
    k = declared.membrane_stiffness
    declared_ratios = {
        "weight": (declared.areal_density * float(np.linalg.norm(declared.gravity)) / k, "1/m"),
        "bending": (declared.thickness**2 / (12 * (1 - declared.poisson**2)), "m^2"),
    }
    ratios = {}
    for name, factor in factors.items():
        refused = _refusal(log_sd[name], *trades_with[name], converged=converged)
        ratios[name] = Ratio(
            declared=declared_ratios[name][0],
            unit=declared_ratios[name][1],
            factor=factor if refused is None else None,
            log_sd=log_sd[name],
            refused=refused,
            trades_with=trades_with[name][0],
            correlation=trades_with[name][1],
        )
    return Material(declared=declared, ratios=ratios)


def _refusal(log_sd: float, trades_with: str, correlation: float, *, converged: bool) -> str | None:
    if not converged:
        return "the search did not converge"
    if log_sd < MAX_LOG_SD:
        return None
    if log_sd >= UNKNOWN_LOG_SD:
        why = "these frames hold no evidence about it"
    else:
        why = f"these frames give it to a factor of {np.exp(2 * log_sd):.2g} either way (two standard errors)"
    if correlation >= TRADES_ABOVE:
        why += f", as a change of it looks like one of {_named(trades_with)} (correlation {correlation:.2f})"
    return f"{why}; lift further, so that more of the sheet hangs"


def _named(quantity: str) -> str:
    return f"the {quantity}" if quantity in ("weight", "bending") else quantity
