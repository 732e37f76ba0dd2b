"""A declaration as a TOML file: its properties, and a table of effects by name."""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from ..argument_checks import as_path
from ..errors import OptionError
from ..nested_settings import with_settings
from ..observation import MATERIAL_BOUNDS, Declaration
from .settings_file import read_table

UNITS = {name: unit for name, (unit, _) in MATERIAL_BOUNDS.items()} | {"gravity": "m/s^2"}
"""Unit of each property that has one."""


def read_declaration(path: str | Path) -> dict[str, Any]:
    """Return the properties that a file declares, by name, as `declare` of `run_estimator` and others takes them.

    Raises:
        OptionError: it cannot be read, or holds an unknown name or a value that a declaration refuses.
    """
    path = as_path(path, "declare")
    return checked_properties(read_table(path, "declare"), where=f"declare {path}")


def checked_properties(table: Mapping[str, Any], *, where: str) -> dict[str, Any]:
    """Return the properties of a table by name, as a declaration holds them.

    Raises:
        OptionError: an unknown name, or a value that a declaration refuses.
    """
    if "mesh" in table:
        raise OptionError(f"{where} mesh: a mesh is declared in the recording; see [mesh] in docs/RECORDINGS.md.")
    checked = with_settings(Declaration(), table, where=where)
    return {name: getattr(checked, name) for name in table}


def declaration_text(declaration: Declaration, *, about: list[str], notes: Mapping[str, str]) -> str:
    """Return a declaration without its mesh as the text of a TOML file.

    Args:
        declaration: what is written.
        about: lines of comment at the beginning.
        notes: comment on each effect, by its name.
    """
    lines = [f"# {line}" for line in about]
    for field in fields(declaration):
        if field.name not in ("mesh", "effects"):
            value, unit = _value(getattr(declaration, field.name)), UNITS.get(field.name)
            lines.append(f"{field.name} = {value}" + (f"  # {unit}" if unit else ""))
    if declaration.effects:
        lines += ["", "[effects]"]
        lines += [f"{name} = {_value(values)}  # {notes[name]}" for name, values in declaration.effects.items()]
    return "\n".join(lines) + "\n"


def _value(value: float | bool | tuple[float, ...]) -> str:
    """Return a number, a truth value or a list of numbers in TOML."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(repr, value))}]"
    return repr(value).lower() if isinstance(value, bool) else repr(value)
