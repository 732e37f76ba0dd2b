"""Effects of the tissue and of what it lies on that depend on the current state of the sheet alone."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..physics.bending import IsometricBending
from ..physics.environment import BedContact, Weight
from ..physics.hanging import Tension
from ..physics.membrane import TriangleMembrane, plane_stress
from .effect import Effect
from .sheet_model import FrameContext, SheetModel, extent, material_coordinates, particle_areas
from .terms import AdhesionFilm, DeadLoad

STANDARD_GRAVITY = 9.80665
"""Standard acceleration of gravity [m/s^2]; CODATA's g_n."""
MODES = 4
"""Cosines along each side of the sheet by which its stiffness may vary."""
GRID = 6
"""Places along each side of the sheet where a spot may be."""
SPOT_WIDTH = 0.75
"""Standard deviation of a spot, in distances of neighbouring ones: wide enough that the spots overlap a little."""
ANGLES = 12
"""Directions of fibres, evenly over half a turn."""
LOWEST_MODE_SD = 0.6
"""Prior standard deviation of the lowest modes of the stiffness [log factor]: about half a factor of e."""


def flat(membrane: TriangleMembrane, rest: Float[Array, "n 3"], x: Float[Array, "m 3"]) -> Float[Array, "m 2"]:
    """Return the coordinates of positions x [m] along the sheet's two material axes, from 0 to 1 over its extent."""
    low, high = extent(material_coordinates(membrane, rest, rest))
    return (material_coordinates(membrane, rest, x) - low) / (high - low)


def spots(place: Float[Array, "m 2"]) -> Float[Array, "m spots"]:
    """Return the value of each spot of a grid of round, slightly overlapping spots, at places from 0 to 1."""
    middle = jnp.asarray((np.arange(GRID) + 0.5) / GRID)
    near = jnp.exp(-0.5 * ((place[:, :, None] - middle[None, None]) * GRID / SPOT_WIDTH) ** 2)
    return (near[:, 0, :, None] * near[:, 1, None, :]).reshape(len(place), GRID**2)


def cosines(place: Float[Array, "m 2"], waves: int) -> Float[Array, "m modes"]:
    """Return the products of cosines along the two axes, `waves` along each, the constant first."""
    wave = jnp.cos(np.pi * jnp.arange(float(waves))[None, :, None] * place[:, None, :])
    return (wave[:, :, None, 0] * wave[:, None, :, 1]).reshape(len(place), waves**2)


def _gravity(model: SheetModel, theta: Float[Array, " 3"], context: FrameContext) -> SheetModel:
    """Add theta [g] to gravity; the pre-stress of a hanging sheet grows with the gravity along its own."""
    weight = model.term(Weight)
    gravity = weight.gravity + STANDARD_GRAVITY * theta
    changed = model.with_term(eqx.tree_at(lambda t: t.gravity, weight, gravity))
    if not model.has(Tension):
        return changed
    tension, share = model.term(Tension), gravity @ weight.gravity / jnp.sum(weight.gravity**2)
    return changed.with_term(eqx.tree_at(lambda t: t.stress, tension, share * tension.stress))


def _bed(model: SheetModel, theta: Float[Array, " 3"], context: FrameContext) -> SheetModel:
    """Raise the bed by theta[0] [m], and tilt it along x and y by theta[1:] [rad]."""
    if not model.has(BedContact):  # a sheet in the air
        return model
    bed, level = model.term(BedContact), context.rest - jnp.mean(context.rest, axis=0)[None]
    raised = theta[0] + level[:, 0] * theta[1] + level[:, 1] * theta[2]
    return model.with_term(eqx.tree_at(lambda t: t.height, bed, bed.height + raised))


def _stretch(model: SheetModel, theta: Float[Array, " 1"], context: FrameContext) -> SheetModel:
    """Multiply the membrane's stiffness by exp(theta)."""
    return _stiffer(model, jnp.exp(theta[0]))


def _poisson(model: SheetModel, theta: Float[Array, " 1"], context: FrameContext) -> SheetModel:
    """Add theta to Poisson's ratio at the same Young's modulus."""
    membrane = model.term(TriangleMembrane)
    change = membrane.stiffness * (plane_stress(membrane.poisson + theta[0]) - plane_stress(membrane.poisson))
    return _with_elasticity(model, membrane.elasticity + change[None])


