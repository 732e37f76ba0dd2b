"""The sheet's own parameters that positions can tell: the weight and the bending stiffness relative to the membrane's.

Scaling every stiffness and every force by one factor moves nothing. So the membrane is the unit, and each of the others
is a factor on what was declared.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .bending import IsometricBending
from .energy import SheetEnergy, Term
from .environment import BedContact, Weight


def ratios(energy: SheetEnergy) -> tuple[str, ...]:
    """Those that the sheet has at all; without gravity there is no weight."""
    return ("weight", "bending") if any(isinstance(term, Weight) for term in energy.terms) else ("bending",)


def scaled(energy: SheetEnergy, log_factor: Float[Array, " k"]) -> SheetEnergy:
    """The energy with each of its `ratios` times a factor, given as its logarithm; differentiable.

    The bed carries the new weight where it carried the old one.
    """
    factor = dict(zip(ratios(energy), jnp.exp(log_factor), strict=True))

    def one(term: Term) -> Term:
        if isinstance(term, Weight):
            return eqx.tree_at(lambda t: t.mass, term, factor["weight"] * term.mass)
        if isinstance(term, BedContact):
            rest = energy.rest @ term.up
            return eqx.tree_at(lambda t: t.height, term, rest + factor["weight"] * (term.height - rest))
        if isinstance(term, IsometricBending):
            root = jnp.sqrt(factor["bending"])
            return eqx.tree_at(lambda t: (t.weight, t.curvature), term, (root * term.weight, root * term.curvature))
        return term

    return eqx.tree_at(lambda e: e.terms, energy, tuple(one(term) for term in energy.terms))
