"""The sheet's parameters that positions identify: weight and bending stiffness relative to the membrane stiffness.

Scaling every stiffness and every force by one factor moves nothing. So the membrane stiffness is the unit, and each
other parameter is a factor on its declared value.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jiggle_mj.errors import OptionError
from jiggle_mj.material import RATIOS, check_ratios

from .bending import IsometricBending
from .energy import SheetEnergy, Term
from .environment import BedContact, Weight


def ratios(energy: SheetEnergy) -> tuple[str, ...]:
    """Return the names of the ratios that the sheet has; without gravity it has no weight."""
    has_weight = any(isinstance(term, Weight) for term in energy.terms)
    return tuple(name for name in RATIOS if has_weight or name != "weight")


def chosen(energy: SheetEnergy, names: Sequence[str]) -> tuple[str, ...]:
    """Return those of the sheet's ratios that are named, in the order of `ratios`; all of them where none is named.

    Raises:
        OptionError: the sheet has no ratio of a name.
    """
    check_ratios(names)
    known = ratios(energy)
    if absent := set(names) - set(known):
        raise OptionError(f"parameter '{min(absent)}': without gravity the sheet has none; leave it out.")
    return tuple(name for name in known if name in names) if names else known


def scaled(energy: SheetEnergy, log_factor: Float[Array, " k"], names: Sequence[str] | None = None) -> SheetEnergy:
    """Return the energy with some of its `ratios` multiplied by a factor, given by its logarithm; differentiable.

    The bed supports the new weight in the same shape in which it supported the old one.

    Args:
        energy: of the sheet.
        log_factor: logarithm of each factor [nat].
        names: the ratios that the factors are of; all of `ratios` if None.
    """
    names = ratios(energy) if names is None else names
    factor = dict.fromkeys(ratios(energy), jnp.ones((), log_factor.dtype))
    factor |= dict(zip(names, jnp.exp(log_factor), strict=True))

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
