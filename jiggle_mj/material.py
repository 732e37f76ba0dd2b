"""What a recording tells of the sheet itself, and what it cannot tell."""

from dataclasses import dataclass, replace

import numpy as np

from .observation import Declaration

DOUBTFUL = np.log(2) / 2
"""Standard error of a logarithm from which on nothing is stated: two of them are a factor of two either way."""
STRETCH = (
    "positions alone know only ratios: with every stiffness and the weight times one factor, nothing moves otherwise. "
    "Weigh the tissue: the ratio of weight to membrane stiffness then gives the latter. Or measure one force"
)
"""Why the membrane stiffness itself is never stated."""


@dataclass(frozen=True, kw_only=True)
class Ratio:
    """The weight or the bending stiffness over the membrane stiffness."""

    declared: float
    """[unit]."""
    unit: str
    factor: float
    """Times what was declared."""
    log_sd: float
    """Standard error of the factor's logarithm: about its relative error, where the model is right."""
    refused: str | None
    """Why it is not to be relied on; None where it may be."""


@dataclass(frozen=True, kw_only=True)
class Material:
    """What was found of one sheet."""

    declared: Declaration
    ratios: dict[str, Ratio]
    """By name, `weight` (where there is any) and `bending`."""

    @property
    def refused(self) -> dict[str, str]:
        """Why what is not identified is not; the membrane stiffness itself never is."""
        why = {name: ratio.refused for name, ratio in self.ratios.items() if ratio.refused is not None}
        return why | {"membrane stiffness": STRETCH}

    @property
    def declaration(self) -> Declaration:
        """What was declared, with every ratio that is not refused; the weight is taken to be as declared."""
        known = {name: ratio.factor for name, ratio in self.ratios.items() if ratio.refused is None}
        return replace(
            self.declared,
            membrane_stiffness=self.declared.membrane_stiffness / known.get("weight", 1.0),
            thickness=self.declared.thickness * known.get("bending", 1.0) ** 0.5,
        )


def material(
    declared: Declaration, factors: dict[str, float], log_sd: dict[str, float], *, converged: bool
) -> Material:
    """Factors on what was declared, refused where they are not known to a factor of two.

    Args:
        declared: what they are relative to.
        factors: of `weight` and `bending`, as far as the sheet has them.
        log_sd: standard errors of their logarithms.
        converged: whether the search came to rest.
    """
    k = declared.membrane_stiffness
    of = {
        "weight": (declared.areal_density * float(np.linalg.norm(declared.gravity)) / k, "1/m"),
        "bending": (declared.thickness**2 / (12 * (1 - declared.poisson**2)), "m^2"),
    }
    ratios = {
        name: Ratio(
            declared=of[name][0],
            unit=of[name][1],
            factor=factor,
            log_sd=log_sd[name],
            refused=_refusal(log_sd[name], converged=converged),
        )
        for name, factor in factors.items()
    }
    return Material(declared=declared, ratios=ratios)


def _refusal(log_sd: float, *, converged: bool) -> str | None:
    if not converged:
        return "the search did not come to rest"
    if log_sd < DOUBTFUL:
        return None
    return (
        f"these frames know it to a factor of {np.exp(min(2 * log_sd, 7)):.2g} either way (two standard errors); lift "
        "further, so that more of the sheet hangs"
    )
