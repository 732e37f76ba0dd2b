"""The force on the tool of measured data: one row a frame, in the axes of the points."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .. import toml_kinds as kinds
from ..errors import RecordingError
from ..observation import MeasuredForce
from ..recording.force import MAX_FORCE_N
from ..toml_kinds import StrictTable
from .data_folder import DataFolder
from .points.archives import read_array
from .points.text_lines import read_text
from .units import unit_of

FORCE_UNITS = {"N": 1.0, "mN": 1e-3, "cN": 1e-2}
"""Newtons in one unit of force."""
TRACKED = ("on tool", "on tissue")
"""On which of the two the force acts."""


@dataclass(frozen=True, kw_only=True)
class GivenForce:
    """The table `[force]` of recording.toml."""

    values: str | None
    """Name of the array (frames, 3) in the archive of the points; None where a file is given."""
    file: str | None
    """Text file of three columns, one row a frame; None where an array is given."""
    factor: float
    """Newtons in one unit of the data, negative where the force is that on the tissue."""
    sd: float | None
    """Standard deviation of each component [N]; None where it is not known."""


def read_force_table(table: StrictTable) -> GivenForce | None:
    """Return the contents of `[force]`; None where there is none.

    Raises:
        RecordingError: a key is unknown or missing, or a value is of the wrong kind.
    """
    if not table.given:
        return None
    on = table.take("acts", kinds.text, TRACKED[0])
    if on not in TRACKED:
        raise RecordingError(f"{table.where} acts must be one of {', '.join(map(repr, TRACKED))}; got '{on[:50]}'.")
    force = GivenForce(
        values=table.take("values", kinds.text, None),
        file=table.take("file", kinds.text, None),
        factor=unit_of(table, "unit", FORCE_UNITS) * (1 if on == TRACKED[0] else -1),
        sd=table.take("sd", kinds.positive, None),
    )
    table.refuse_unknown()
    if (force.values is None) == (force.file is None):
        raise RecordingError(f"{table.where} needs values, an array of the points' archive, or file: give one of them.")
    return force


def read_force(
    folder: DataFolder,
    given: GivenForce | None,
    archive: str,
    *,
    rotation: Float[np.ndarray, "3 3"],
    order: list[int],
) -> list[MeasuredForce | None]:
    """Return the force in each frame, in the world; None where a row has an empty or infinite number.

    Args:
        folder: the data.
        given: what recording.toml says; None for no force.
        archive: name of the points' first file.
        rotation: from the axes of the data to those of the world.
        order: number of each frame in the data.

    Raises:
        RecordingError: the array or file is missing or of another shape, or a force is of more than a tonne.
    """
    if given is None:
        return [None] * len(order)
    if given.values is not None:
        where, rows = f"{archive}: {given.values}", np.asarray(read_array(folder / archive, given.values))
    else:
        assert given.file is not None
        where, rows = given.file, _rows(read_text(folder / given.file), given.file)
    if rows.shape != (len(order), 3) or rows.dtype.kind not in "iuf":
        raise RecordingError(
            f"{where} must be numbers of shape ({len(order)}, 3), a force x, y, z in each frame; it has {rows.shape}."
        )
    force = given.factor * rows[order].astype(float) @ rotation.T
    known = [bool(np.isfinite(row).all()) for row in force]
    largest = float(np.abs(np.where(np.isfinite(force), force, 0.0)).max())
    if largest > MAX_FORCE_N:
        raise RecordingError(
            f"{where} has a force of {largest:.3g} N; at most {MAX_FORCE_N:g} N are read: is the "
            f"unit one of {', '.join(FORCE_UNITS)}?"
        )
    return [MeasuredForce(on_tool=force[k], sd=given.sd) if known[k] else None for k in range(len(force))]


def _rows(text: str, where: str) -> Float[np.ndarray, "t c"]:
    """Return the numbers of a text of columns, after a line of headings if there is one."""
    lines = [line.replace(",", " ").replace(";", " ").split() for line in text.splitlines() if line.strip()]
    if lines and not _is_numbers(lines[0]):
        lines = lines[1:]
    try:
        return np.array([[float(cell) for cell in line] for line in lines])
    except ValueError as failure:
        raise RecordingError(
            f"{where} must have three numbers a line, with decimal points, separated by commas: {str(failure)[:100]}."
        ) from failure


def _is_numbers(cells: list[str]) -> bool:
    try:
        [float(cell) for cell in cells]
    except ValueError:
        return False
    return True
