"""Effects of what is under the sheet: tissue that ties all of it down, and a base that gives way under the anchors."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..physics.membrane import TriangleMembrane
from .effect import Effect
from .sheet_model import FrameContext, SheetModel, particle_areas


def _tethering(model: SheetModel, theta: Float[Array, " 1"], context: FrameContext) -> SheetModel:
    """Tie all of the sheet to its rest shape by theta [N/m per m^2]: a Winkler foundation, theta |x - rest|^2 / 2."""
    return model.tethered(context.rest, theta[0] * particle_areas(model.term(TriangleMembrane), len(context.rest)))


def _substrate(model: SheetModel, theta: Float[Array, " 1"], context: FrameContext) -> SheetModel:
    """Let the attachment loads move each other's anchors, by the shear compliance theta [1/Pa] of the base.

    The load is that of the frame's state as known so far. How far a load moves its own anchor is part of the softness
    of the attachment, and left out.
    """
    load = _attachment_loads(model, context)
    return eqx.tree_at(lambda m: m.energy.rest, model, model.energy.rest + theta[0] * _half_space(context.rest, load))


def _attachment_loads(model: SheetModel, context: FrameContext) -> Float[Array, "n 3"]:
    """Return what the attachments carry [N], from the balance of forces on each particle of the frame's state.

    At equilibrium all other forces on a particle add up to it. Where they do not point away from the particle's rest
    position, it is the jaws that balance them.
    """
    load = -model.energy.internal_gradient(context.now)
    outward = jnp.sum(load * (context.now - context.rest), axis=1) > 0
    return jax.lax.stop_gradient(jnp.where(outward[:, None], load, 0.0))


def _half_space(rest: Float[Array, "n 3"], load: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Return the displacement of each particle's anchor by the loads on the others, times the shear modulus [N/m].

    An incompressible elastic half-space with a force F on its surface moves at a distance r, which is along the unit
    vector e, by (F + e (e . F)) / (4 pi G r) [Boussinesq and Cerruti; Johnson 1985, Contact Mechanics, section 3.6].
    """
    square = sum((r[:, None] - r[None]) ** 2 for r in rest.T)
    nearness = jnp.where(square > 0, 1 / jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
    along = nearness**3 * (rest @ load.T - jnp.sum(rest * load, axis=1)[None])
    return (nearness @ load + jnp.sum(along, axis=1)[:, None] * rest - along @ rest) / (4 * np.pi)


FOUNDATION = (
    Effect(
        name="tethering",
        acts=_tethering,
        units=("N/m^3",),
        prior_sd=(1e5,),
        initial_guesses=((3e3,),),  # at 0 attachments of all particles take its place
        source="fat of 0.75 kPa in shear under skin, a centimetre thick",
        confounded_with=("adhesion", "attachments"),
        non_negative=True,
    ),
    Effect(
        name="substrate",
        acts=_substrate,
        units=("1/Pa",),
        prior_sd=(3e-3,),
        source="fat has 0.75 kPa in shear, loose tissue less",
        confounded_with=("anchor_creep", "anchor_yield", "attachments"),
        non_negative=True,
        history_dependent=True,
    ),
)
