"""The estimator's model of one sheet: its mesh and what the user declares, put together as an energy.

Everything that the declaration does not say (the bed's softness, the stiffness of a grip) scales with the declared
membrane stiffness, because positions know only ratios.
"""

from typing import Literal

import numpy as np
from jaxtyping import Float
from jiggle_mj.estimator.bending import IsometricBending
from jiggle_mj.estimator.block_tridiagonal import Layout
from jiggle_mj.estimator.energy import SheetEnergy, Term
from jiggle_mj.estimator.environment import Bed, Weight
from jiggle_mj.estimator.membrane import EdgeMembrane, TriangleMembrane
from jiggle_mj.estimator.mesh import SheetMesh

from jiggle_mj.observation import Declaration

BED_STIFFNESS = 1 / 3
"""Of the bed under one particle, as a share of the membrane stiffness."""

ACROSS = 0.2
"""Share of gravity across a sheet that hangs, up to which the vertical is what is wrong."""

Membrane = Literal["triangles", "edges"]


def surrogate(mesh: SheetMesh, declaration: Declaration, *, membrane: Membrane = "triangles") -> SheetEnergy:
    """Membrane, bending, weight and bed of a sheet; attachments and grip are added by who uses it."""
    k, nu = declaration.membrane_stiffness, declaration.poisson
    plate = k * declaration.thickness**2 / (12 * (1 - nu**2))
    elastic = (
        TriangleMembrane.build(mesh, stiffness=k, poisson=nu)
        if membrane == "triangles"
        else EdgeMembrane.build(mesh, stiffness=k)
    )
    terms: list[Term] = [elastic, IsometricBending.build(mesh, stiffness=plate)]
    gravity = np.asarray(declaration.gravity, dtype=float)
    if gravity.any():
        down = _as_it_hangs(mesh, gravity) if declaration.hangs else gravity
        weight = Weight.build(mesh.particle_area, areal_density=declaration.areal_density, gravity=tuple(down))
        terms.append(weight)
        if declaration.bed:
            up = -gravity / np.linalg.norm(gravity)
            load = -np.asarray(weight.force) @ up
            terms.append(Bed.build(mesh.rest, load=load, up=up, stiffness=BED_STIFFNESS * k))
    return SheetEnergy.build(mesh.rest, tuple(terms), Layout.from_pattern(mesh.adjacency, mesh.rest))


def _as_it_hangs(mesh: SheetMesh, gravity: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """Gravity turned into the mean plane of a sheet that hangs still, if that is near [m/s^2].

    A camera and a robot agree on the vertical to a few degrees; a limp sheet hangs by it.
    """
    one, two, three = (mesh.rest[mesh.faces[:, k]] for k in range(3))
    normal = np.cross(two - one, three - one).sum(axis=0)
    normal /= np.linalg.norm(normal)
    within, size = gravity - (gravity @ normal) * normal, np.linalg.norm(gravity)
    return within * size / np.linalg.norm(within) if abs(gravity @ normal) < ACROSS * size else gravity
