"""Effects that depend on where the sheet was: friction, drag, damping, creep, inertia."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics.bending import IsometricBending
from ..physics.environment import BedContact, Tether, Weight
from ..physics.membrane import TriangleMembrane
from .effect import Effect
from .sheet_model import FrameContext, SheetModel
from .terms import DeadLoad, FrictionElements


def _friction(model: SheetModel, theta: Float[Array, " 1"], moment: FrameContext) -> SheetModel:
    """Coulomb's, with what the bed carries of the frame as far as it is known."""
    if not model.has(BedContact):  # a sheet in the air
        return model
    bed, rub = model.term(BedContact), model.term(FrictionElements)
    pressed = bed.gradient(moment.now[:, None])[:, 0] @ -bed.up
    changed = (moment.before, theta[0] * pressed, bed.up)
    return model.with_term(eqx.tree_at(lambda t: (t.start, t.resisted, t.up), rub, changed))


def _viscous_drag(model: SheetModel, theta: Float[Array, " 1"], moment: FrameContext) -> SheetModel:
    """A force against each particle's own velocity: theta k v."""
    k = model.term(TriangleMembrane).stiffness
    return _tethered(model, moment.before, jnp.full(len(moment.rest), theta[0] * k / moment.gap))


def _inertia(model: SheetModel, theta: Float[Array, " 2"], moment: FrameContext) -> SheetModel:
    """Each particle's mass goes on as it went, the slower the more it is damped: a step of implicit Euler.

    theta: the share of the mass that the frames show, and how much of the speed is lost in a second.
    """
    mass = model.term(Weight).mass
    speed = (moment.before - moment.earlier) / moment.earlier_gap
    kept = jnp.exp(-theta[1] * moment.gap)
    there = moment.before + moment.gap * kept * speed
    return _tethered(model, there, theta[0] * mass / moment.gap**2)


def _material_damping(model: SheetModel, theta: Float[Array, " 1"], moment: FrameContext) -> SheetModel:
    """Kelvin and Voigt's: stress C (E + theta dE/dt), of stretching and of bending, after what changes either.

    As if all had settled in the frame before; a hinge that is stretched within its plane is stiffer, without memory.
    """
    left = moment.left_behind(theta[0])
    more = left / (1 - left)
    membrane, bending = model.term(TriangleMembrane), model.term(IsometricBending)
    strain = membrane.strain(moment.before[membrane.vertices])
    stiffer = (1 + more) * membrane.elasticity, (membrane.inelastic + more * strain) / (1 + more)
    stretched = model.with_term(eqx.tree_at(lambda t: (t.elasticity, t.inelastic), membrane, stiffer))
    bent = (bending.curvature + more * bending.bent(moment.before[bending.vertices])) / (1 + more)
    weighed = jnp.sqrt(1 + more) * bending.weight, jnp.sqrt(1 + more) * bent
    return stretched.with_term(eqx.tree_at(lambda t: (t.weight, t.curvature), bending, weighed))


def _tissue_creep(model: SheetModel, theta: Float[Array, " 1"], moment: FrameContext) -> SheetModel:
    """The unstressed strain follows the strain at a rate."""
    membrane = model.term(TriangleMembrane)
    strains = jax.vmap(lambda x: membrane.strain(x[membrane.vertices]))(moment.past)
    crept = jnp.einsum("t,tfp->fp", moment.faded(theta[0]), strains)
    return model.with_term(eqx.tree_at(lambda t: t.inelastic, membrane, membrane.inelastic + crept))


def _anchor_creep(model: SheetModel, theta: Float[Array, " 1"], moment: FrameContext) -> SheetModel:
    """Anchors follow what they hold at a rate."""
    crept = jnp.einsum("t,tni->ni", moment.faded(theta[0]), moment.past - moment.rest[None])
    return eqx.tree_at(lambda one: one.energy.rest, model, model.energy.rest + crept)


def _tethered(model: SheetModel, to: Float[Array, "n 3"], stiffness: Float[Array, " n"]) -> SheetModel:
    """With one more spring on each particle: towards where the tether is, and a load that takes it on to `to`."""
    tether, load = model.term(Tether), model.term(DeadLoad)
    stiffer = tether.stiffness + stiffness[:, None, None] * jnp.eye(3, dtype=to.dtype)[None]
    pulled = load.force + stiffness[:, None] * (to - tether.to)
    sprung = model.with_term(eqx.tree_at(lambda t: t.stiffness, tether, stiffer))
    return sprung.with_term(eqx.tree_at(lambda t: t.force, load, pulled))


MEMORY = (
    Effect(
        name="friction",
        acts=_friction,
        units=("",),
        prior_sd=(0.3,),
        source="wet bowel 0.01 to 0.05, muscle 0.3",
        confounded_with=("tissue_creep", "attachments"),
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
        confounded_with=("material_damping", "friction"),
        non_negative=True,
        history_dependent=True,
    ),
    Effect(
        name="anchor_creep",
        acts=_anchor_creep,
        units=("1/s",),
        prior_sd=(0.3,),
        source="loose fascia gives within seconds",
        confounded_with=("attachments", "tissue_creep"),
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
