"""One sheet's model for one frame, as far as an effect may change it: its energy, its tool, and how it is seen.

The energy has its terms by kind, so that an effect finds the one that it changes; terms that only effects use are there
from the start, at nothing.
"""

from typing import TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jiggle_mj.observation import Declaration

from ..physics.block_tridiagonal import Layout
from ..physics.energy import SheetEnergy, Term
from ..physics.environment import Tether, Weight
from ..physics.membrane import TriangleMembrane
from ..physics.mesh import SheetMesh
from ..physics.surrogate import surrogate
from .surface_points import SurfacePoints
from .terms import AdhesionFilm, DeadLoad, FrictionElements

Kind = TypeVar("Kind", bound=Term)

SHORTEST = 1e-3
"""Time constant below which what follows does so at once where the tool stands [s]."""
STOOD = 1e-4
"""Way up to which the tool as well stood: its reports are no better [m]."""


class View(eqx.Module):
    """How positions are seen: `shift` + `centre` + `turn` (x - `centre`), of what is followed on the sheet's surface.

    The surface lies above the sheet's middle, where its forces are, and a sheet that turns takes it along. At rest it
    is where the sheet was seen, so that particles at x have theirs at x + `height` (normal - `lying`).
    """

    centre: Float[Array, " 3"]
    """The middle of the sheet at rest [m]."""
    turn: Float[Array, "3 3"]
    shift: Float[Array, " 3"]
    """[m]."""
    followed: SurfacePoints
    height: Float[Array, ""]
    """Of the surface over the middle [m]."""
    lying: Float[Array, "n 3"]
    """Normals at rest."""

    def __call__(self, x: Float[Array, "n 3"], *, tangents: Float[Array, "n 3 2"]) -> Float[Array, "n 3"]:
        """Where what is followed is seen, for particles at x and the sheet's derivatives there."""
        return self.moved(self.followed(x + self.height * (_normals(tangents) - self.lying), tangents))

    def moved(self, x: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Where points at x are seen."""
        return self.centre[None] + self.shift[None] + (x - self.centre[None]) @ self.turn.T


class SheetModel(eqx.Module):
    """Of one frame."""

    energy: SheetEnergy
    """Its `rest` are the anchors of the attachments."""
    tool: Float[Array, " 3"]
    """How far the jaws have taken what they hold since they closed [m]."""
    view: View
    time: Float[Array, ""]
    """By the clock of the tool's reports, when what is seen was so [s]."""

    def has(self, kind: type[Term]) -> bool:
        """Whether the energy has a term of a kind: a sheet in the air has no bed."""
        return any(isinstance(term, kind) for term in self.energy.terms)

    def term(self, kind: type[Kind]) -> Kind:
        """The energy's term of a kind."""
        return next(term for term in self.energy.terms if isinstance(term, kind))

    def with_term(self, new: Term) -> "SheetModel":
        """With another term in the place of the one of its kind."""
        terms = tuple(new if type(term) is type(new) else term for term in self.energy.terms)
        return eqx.tree_at(lambda model: model.energy.terms, self, terms)


class FrameContext(eqx.Module):
    """What an effect may know of a frame."""

    rest: Float[Array, "n 3"]
    """[m]."""
    time: Float[Array, ""]
    """Since the sheet lay as its rest shape has it [s]."""
    gap: Float[Array, ""]
    """Since the frame before [s]."""
    earlier_gap: Float[Array, ""]
    """From the one before that to the frame before [s]."""
    closed: Float[Array, ""]
    """Since the jaws closed [s]."""
    now: Float[Array, "n 3"]
    """The frame's own state, as far as it is known already [m]."""
    before: Float[Array, "n 3"]
    """State of the frame before; where the jaws have just closed, as it lay [m]."""
    earlier: Float[Array, "n 3"]
    """Of the one before that [m]."""
    report_times: Float[Array, " reports"]
    """When the tool's way was reported during this grasp [s], as `time`; beyond the last, it stood."""
    reports: Float[Array, "reports 3"]
    """The way since the jaws closed [m]."""
    past: Float[Array, "frames n 3"]
    """States of all frames with closed jaws [m]."""
    began: Float[Array, " frames"]
    """When the tissue went to each of these states [s]."""
    ended: Float[Array, " frames"]
    """When it was last there [s]."""

    def faded(self, rate: Float[Array, ""]) -> Float[Array, " frames"]:
        """What a memory that follows at a rate [1/s] holds of each state by now; it began at rest."""
        until, since = (jnp.where(at <= self.time, jnp.exp(-rate * (self.time - at)), 0.0) for at in self._spans())
        return until - since

    def left_behind(self, constant: Float[Array, ""]) -> Float[Array, ""]:
        """Share of the step since the frame before that what follows with a time constant [s] still has to go.

        It follows the tool's reported way; where the tool stood, it had all that time.
        """
        over = jnp.maximum(constant, SHORTEST)
        ago = self.time - jnp.clip(self.report_times, self.time - self.gap, self.time)
        lasted = ago[:-1] - ago[1:]
        way = jnp.linalg.norm(jnp.diff(self.reports, axis=0), axis=1)
        way = jnp.where(lasted > 0, way, 0.0)
        left = constant / jnp.where(lasted > 0, lasted, 1.0) * (jnp.exp(-ago[1:] / over) - jnp.exp(-ago[:-1] / over))
        stood = jnp.exp(-self.gap / over)
        return (way @ left + STOOD * stood) / (jnp.sum(way) + STOOD)

    def _spans(self) -> tuple[Float[Array, " frames"], Float[Array, " frames"]]:
        return self.ended, jnp.where(self.ended <= self.time, self.began, jnp.inf)


def nominal_energy(mesh: SheetMesh, declaration: Declaration) -> SheetEnergy:
    """The declared sheet's energy with all the terms that effects may need.

    Raises:
        ValueError: its membrane is not of triangles.
    """
    energy = surrogate(mesh, declaration)
    terms: tuple[Term, ...] = energy.terms
    if not any(isinstance(term, Weight) for term in terms):
        terms = (*terms, Weight.build(mesh.particle_area, areal_density=declaration.areal_density, gravity=(0, 0, 0)))
    terms = (*terms, *(kind.build(mesh.rest) for kind in (FrictionElements, DeadLoad, AdhesionFilm, Tether)))
    return SheetEnergy.build(mesh.rest, terms, Layout.from_pattern(mesh.adjacency, mesh.rest))


def tangents(membrane: TriangleMembrane, x: Float[Array, "n 3"]) -> Float[Array, "n 3 2"]:
    """Derivative of the position along the two material axes, at each particle the mean of its triangles'."""
    F = membrane.deformation(x[membrane.vertices])
    spread = jnp.broadcast_to((membrane.area[:, None, None] * F)[:, None], (*membrane.vertices.shape, 3, 2))
    total = jnp.zeros((len(x), 3, 2), x.dtype).at[membrane.vertices].add(spread)
    around = jnp.zeros(len(x), x.dtype).at[membrane.vertices].add(membrane.area[:, None])
    return total / around[:, None, None]


def across(membrane: TriangleMembrane, rest: Float[Array, "n 3"], x: Float[Array, "m 3"]) -> Float[Array, "m 2"]:
    """Places in the plane of the sheet's two mean material axes [m]."""
    return x @ jnp.mean(tangents(membrane, rest), axis=0)


def extent(place: Float[Array, "n 2"]) -> tuple[Float[Array, "1 2"], Float[Array, "1 2"]]:
    """The least and the largest of the sheet's places."""
    return jnp.min(place, axis=0, keepdims=True), jnp.max(place, axis=0, keepdims=True)


def centred(mesh: SheetMesh) -> View:
    """As it is."""
    membrane = TriangleMembrane.build(mesh, stiffness=1.0, poisson=0.0)
    return View(
        centre=jnp.asarray(mesh.rest.mean(axis=0)),
        turn=jnp.eye(3),
        shift=jnp.zeros(3),
        followed=SurfacePoints.themselves(mesh.n),
        height=jnp.zeros(()),
        lying=_normals(tangents(membrane, jnp.asarray(mesh.rest))),
    )


def _normals(tangents: Float[Array, "n 3 2"]) -> Float[Array, "n 3"]:
    """Unit normals on the side from which triangles run counter-clockwise."""
    normal = jnp.cross(tangents[:, :, 0], tangents[:, :, 1])
    return normal / jnp.linalg.norm(normal, axis=1, keepdims=True)
