"""What of the declared tissue is no tissue, or has another unit: gravity, density, thickness, stiffness."""

from collections.abc import Iterator

import numpy as np

from ..observation import Declaration
from .problem import RecordingProblem, metres

GRAVITY_M_S2 = (9.7, 9.9)
"""Size of gravity on Earth, with a margin [m/s^2]: 9.76 to 9.83."""
DENSITY_KG_M3 = (50.0, 20_000.0)
"""Density of a sheet [kg/m^3]: foam to lead."""
MODULUS_PA = (100.0, 1e9)
"""Membrane stiffness over thickness [Pa]: brain has 1e3, rubber 1e6, paper and cloth up to 1e9."""
MAX_THICKNESS = 0.25
"""Largest thickness of a sheet [extents]: a thicker body bends and is sheared as a solid."""


def declaration_problems(declared: Declaration, extent: float | None) -> Iterator[RecordingProblem]:
    """Find declared numbers that are no sheet's.

    Args:
        declared: as the recording declares the tissue.
        extent: of the sheet [m]; None if unknown.
    """
    gravity = float(np.linalg.norm(declared.gravity))
    if gravity and not GRAVITY_M_S2[0] <= gravity <= GRAVITY_M_S2[1]:
        yield _doubt(
            f"gravity is declared as {gravity:.4g} m/s^2, and is 9.81 on Earth; give it in m/s^2, or as 0 where it "
            "shall be left out."
        )
    density = declared.areal_density / declared.thickness
    if declared.areal_density and not DENSITY_KG_M3[0] <= density <= DENSITY_KG_M3[1]:
        yield _doubt(
            f"an areal density of {declared.areal_density:.4g} kg/m^2 over a thickness of {metres(declared.thickness)} "
            f"is a density of {density:.3g} kg/m^3; areal_density is density times thickness, about 1 for 1 mm of "
            "tissue."
        )
    modulus = declared.membrane_stiffness / declared.thickness
    if not MODULUS_PA[0] <= modulus <= MODULUS_PA[1]:
        yield _doubt(
            f"a membrane stiffness of {declared.membrane_stiffness:.4g} N/m over a thickness of "
            f"{metres(declared.thickness)} is a modulus of {modulus:.3g} Pa; membrane_stiffness is Young's modulus in "
            "Pa times thickness in m, 30 for 1 mm of soft tissue."
        )
    if extent is not None and declared.thickness > MAX_THICKNESS * extent:
        yield _doubt(
            f"the thickness is declared as {metres(declared.thickness)}, and the sheet is {metres(extent)} wide; "
            "thickness is in metres."
        )


def _doubt(text: str) -> RecordingProblem:
    return RecordingProblem(name="declaration", refuses=False, text=text)
