"""The sheet's parameters that positions identify: weight and bending stiffness relative to the membrane stiffness.

Scaling every stiffness and every force by one factor moves nothing. So the membrane stiffness is the unit, and each
other parameter is a factor on its declared value.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .bending import IsometricBending
from .energy import SheetEnergy, Term
from .environment import BedContact, Weight


def ratios(energy: SheetEnergy) -> tuple[str, ...]:
    """Return the names of the ratios that the sheet has; without gravity it has no weight."""
    return ("weight", "bending") if any(isinstance(term, Weight) for term in energy.terms) else ("bending",)


def scaled(energy: SheetEnergy, log_factor: Float[Array, " k"]) -> SheetEnergy:
    """Return the energy with each of its `ratios` multiplied by a factor, given by its logarithm; differentiable.

    The bed supports the new weight in the same shape in which it supported the old one.
    """
    factor = dict(zip(ratios(energy), jnp.exp(log_factor), strict=True))

    def scale(term: Term) -> Term:
        if isinstance(term, Weight):
            return eqx.tree_at(lambda t: t.mass, term, factor["weight"] * term.mass)
        if isinstance(term, BedContact):
            rest = energy.rest @ term.up
            return eqx.tree_at(lambda t: t.height, term, rest + factor["weight"] * (term.height - rest))
        if isinstance(term, IsometricBending):
            root = jnp.sqrt(factor["bending"])
            return eqx.tree_at(lambda t: (t.weight, t.curvature), term, (root * term.weight, root * term.curvature))
        return term

    return eqx.tree_at(lambda e: e.terms, energy, tuple(scale(term) for term in energy.terms))
