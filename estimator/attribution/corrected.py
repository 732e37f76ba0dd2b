"""The corrected model as a declaration: what was declared, with the effects that closing the loop has added."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from jiggle_mj.observation import Declaration

from ..effects import Effect
from .close_loop import Closed
from .gauss_newton import MAX_EFFECT


@dataclass(frozen=True, kw_only=True)
class CorrectedParameter:
    """Parameters of one effect at one site, in the effect's units."""

    effect: Effect
    """The effect."""
    nominal: tuple[float, ...]
    """Declared values, which the fit started from."""
    value: tuple[float, ...]
    """Values with what was found."""
    min_value: tuple[float, ...]
    """Lower bounds of the fit."""
    max_value: tuple[float, ...]
    """Upper bounds of the fit."""


def corrected_parameters(closed: Closed, declaration: Declaration) -> dict[str, CorrectedParameter]:
    """Return the effects that were added, by the name that a declaration gives them."""
    return dict(
        corrected_parameter(one.effect, one.score.site, closed.final.theta(one), declaration)
        for one in closed.final.added
    )


def corrected_parameter(
    effect: Effect, site: int, theta: Float[np.ndarray, " p"], declaration: Declaration
) -> tuple[str, CorrectedParameter]:
    """Return the name that a declaration gives an effect at a site, and its parameters with theta added to them."""
    reach = MAX_EFFECT * np.asarray(effect.prior_sds[site])
    name = effect.name if effect.sites == 1 else f"{effect.name}.{site}"
    nominal = np.asarray(declaration.effects.get(name, np.zeros(len(effect.prior_sd))))
    lowest = nominal - reach
    return name, CorrectedParameter(
        effect=effect,
        nominal=tuple(nominal.tolist()),
        value=tuple((nominal + theta).tolist()),
        min_value=tuple((np.maximum(lowest, 0) if effect.non_negative else lowest).tolist()),
        max_value=tuple((nominal + reach).tolist()),
    )


def corrected_declaration(parameters: dict[str, CorrectedParameter], declaration: Declaration) -> Declaration:
    """Return the declaration with the effects that were added."""
    return replace(declaration, effects={**declaration.effects, **{key: one.value for key, one in parameters.items()}})
