"""The force on the tool of measured data: one row a frame, in the axes of the points."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .. import toml_kinds as kinds
from ..errors import RecordingError
from ..observation import MeasuredForce
from ..recording.force import MAX_FORCE_N
from ..toml_kinds import StrictTable
from .data_folder import DataFolder, quoted
from .points.archives import read_array
from .points.headings import FORCES, stated_units
from .points.text_lines import read_lines
from .points.text_table import TextTable
from .units import unit_of

FORCE_UNITS = {"N": 1.0, "mN": 1e-3, "cN": 1e-2}
"""Newtons in one unit of force."""
AXIS = re.compile(r"(?:^|[\W_])(?:f|force)?[\W_]?([xyz])(?=$|[\W_])", re.IGNORECASE)
"""An axis in a heading: Fx, force_x, F.x [mN]."""
ACTS_ON = ("on tool", "on tissue")
"""On which of the two a force may act, that on the tool by default."""


@dataclass(frozen=True, kw_only=True)
class GivenForce:
    """The table `[force]` of recording.toml."""

    values: str | None
    """Name of the array (frames, 3) in the archive of the points; None where a file is given."""
    file: str | None
    """Text file of three columns, one row a frame; None where an array is given."""
    unit: str
    """Unit of the data, a key of `FORCE_UNITS`."""
    on_tissue: bool
    """Whether it is the force on the tissue, and not on the tool."""
    sd: float | None
    """Standard deviation of each component [N]; None where it is not known."""

    @property
    def factor(self) -> float:
        """Return the newtons on the tool in one unit of the data."""
        return FORCE_UNITS[self.unit] * (-1 if self.on_tissue else 1)


def read_force_table(table: StrictTable) -> GivenForce | None:
    """Return the contents of `[force]`; None where there is none.

    Raises:
        RecordingError: a key is unknown or missing, or a value is of the wrong kind.
    """
    if not table.given:
        return None
    on = table.take("acts", kinds.text, ACTS_ON[0])
    if on not in ACTS_ON:
        raise RecordingError(f"{table.where} acts must be one of {', '.join(map(repr, ACTS_ON))}; got '{on[:50]}'.")
    unit_of(table, "unit", FORCE_UNITS)
    force = GivenForce(
        values=table.take("values", kinds.text, None),
        file=table.take("file", kinds.text, None),
        unit=table.take("unit", kinds.text, ""),
        on_tissue=on == ACTS_ON[1],
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
    decimal: str | None,
    rotation: Float[np.ndarray, "3 3"],
    order: list[int],
) -> list[MeasuredForce | None]:
    """Return the force in each frame, in the world; None where a row has an empty or infinite number.

    Args:
        folder: the data.
        given: what recording.toml says; None for no force.
        archive: name of the points' first file.
        decimal: decimal mark of text files; None where it is to be found.
        rotation: from the axes of the data to those of the world.
        order: number of each frame in the data.

    Raises:
        RecordingError: the array or file is missing or of another shape, its name or heading states another unit or
            order of axes, or a force is of more than a tonne.
    """
    if given is None:
        return [None] * len(order)
    if given.values is not None:
        where, rows = f"{archive}: {given.values}", np.asarray(read_array(folder / archive, given.values))
        _refuse_names(given, (given.values,), where)
    else:
        assert given.file is not None
        where = given.file
        text = read_lines(folder / given.file)
        table = TextTable.open(text, columns=None, given=(None, decimal), known=None)
        _refuse_names(given, table.sample.names, where, tuple(f"[{unit.strip('[]()')}]" for unit in table.sample.units))
        rows = table.read(range(table.width))
    if rows.shape != (len(order), 3) or rows.dtype.kind not in "iuf":
        raise RecordingError(
            f"{where} must be numbers of shape ({len(order)}, 3), a force x, y, z in each frame; it has {rows.shape}."
        )
    known = np.array([bool(np.isfinite(row).all()) for row in rows[order].astype(float)])
    if not known.any():
        raise RecordingError(f"{where} has no row of three finite numbers, so no frame has a force; leave out [force].")
    force = given.factor * np.where(known[:, np.newaxis], rows[order], 0.0) @ rotation.T
    largest = float(np.abs(force).max())
    if largest > MAX_FORCE_N:
        raise RecordingError(
            f"{where} has a force of {largest:.3g} N; at most {MAX_FORCE_N:g} N are read: is the "
            f"unit one of {', '.join(FORCE_UNITS)}?"
        )
    return [MeasuredForce(on_tool=force[k], sd=given.sd) if known[k] else None for k in range(len(force))]


def _refuse_names(given: GivenForce, names: Sequence[str], where: str, units: Sequence[str] = ()) -> None:
    """Refuse headings, or the name of an array, that state another unit or another order of axes.

    Raises:
        RecordingError: they do.
    """
    if others := stated_units((*names, *units), FORCES) - {given.unit}:
        stated = ", ".join(sorted(others))
        raise RecordingError(
            f'unit = "{given.unit}", but {where} says that forces are in {stated}: give that unit in [force], one of '
            f"{', '.join(FORCE_UNITS)}, or rename it."
        )
    axes = [each[0].lower() if len(each := AXIS.findall(name.strip(' "'))) == 1 else None for name in names]
    if len(names) == 3 and any(axis not in (None, wanted) for axis, wanted in zip(axes, "xyz", strict=True)):
        raise RecordingError(
            f"{where} has the heading '{quoted(', '.join(names))}'; its columns must be x, y and z in this order."
        )
