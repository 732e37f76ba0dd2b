"""The estimator's model of one sheet: an energy built from its mesh and the user's declaration.

Every stiffness that the declaration does not give (of the bed, of a grip) scales with the declared membrane stiffness,
because positions identify only ratios.
"""

from typing import Literal

import numpy as np

from jiggle_mj.observation import Declaration

from .bending import IsometricBending
from .block_tridiagonal import Layout
from .energy import SheetEnergy, Term
from .environment import BedContact, Weight
from .hanging import Tension, hanging_gravity
from .membrane import EdgeMembrane, TriangleMembrane
from .mesh import SheetMesh

BED_STIFFNESS = 1 / 3
"""Stiffness of the bed under one particle [membrane stiffness]."""

Membrane = Literal["triangles", "edges"]
"""Laws of the sheet's plane: St Venant-Kirchhoff triangles, or springs along the edges."""


def surrogate(mesh: SheetMesh, declaration: Declaration, *, membrane: Membrane = "triangles") -> SheetEnergy:
    """Return the energy of a sheet: membrane, bending, weight, and bed or tension.

    The caller adds attachments and grip.
    """
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
        down = hanging_gravity(mesh, gravity) if declaration.hangs else None
        pull = tuple(gravity if down is None else down)
        weight = Weight.build(mesh.particle_area, areal_density=declaration.areal_density, gravity=pull)
        terms.append(weight)
        if down is not None:
            terms.append(Tension.build(mesh, weight, poisson=nu))
        if declaration.bed:
            up = -gravity / np.linalg.norm(gravity)
            load = -np.asarray(weight.force) @ up
            terms.append(BedContact.build(mesh.rest, load=load, up=up, stiffness=BED_STIFFNESS * k))
    return SheetEnergy.build(mesh.rest, tuple(terms), Layout.from_pattern(mesh.adjacency, mesh.rest))