def _bending(model: SheetModel, theta: Float[Array, " 1"], context: FrameContext) -> SheetModel:
    """Multiply the bending stiffness by exp(theta)."""
    bending, root = model.term(IsometricBending), jnp.exp(theta[0] / 2)
    changed = eqx.tree_at(lambda t: (t.weight, t.curvature), bending, (root * bending.weight, root * bending.curvature))
    return model.with_term(changed)


def _heterogeneity(model: SheetModel, theta: Float[Array, " modes"], context: FrameContext) -> SheetModel:
    """Multiply the membrane's stiffness by the exponential of a smooth field."""
    return _stiffer(model, jnp.exp(cosines(_places(model, context), MODES) @ theta)[:, None, None])


def _inclusion(model: SheetModel, theta: Float[Array, " spots"], context: FrameContext) -> SheetModel:
    """Multiply the membrane's stiffness by the exponential of round spots."""
    return _stiffer(model, jnp.exp(spots(_places(model, context)) @ theta)[:, None, None])


def _anisotropy(model: SheetModel, theta: Float[Array, " angles"], context: FrameContext) -> SheetModel:
    """Add fibres of strength a along n, whose energy per area is a k (n.E n)^2 / 2."""
    membrane, angle = model.term(TriangleMembrane), jnp.asarray(np.pi * np.arange(ANGLES) / ANGLES)
    along = jnp.stack([jnp.cos(angle) ** 2, jnp.sin(angle) ** 2, jnp.cos(angle) * jnp.sin(angle)], axis=1)
    fibres = membrane.stiffness * jnp.einsum("a,ap,aq->pq", theta, along, along)
    return _with_elasticity(model, membrane.elasticity + fibres[None])


def _pre_strain(model: SheetModel, theta: Float[Array, " 3"], context: FrameContext) -> SheetModel:
    """Make the resting sheet longer by the strain theta than the stress-free one."""
    membrane = model.term(TriangleMembrane)
    longer = jnp.stack([theta[0], theta[1], 2 * theta[2]])
    return model.with_term(eqx.tree_at(lambda t: t.inelastic, membrane, membrane.inelastic - longer[None]))


def _strain_stiffening(model: SheetModel, theta: Float[Array, " 1"], context: FrameContext) -> SheetModel:
    """Add theta to the membrane's strain stiffening [1/strain^2]."""
    membrane = model.term(TriangleMembrane)
    return model.with_term(eqx.tree_at(lambda t: t.stiffening, membrane, membrane.stiffening + theta[0]))


def _anchor_shift(model: SheetModel, theta: Float[Array, " 3"], context: FrameContext) -> SheetModel:
    """Shift all anchors by theta [m]."""
    return eqx.tree_at(lambda m: m.energy.rest, model, model.energy.rest + theta[None])


def _point_pull(model: SheetModel, theta: Float[Array, " pulls"], context: FrameContext) -> SheetModel:
    """Add a force [N] at each spot, spread over its particles."""
    share = spots(flat(model.term(TriangleMembrane), context.rest, context.rest))
    share = share / jnp.maximum(jnp.sum(share, axis=0), 1.0)[None]
    load = model.term(DeadLoad)
    return model.with_term(eqx.tree_at(lambda t: t.force, load, load.force + share @ theta.reshape(GRID**2, 3)))


def _adhesion(model: SheetModel, theta: Float[Array, " 1"], context: FrameContext) -> SheetModel:
    """Add an adhesion film of work theta [J/m^2]."""
    film, membrane = model.term(AdhesionFilm), model.term(TriangleMembrane)
    work = film.work + theta[0] * particle_areas(membrane, len(context.rest))
    return model.with_term(eqx.tree_at(lambda t: t.work, film, work))


def _stiffer(model: SheetModel, factor: Float[Array, "*f"]) -> SheetModel:
    """Return the model with the membrane's stiffness multiplied."""
    return _with_elasticity(model, factor * model.term(TriangleMembrane).elasticity)


def _with_elasticity(model: SheetModel, elasticity: Float[Array, "f 3 3"]) -> SheetModel:
    return model.with_term(eqx.tree_at(lambda t: t.elasticity, model.term(TriangleMembrane), elasticity))


