"""The paper's simulator f of one sheet: XPBD over springs on its edges and across its hinges, without weight or bed.

The paper does not state the numbers below; `xpbd` has the method.
"""

from jiggle_mj.observation import Declaration

from .membrane import EdgeMembrane
from .mesh import SheetMesh
from .xpbd import XPBD, hinge_springs

HINGE_STIFFNESS = 1 / 30
"""Stiffness of a spring across a hinge [membrane stiffness]."""
TIME_STEP = 0.02
"""Time step of f [s]."""
SWEEPS_PER_STEP = 20
"""Gauss-Seidel sweeps in one step of f."""


def simulator(mesh: SheetMesh, declaration: Declaration) -> XPBD:
    """Build the paper's f for a sheet: springs on edges and across hinges, no weight and no bed."""
    k = declaration.membrane_stiffness
    springs = EdgeMembrane.build(mesh, stiffness=k), hinge_springs(mesh, stiffness=HINGE_STIFFNESS * k)
    return XPBD.build(mesh, springs, areal_density=declaration.areal_density, time_step=TIME_STEP)
