"""Effects that depend on earlier states of the sheet: friction, drag, damping, creep, inertia."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics.bending import IsometricBending
from ..physics.environment import BedContact, Weight
from ..physics.membrane import TriangleMembrane
from .effect import Effect
from .sheet_model import FrameContext, SheetModel
from .terms import FrictionElements


def _friction(model: SheetModel, theta: Float[Array, " 1"], context: FrameContext) -> SheetModel:
    """Add Coulomb friction on the bed; the pressing force is that of the frame's state as known so far."""
    if not model.has(BedContact):  # a sheet in the air
        return model
    bed, friction = model.term(BedContact), model.term(FrictionElements)
    pressed = bed.gradient(context.now[:, None])[:, 0] @ -bed.up
    changed = (context.before, theta[0] * pressed, bed.up)
    return model.with_term(eqx.tree_at(lambda t: (t.start, t.resisted, t.up), friction, changed))


def _viscous_drag(model: SheetModel, theta: Float[Array, " 1"], context: FrameContext) -> SheetModel:
    """Add a force against each particle's own velocity, theta k v."""
    k = model.term(TriangleMembrane).stiffness
    return model.tethered(context.before, jnp.full(len(context.rest), theta[0] * k / context.gap))


def _inertia(model: SheetModel, theta: Float[Array, " 2"], context: FrameContext) -> SheetModel:
    """Add inertia by a step of implicit Euler: each mass continues with its damped velocity.

    theta: the share of the mass that acts, and the rate at which the velocity decays [1/s].
    """
    mass = model.term(Weight).mass
    velocity = (context.before - context.earlier) / context.earlier_gap
    decay = jnp.exp(-theta[1] * context.gap)
    free_motion = context.before + context.gap * decay * velocity
    return model.tethered(free_motion, theta[0] * mass / context.gap**2)


def _material_damping(model: SheetModel, theta: Float[Array, " 1"], context: FrameContext) -> SheetModel:
    """Add Kelvin-Voigt damping, stress C (E + theta dE/dt), of stretching and of bending.

    It takes all to have settled in the frame before. A hinge that is stretched within its plane becomes stiffer,
    without memory.
    """
    lag = context.lag_share(theta[0])
    more = lag / (1 - lag)
    membrane, bending = model.term(TriangleMembrane), model.term(IsometricBending)
    strain = membrane.strain(context.before[membrane.vertices])
    stiffer = (1 + more) * membrane.elasticity, (membrane.inelastic + more * strain) / (1 + more)
    stretched = model.with_term(eqx.tree_at(lambda t: (t.elasticity, t.inelastic), membrane, stiffer))
    bent = (bending.curvature + more * bending.curvature_at(context.before[bending.vertices])) / (1 + more)
    weighted = jnp.sqrt(1 + more) * bending.weight, jnp.sqrt(1 + more) * bent
    return stretched.with_term(eqx.tree_at(lambda t: (t.weight, t.curvature), bending, weighted))


def _tissue_creep(model: SheetModel, theta: Float[Array, " 1"], context: FrameContext) -> SheetModel:
    """Let the unstressed strain follow the strain at the rate theta [1/s]."""
    membrane = model.term(TriangleMembrane)
    strains = jax.vmap(lambda x: membrane.strain(x[membrane.vertices]))(context.past)
    crept = jnp.einsum("t,tfp->fp", context.memory_weights(theta[0]), strains)
    return model.with_term(eqx.tree_at(lambda t: t.inelastic, membrane, membrane.inelastic + crept))


def _anchor_creep(model: SheetModel, theta: Float[Array, " 1"], context: FrameContext) -> SheetModel:
    """Let the anchors follow what they hold at the rate theta [1/s]."""
    crept = jnp.einsum("t,tni->ni", context.memory_weights(theta[0]), context.past - context.rest[None])
    return eqx.tree_at(lambda m: m.energy.rest, model, model.energy.rest + crept)


HISTORY_DEPENDENT = (
    Effect(
        name="friction",
        acts=_friction,
        units=("",),
        prior_sd=(0.3,),
        source="wet bowel 0.01 to 0.05, muscle 0.3",
        confounded_with=("tissue_creep", "attachments"),
        initial_guesses=((0.3,),),  # at 0 its nuisance parameter takes its place
        non_negative=True,
    ),
    Effect(
        name="viscous_drag",
        acts=_viscous_drag,
        units=("s",),
        prior_sd=(1e-3,),
        source="water around a sheet of 10 cm at 10 cm/s pulls with a hundredth of its stiffness",
        confounded_with=("material_damping", "image_latency", "inertia"),
        non_negative=True,
    ),
    Effect(
        name="inertia",
        acts=_inertia,
        units=("", "1/s"),
        prior_sd=(1.0, 5.0),
        initial_guesses=((1.0, 2.0),),
        source="the sheet's own mass; a cloth in air swings for a second",
        confounded_with=("viscous_drag", "image_latency", "swing"),
        non_negative=True,
    ),
    Effect(
        name="tissue_creep",
        acts=_tissue_creep,
        units=("1/s",),
        prior_sd=(0.3,),
        source="skin loses half of its stress within the first second, and creeps for minutes",
        confounded_with=("material_damping", "friction", "tissue_yield"),
        non_negative=True,
        history_dependent=True,
    ),
    Effect(
        name="anchor_creep",
        acts=_anchor_creep,
        units=("1/s",),
        prior_sd=(0.3,),
        source="loose fascia gives within seconds",
        confounded_with=("attachments", "tissue_creep", "substrate"),
        non_negative=True,
        history_dependent=True,
    ),
    Effect(
        name="material_damping",
        acts=_material_damping,
        units=("s",),
        prior_sd=(0.2,),
        initial_guesses=((0.2,),),
        source="skin relaxes within 0.1 to 0.3 s",
        confounded_with=("viscous_drag", "tissue_creep", "image_latency"),
        non_negative=True,
    ),
)
