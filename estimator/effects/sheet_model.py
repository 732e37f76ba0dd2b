"""One sheet's model for one frame, as far as an effect may change it: its energy, its tool, and how it is observed.

The energy has its terms by type, so that an effect finds the one that it changes. Terms that only effects use are there
from the start, with zero energy.
"""

from functools import partial
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

MIN_TIME_CONSTANT = 1e-3
"""Time constant that a smaller one is taken as inside an exponential [s], far below the time between reports."""
RESTING_DISPLACEMENT = 1e-4
"""Displacement of the tool that counts as much as resting: its reports are no more precise [m]."""


class View(eqx.Module):
    """Observation of positions: `shift` + `centre` + `rotation` (x - `centre`) of points on the sheet's surface.

    The surface lies above the middle surface, where the forces act, and rotates with it. At rest it is where the sheet
    was observed, so that the surface over a particle at x is at x + `height` (normal - `rest_normals`).
    """

    centre: Float[Array, " 3"]
    """Middle of the sheet at rest [m]."""
    rotation: Float[Array, "3 3"]
    """Rotation, and scale, of all that is observed."""
    shift: Float[Array, " 3"]
    """Displacement of all that is observed [m]."""
    points: SurfacePoints
    """Points of the sheet that are observed as the particles."""
    height: Float[Array, ""]
    """Height of the observed surface over the middle surface [m]."""
    rest_normals: Float[Array, "n 3"]
    """Unit normals at rest."""

    def __call__(self, x: Float[Array, "n 3"], *, tangents: Float[Array, "n 3 2"]) -> Float[Array, "n 3"]:
        """Return the observed positions [m], for particles at x [m] and the sheet's derivatives there."""
        return self.moved(self.points(x + self.height * (_normals(tangents) - self.rest_normals), tangents))

    def moved(self, x: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Return where points at x are observed [m]."""
        return self.centre[None] + self.shift[None] + (x - self.centre[None]) @ self.rotation.T


class SheetModel(eqx.Module):
    """Model of the sheet in one frame."""

    energy: SheetEnergy
    """Energy of the sheet; its `rest` are the anchors of the attachments."""
    tool: Float[Array, " 3"]
    """Displacement of what the jaws hold since they closed [m]."""
    view: View
    """How positions are observed."""
    time: Float[Array, ""]
    """Time of the observed state, by the clock of the tool's reports [s]."""
    force_factor: Float[Array, ""] = eqx.field(default_factory=partial(jnp.ones, ()))
    """Measured force of the tool over that of the model."""

    def has(self, kind: type[Term]) -> bool:
        """Return whether the energy has a term of a type: a sheet in the air has no bed."""
        return any(isinstance(term, kind) for term in self.energy.terms)

    def term(self, kind: type[Kind]) -> Kind:
        """Return the energy's term of a type.

        Raises:
            StopIteration: there is none; see `has`.
        """
        return next(term for term in self.energy.terms if isinstance(term, kind))

    def with_term(self, new: Term) -> "SheetModel":
        """Return the model with another term in the place of the one of its type."""
        terms = tuple(new if type(term) is type(new) else term for term in self.energy.terms)
        return eqx.tree_at(lambda model: model.energy.terms, self, terms)

    def tethered(self, to: Float[Array, "n 3"], stiffness: Float[Array, " n"]) -> "SheetModel":
        """Return the model with a spring of some stiffness [N/m] from each particle to its place in `to` [m].

        It is a spring to where the tether is already, and a dead load that makes up for the difference.
        """
        tether, load = self.term(Tether), self.term(DeadLoad)
        stiffer = tether.stiffness + stiffness[:, None, None] * jnp.eye(3, dtype=to.dtype)[None]
        force = load.force + stiffness[:, None] * (to - tether.to)
        sprung = self.with_term(eqx.tree_at(lambda t: t.stiffness, tether, stiffer))
        return sprung.with_term(eqx.tree_at(lambda t: t.force, load, force))


def look(model: SheetModel, x: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Return where particles at x are observed [m]."""
    return model.view(x, tangents=tangents(model.term(TriangleMembrane), x))


def without_view(model: SheetModel, rest: Float[Array, "n 3"], closed: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Return where the jaws closed [m], from where it was observed then by the view of `model`.

    The sheet lies as at rest then, but for what the grip moves, so that points have slid along it as along that.
    """
    along = tangents(model.term(TriangleMembrane), rest)
    return 2 * closed - model.view.moved(closed + model.view.points(rest, along) - rest)


class FrameContext(eqx.Module):
    """What an effect may know of a frame."""

    rest: Float[Array, "n 3"]
    """Rest shape [m]."""
    time: Float[Array, ""]
    """Time since the sheet was in its rest shape [s]."""
    gap: Float[Array, ""]
    """Time since the frame before [s]."""
    earlier_gap: Float[Array, ""]
    """Time between the two frames before [s]."""
    closed: Float[Array, ""]
    """Time since the jaws closed [s]."""
    now: Float[Array, "n 3"]
    """State of the frame itself, as known so far [m]."""
    before: Float[Array, "n 3"]
    """State of the frame before; the frame's own where the jaws have just closed [m]."""
    earlier: Float[Array, "n 3"]
    """State of the frame before that [m]."""
    report_times: Float[Array, " reports"]
    """Times of the tool's reports during this grasp [s], like `time`; after the last one the tool rests."""
    reports: Float[Array, "reports 3"]
    """Reported displacements of the tool since the jaws closed [m]."""
    past: Float[Array, "frames n 3"]
    """States of all frames with closed jaws [m]."""
    began: Float[Array, " frames"]
    """Time at which the tissue started to move to each of these states [s]."""
    ended: Float[Array, " frames"]
    """Time at which it was last there [s]."""

    def memory_weights(self, rate: Float[Array, ""]) -> Float[Array, " frames"]:
        """Return the weight of each past state in a memory that follows the state at a rate [1/s], from rest on."""
        # ages are finite in both branches: a reverse derivative has both
        until, since = (
            jnp.where(at <= self.time, jnp.exp(-rate * jnp.maximum(self.time - at, 0.0)), 0.0) for at in self._spans()
        )
        return until - since

    def lag_share(self, constant: Float[Array, ""]) -> Float[Array, ""]:
        """Return the share of the step since the frame before that a lag of first order has not covered yet.

        The lag follows the tool's reported displacement. Where the tool rested, it had the whole time.

        Args:
            constant: time constant of the lag [s].
        """
        time_constant = jnp.maximum(constant, MIN_TIME_CONSTANT)
        ago = self.time - jnp.clip(self.report_times, self.time - self.gap, self.time)
        duration = ago[:-1] - ago[1:]
        distance = jnp.linalg.norm(jnp.diff(self.reports, axis=0), axis=1)
        distance = jnp.where(duration > 0, distance, 0.0)
        decay = jnp.exp(-ago[1:] / time_constant) - jnp.exp(-ago[:-1] / time_constant)
        lag = constant / jnp.where(duration > 0, duration, 1.0) * decay
        resting_lag = jnp.exp(-self.gap / time_constant)
        return (distance @ lag + RESTING_DISPLACEMENT * resting_lag) / (jnp.sum(distance) + RESTING_DISPLACEMENT)

    def _spans(self) -> tuple[Float[Array, " frames"], Float[Array, " frames"]]:
        """Return when each past state ended and began, infinite for a state that is not past yet [s]."""
        return self.ended, jnp.where(self.ended <= self.time, self.began, jnp.inf)


def nominal_energy(mesh: SheetMesh, declaration: Declaration) -> SheetEnergy:
    """Return the declared sheet's energy with all terms that effects may need.

    Raises:
        ValueError: the membrane is not made of triangles.
    """
    energy = surrogate(mesh, declaration)
    terms: tuple[Term, ...] = energy.terms
    if not any(isinstance(term, Weight) for term in terms):
        terms = (*terms, Weight.build(mesh.particle_area, areal_density=declaration.areal_density, gravity=(0, 0, 0)))
    terms = (*terms, *(kind.build(mesh.rest) for kind in (FrictionElements, DeadLoad, AdhesionFilm, Tether)))
    return SheetEnergy.build(mesh.rest, terms, Layout.from_pattern(mesh.adjacency, mesh.rest))


def tangents(membrane: TriangleMembrane, x: Float[Array, "n 3"]) -> Float[Array, "n 3 2"]:
    """Return the derivative of the position along the material axes, at each particle the mean of its triangles'."""
    F = membrane.deformation(x[membrane.vertices])
    weighted = jnp.broadcast_to((membrane.area[:, None, None] * F)[:, None], (*membrane.vertices.shape, 3, 2))
    total = jnp.zeros((len(x), 3, 2), x.dtype).at[membrane.vertices].add(weighted)
    return total / (3 * particle_areas(membrane, len(x)))[:, None, None]


def particle_areas(membrane: TriangleMembrane, n: int) -> Float[Array, " n"]:
    """Return the share of the sheet's rest area of each of n particles [m^2], a third of its triangles'."""
    return jnp.zeros(n, membrane.area.dtype).at[membrane.vertices].add(membrane.area[:, None] / 3)


def material_coordinates(
    membrane: TriangleMembrane, rest: Float[Array, "n 3"], x: Float[Array, "m 3"]
) -> Float[Array, "m 2"]:
    """Return the coordinates of positions x [m] along the sheet's two mean material axes [m]."""
    return x @ jnp.mean(tangents(membrane, rest), axis=0)


def extent(place: Float[Array, "n 2"]) -> tuple[Float[Array, "1 2"], Float[Array, "1 2"]]:
    """Return the smallest and the largest of the sheet's coordinates along each axis [m]."""
    return jnp.min(place, axis=0, keepdims=True), jnp.max(place, axis=0, keepdims=True)


def centred(mesh: SheetMesh) -> View:
    """Return a view that observes every particle of the sheet where it is."""
    membrane = TriangleMembrane.build(mesh, stiffness=1.0, poisson=0.0)
    return View(
        centre=jnp.asarray(mesh.rest.mean(axis=0)),
        rotation=jnp.eye(3),
        shift=jnp.zeros(3),
        points=SurfacePoints.themselves(mesh.n),
        height=jnp.zeros(()),
        rest_normals=_normals(tangents(membrane, jnp.asarray(mesh.rest))),
    )


def _normals(tangents: Float[Array, "n 3 2"]) -> Float[Array, "n 3"]:
    """Return the unit normals on the side from which the triangles run counter-clockwise."""
    normal = jnp.cross(tangents[:, :, 0], tangents[:, :, 1])
    return normal / jnp.linalg.norm(normal, axis=1, keepdims=True)