def _places(model: SheetModel, context: FrameContext) -> Float[Array, "f 2"]:
    """Return the coordinates of the triangles' centroids, from 0 to 1 over the sheet's extent."""
    membrane = model.term(TriangleMembrane)
    return flat(membrane, context.rest, jnp.mean(context.rest[membrane.vertices], axis=1))


def _mode_sds() -> tuple[float, ...]:
    """Return the prior standard deviations of the modes, which fall with the square of the wave number."""
    squared_wave_number = np.add.outer(np.arange(MODES) ** 2, np.arange(MODES) ** 2).ravel()
    return tuple(float(sd) for sd in LOWEST_MODE_SD / np.maximum(squared_wave_number, 1))


MECHANICAL = (
    Effect(
        name="gravity",
        acts=_gravity,
        units=("g", "g", "g"),
        prior_sd=(0.3, 0.3, 0.7),
        source="a table that leans by 20 degrees; a weight known to a factor of two",
        confounded_with=("bed", "anchor_shift", "stretch", "attachments"),
    ),
    Effect(
        name="bed",
        acts=_bed,
        units=("m", "rad", "rad"),
        prior_sd=(2e-3, 0.05, 0.05),
        source="a plane measured by stereo",
        confounded_with=("gravity", "camera_bias", "attachments"),
    ),
    Effect(
        name="poisson",
        acts=_poisson,
        units=("",),
        prior_sd=(0.15,),
        source="muscle across its fibres 0.36 and 0.65, rubber almost 0.5",
        confounded_with=("anisotropy", "stretch"),
    ),
    Effect(
        name="stretch",
        acts=_stretch,
        units=("log factor",),
        prior_sd=(0.7,),
        source="Young's modulus of skin differs between places by factors of 2 to 5",
        confounded_with=("bending", "gravity", "attachments"),
    ),
    Effect(
        name="bending",
        acts=_bending,
        units=("log factor",),
        prior_sd=(1.5,),
        source="of a layered sheet bending says little of stretching; thickness enters by its cube",
        confounded_with=("stretch",),
    ),
    Effect(
        name="heterogeneity",
        acts=_heterogeneity,
        units=("log factor",) * MODES**2,
        prior_sd=_mode_sds(),
        source="Young's modulus of skin differs between places by factors of 2 to 5",
        confounded_with=("inclusion", "anisotropy", "attachments"),
    ),
    Effect(
        name="inclusion",
        acts=_inclusion,
        units=("log factor",),
        prior_sd=(1.0,),
        sites=GRID**2,
        source="a tumour is several times stiffer than what is around it",
        confounded_with=("heterogeneity", "attachments"),
    ),
    Effect(
        name="anisotropy",
        acts=_anisotropy,
        units=("k",),
        prior_sd=(1.5,),
        sites=ANGLES,
        source="skin of a chicken's leg has 1.7 to 7.9 MPa, by direction and sample",
        confounded_with=("heterogeneity", "pre_strain", "poisson"),
    ),
    Effect(
        name="pre_strain",
        acts=_pre_strain,
        units=("", "", ""),
        prior_sd=(0.03, 0.03, 0.02),
        source="excised skin shrinks by 4 to 18 % in length",
        confounded_with=("anchor_shift", "depth_scale", "attachments"),
    ),
    Effect(
        name="strain_stiffening",
        acts=_strain_stiffening,
        units=("1/strain^2",),
        prior_sd=(200.0,),
        source="skin is tens of times stiffer at 30 % of strain than at first",
        confounded_with=("stretch", "tool_scale"),
    ),
    Effect(
        name="anchor_shift",
        acts=_anchor_shift,
        units=("m", "m", "m"),
        prior_sd=(2e-3, 2e-3, 2e-3),
        source="the bite of a suture",
        confounded_with=("camera_bias", "gravity", "pre_strain"),
    ),
    Effect(
        name="point_pull",
        acts=_point_pull,
        units=("N", "N", "N"),
        prior_sd=(0.01, 0.01, 0.01),
        sites=GRID**2,
        source="the weight of one gram",
        confounded_with=("anchor_shift", "attachments", "inclusion"),
    ),
    Effect(
        name="adhesion",
        acts=_adhesion,
        units=("J/m^2",),
        prior_sd=(0.1,),
        source="a film of water, twice its surface tension",
        confounded_with=("attachments", "tethering"),
        non_negative=True,
    ),
)
