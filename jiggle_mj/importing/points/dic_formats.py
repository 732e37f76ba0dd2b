"""Exports of programs for digital image correlation: the headings of their columns, and how they mark lost points.

Sources: the results files of DICe (Sandia National Laboratories) and of VIC-3D (Correlated Solutions).
"""

from dataclasses import dataclass

from .missing_rule import MissingRule


@dataclass(frozen=True, kw_only=True)
class DicFormat:
    """Columns of one program's text export."""

    columns: tuple[str, ...]
    """Headings of x, y, z."""
    displacements: tuple[str, ...]
    """Headings of the displacements; added where the positions are those of the reference, thus alike in all frames."""
    missing: MissingRule | None
    """How a lost point is marked; applied where the file has that column."""


DIC_FORMATS = {
    "dice": DicFormat(
        columns=("MODEL_COORDINATES_X", "MODEL_COORDINATES_Y", "MODEL_COORDINATES_Z"),
        displacements=("MODEL_DISPLACEMENT_X", "MODEL_DISPLACEMENT_Y", "MODEL_DISPLACEMENT_Z"),
        missing=MissingRule(column="SIGMA", sign="<", value=0.0),
    ),
    "vic-3d": DicFormat(
        columns=("X", "Y", "Z"),
        displacements=("U", "V", "W"),
        missing=MissingRule(column="sigma", sign="==", value=-1.0),
    ),
}
"""Values of the key `format`."""

_ARRAYS = '; save x, y, z as one array (frames, points, 3) in an .npz or a .mat of version 5 or 7 and give its "key", '
OTHER_DIC_PROGRAMS = {
    "ncorr": f"{_ARRAYS}displacements in another and give 'displacements': Ncorr's own .mat nests structures.",
    "duodic": f"{_ARRAYS}from Points3D of the 3-D results: DuoDIC's own .mat nests cells.",
    "mudic": f"{_ARRAYS}from Fields.coords() and .disp(): muDIC has no export of its own.",
}
"""What to do with the exports of programs that keep no table of points."""

DISPLACEMENT_HEADINGS = (
    ("MODEL_DISPLACEMENT_X", "MODEL_DISPLACEMENT_Y", "MODEL_DISPLACEMENT_Z"),
    ("U", "V", "W"),
    ("dX", "dY", "dZ"),
    ("DISPLACEMENT_X", "DISPLACEMENT_Y", "DISPLACEMENT_Z"),
    ("disp_x", "disp_y", "disp_z"),
)
"""Headings that programs give to displacements; compared without regard to case."""
