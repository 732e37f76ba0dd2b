"""Effects of the tissue and of what it lies on that depend on where the sheet is, not on where it was."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..physics.bending import IsometricBending
from ..physics.environment import BedContact, Weight
from ..physics.hanging import Tension
from ..physics.membrane import TriangleMembrane, plane_stress
from .effect import Effect
from .sheet_model import FrameContext, SheetModel, across, extent
from .terms import AdhesionFilm, DeadLoad

STANDARD_GRAVITY = 9.80665
"""[m/s^2]."""
MODES = 4
"""Cosines along each side of the sheet that its stiffness may vary by."""
GRID = 6
"""Places along each side where a spot is looked for."""
ANGLES = 12
"""Directions in which fibres are looked for."""


def flat(membrane: TriangleMembrane, rest: Float[Array, "n 3"], x: Float[Array, "m 3"]) -> Float[Array, "m 2"]:
    """Places in the sheet along its two material axes, from 0 to 1 over its extent."""
    low, high = extent(across(membrane, rest, rest))
    return (across(membrane, rest, x) - low) / (high - low)


def spots(place: Float[Array, "m 2"]) -> Float[Array, "m spots"]:
    """How much of each of a grid of round spots, which overlap a little, is at each place."""
    middle = jnp.asarray((np.arange(GRID) + 0.5) / GRID)
    near = jnp.exp(-0.5 * ((place[:, :, None] - middle[None, None]) * GRID / 0.75) ** 2)
    return (near[:, 0, :, None] * near[:, 1, None, :]).reshape(len(place), GRID**2)


def cosines(place: Float[Array, "m 2"], waves: int) -> Float[Array, "m modes"]:
    """Products of cosines along the two axes, that many along each, the constant first."""
    wave = jnp.cos(np.pi * jnp.arange(float(waves))[None, :, None] * place[:, None, :])
    return (wave[:, :, None, 0] * wave[:, None, :, 1]).reshape(len(place), waves**2)


def _gravity(model: SheetModel, theta: Float[Array, " 3"], moment: FrameContext) -> SheetModel:
    weight = model.term(Weight)
    gravity = weight.gravity + STANDARD_GRAVITY * theta
    changed = model.with_term(eqx.tree_at(lambda t: t.gravity, weight, gravity))
    if not model.has(Tension):
        return changed
    tension, share = model.term(Tension), gravity @ weight.gravity / jnp.sum(weight.gravity**2)
    return changed.with_term(eqx.tree_at(lambda t: t.stress, tension, share * tension.stress))


def _bed(model: SheetModel, theta: Float[Array, " 3"], moment: FrameContext) -> SheetModel:
    if not model.has(BedContact):  # a sheet in the air
        return model
    bed, level = model.term(BedContact), moment.rest - jnp.mean(moment.rest, axis=0)[None]
    raised = theta[0] + level[:, 0] * theta[1] + level[:, 1] * theta[2]
    return model.with_term(eqx.tree_at(lambda t: t.height, bed, bed.height + raised))


def _stretch(model: SheetModel, theta: Float[Array, " 1"], moment: FrameContext) -> SheetModel:
    return _stiffer(model, jnp.exp(theta[0]))


def _poisson(model: SheetModel, theta: Float[Array, " 1"], moment: FrameContext) -> SheetModel:
    """By how much the sheet narrows as it is stretched; Young's modulus stays."""
    membrane = model.term(TriangleMembrane)
    change = membrane.stiffness * (plane_stress(membrane.poisson + theta[0]) - plane_stress(membrane.poisson))
    return _with_elasticity(model, membrane.elasticity + change[None])


def _bending(model: SheetModel, theta: Float[Array, " 1"], moment: FrameContext) -> SheetModel:
    bending, root = model.term(IsometricBending), jnp.exp(theta[0] / 2)
    changed = eqx.tree_at(lambda t: (t.weight, t.curvature), bending, (root * bending.weight, root * bending.curvature))
    return model.with_term(changed)


def _heterogeneity(model: SheetModel, theta: Float[Array, " modes"], moment: FrameContext) -> SheetModel:
    return _stiffer(model, jnp.exp(cosines(_places(model, moment), MODES) @ theta)[:, None, None])


