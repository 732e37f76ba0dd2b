"""The material ratios that a recording identifies, and those that it does not."""

from dataclasses import dataclass, replace

import numpy as np

from .observation import Declaration

MAX_LOG_SD = np.log(2) / 2
"""Standard error of a factor's logarithm from which on it is refused: two of them are a factor of two either way."""
WHY_NO_MEMBRANE_STIFFNESS = (
    "positions alone give only ratios: one factor on every stiffness and on the weight changes no position. "
    "Weigh the tissue: the ratio of weight to membrane stiffness then gives the latter. Or measure one force"
)
"""Reason why the membrane stiffness itself is never identified."""
MAX_LOG_FACTOR = 7.0
"""Largest logarithm of an uncertainty that is printed, a factor of 1100: more says nothing further."""


@dataclass(frozen=True, kw_only=True)
class Ratio:
    """Ratio of the weight or of the bending stiffness to the membrane stiffness."""

    declared: float
    """Ratio of the declared values [unit]."""
    unit: str
    """Unit of the ratio."""
    factor: float
    """Identified ratio over the declared one."""
    log_sd: float
    """Standard error of the factor's logarithm: about its relative error, where the model is right."""
    refused: str | None
    """Reason why the factor is unreliable; None where it is reliable."""


@dataclass(frozen=True, kw_only=True)
class Material:
    """Identified material of one sheet."""

    declared: Declaration
    """What the user declared."""
    ratios: dict[str, Ratio]
    """Ratios by name: `bending`, and `weight` where there is gravity."""

    @property
    def refused(self) -> dict[str, str]:
        """Return the reason for each quantity that is not identified; the membrane stiffness itself never is."""
        why = {name: ratio.refused for name, ratio in self.ratios.items() if ratio.refused is not None}
        return why | {"membrane stiffness": WHY_NO_MEMBRANE_STIFFNESS}

    @property
    def declaration(self) -> Declaration:
        """Return the declaration with every reliable ratio applied; the weight stays as declared."""
        known = {name: ratio.factor for name, ratio in self.ratios.items() if ratio.refused is None}
        return replace(
            self.declared,
            membrane_stiffness=self.declared.membrane_stiffness / known.get("weight", 1.0),
            thickness=self.declared.thickness * known.get("bending", 1.0) ** 0.5,
        )


def material(
    declared: Declaration, factors: dict[str, float], log_sd: dict[str, float], *, converged: bool
) -> Material:
    """Return the identified material; a factor that is not known to a factor of two is refused.

    Args:
        declared: the declaration that the factors are relative to.
        factors: factors of `weight` and `bending`, as far as the sheet has them.
        log_sd: standard errors of their logarithms.
        converged: whether the search converged.
    """
    k = declared.membrane_stiffness
    declared_ratios = {
        "weight": (declared.areal_density * float(np.linalg.norm(declared.gravity)) / k, "1/m"),
        "bending": (declared.thickness**2 / (12 * (1 - declared.poisson**2)), "m^2"),
    }
    ratios = {
        name: Ratio(
            declared=declared_ratios[name][0],
            unit=declared_ratios[name][1],
            factor=factor,
            log_sd=log_sd[name],
            refused=_refusal(log_sd[name], converged=converged),
        )
        for name, factor in factors.items()
    }
    return Material(declared=declared, ratios=ratios)


def _refusal(log_sd: float, *, converged: bool) -> str | None:
    if not converged:
        return "the search did not converge"
    if log_sd < MAX_LOG_SD:
        return None
    return (
        f"these frames give it to a factor of {np.exp(min(2 * log_sd, MAX_LOG_FACTOR)):.2g} either way (two standard "
        "errors); lift further, so that more of the sheet hangs"
    )
