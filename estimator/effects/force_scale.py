"""The scale of all forces, which only a measured force of the tool shows.

Multiply every stiffness and weight by one factor, and nothing that a camera sees changes.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .effect import Effect
from .sheet_model import FrameContext, SheetModel


def _force_scale(model: SheetModel, theta: Float[Array, " 1"], context: FrameContext) -> SheetModel:
    """Multiply the force of the tool by exp(theta)."""
    return eqx.tree_at(lambda m: m.force_factor, model, model.force_factor * jnp.exp(theta[0]))


FORCE_SCALE = (
    Effect(
        name="force_scale",
        acts=_force_scale,
        units=("log factor",),
        prior_sd=(0.7,),
        initial_guesses=((0.7,), (-0.7,)),  # at 0 stiffer or softer attachments take its place
        source="Young's modulus of skin differs between samples by factors of 2 to 5",
        confounded_with=("stretch", "attachments"),
        needs_force=True,
    ),
)