def _inclusion(model: SheetModel, theta: Float[Array, " spots"], moment: FrameContext) -> SheetModel:
    return _stiffer(model, jnp.exp(spots(_places(model, moment)) @ theta)[:, None, None])


def _anisotropy(model: SheetModel, theta: Float[Array, " angles"], moment: FrameContext) -> SheetModel:
    """Fibres along n of strength a store a k (n.E n)^2 / 2 an area."""
    membrane, angle = model.term(TriangleMembrane), jnp.asarray(np.pi * np.arange(ANGLES) / ANGLES)
    along = jnp.stack([jnp.cos(angle) ** 2, jnp.sin(angle) ** 2, jnp.cos(angle) * jnp.sin(angle)], axis=1)
    fibres = membrane.stiffness * jnp.einsum("a,ap,aq->pq", theta, along, along)
    return _with_elasticity(model, membrane.elasticity + fibres[None])


def _pre_strain(model: SheetModel, theta: Float[Array, " 3"], moment: FrameContext) -> SheetModel:
    """Where it lay the sheet was longer by theta than it would be by itself."""
    membrane = model.term(TriangleMembrane)
    longer = jnp.stack([theta[0], theta[1], 2 * theta[2]])
    return model.with_term(eqx.tree_at(lambda t: t.inelastic, membrane, membrane.inelastic - longer[None]))


def _strain_stiffening(model: SheetModel, theta: Float[Array, " 1"], moment: FrameContext) -> SheetModel:
    membrane = model.term(TriangleMembrane)
    return model.with_term(eqx.tree_at(lambda t: t.stiffening, membrane, membrane.stiffening + theta[0]))


def _anchor_shift(model: SheetModel, theta: Float[Array, " 3"], moment: FrameContext) -> SheetModel:
    return eqx.tree_at(lambda one: one.energy.rest, model, model.energy.rest + theta[None])


def _point_pull(model: SheetModel, theta: Float[Array, " pulls"], moment: FrameContext) -> SheetModel:
    """One force a spot, spread over its particles."""
    share = spots(flat(model.term(TriangleMembrane), moment.rest, moment.rest))
    share = share / jnp.maximum(jnp.sum(share, axis=0), 1.0)[None]
    load = model.term(DeadLoad)
    return model.with_term(eqx.tree_at(lambda t: t.force, load, load.force + share @ theta.reshape(GRID**2, 3)))


def _adhesion(model: SheetModel, theta: Float[Array, " 1"], moment: FrameContext) -> SheetModel:
    film, membrane = model.term(AdhesionFilm), model.term(TriangleMembrane)
    area = jnp.zeros(len(moment.rest)).at[membrane.vertices].add(membrane.area[:, None] / 3)
    return model.with_term(eqx.tree_at(lambda t: t.work, film, film.work + theta[0] * area))


def _stiffer(model: SheetModel, times: Float[Array, "*f"]) -> SheetModel:
    return _with_elasticity(model, times * model.term(TriangleMembrane).elasticity)


def _with_elasticity(model: SheetModel, elasticity: Float[Array, "f 3 3"]) -> SheetModel:
    return model.with_term(eqx.tree_at(lambda t: t.elasticity, model.term(TriangleMembrane), elasticity))


def _places(model: SheetModel, moment: FrameContext) -> Float[Array, "f 2"]:
    """Of the triangles' middles."""
    membrane = model.term(TriangleMembrane)
    return flat(membrane, moment.rest, jnp.mean(moment.rest[membrane.vertices], axis=1))


def _falling() -> tuple[float, ...]:
    """Smooth fields are likelier: half a factor of e in the lowest modes, less with the square of the wave number."""
    wave = np.add.outer(np.arange(MODES) ** 2, np.arange(MODES) ** 2).ravel()
    return tuple(float(one) for one in 0.6 / np.maximum(wave, 1))


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
        prior_sd=_falling(),
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
        confounded_with=("attachments", "inclusion"),
    ),
    Effect(
        name="adhesion",
        acts=_adhesion,
        units=("J/m^2",),
        prior_sd=(0.1,),
        source="a film of water, twice its surface tension",
        confounded_with=("attachments",),
        non_negative=True,
    ),
)
