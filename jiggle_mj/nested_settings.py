"""Settings of nested, frozen dataclasses from names and values, as a TOML file or the command line gives them."""

import sys
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from .errors import MAX_SHOWN, OptionError
from .likely_name import likeliest

T = TypeVar("T")
MAX_DEPTH = 8
"""Tables inside one another that are read; settings are inside at most three."""


def with_settings(config: T, table: Mapping[str, Any], *, where: str) -> T:
    """Return a copy of a config with the values of a table; tables in it are for its nested configs.

    Args:
        config: a frozen dataclass, which may hold others.
        table: values by field name.
        where: what the table is, for messages: the file, or the option.

    Raises:
        OptionError: an unknown name (with the likeliest known one), a value of another type or out of its range.
    """
    return _changed(config, table, where=where, prefix="", known=[name for name, _ in dotted(config)])


def dotted(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted name and the value of each setting of a config, nested ones included."""
    for field in fields(config):
        value, name = getattr(config, field.name), f"{prefix}{field.name}"
        if is_dataclass(value):
            yield from dotted(value, f"{name}.")
        else:
            yield name, value


def nested(assignments: Mapping[str, Any]) -> dict[str, Any]:
    """Return values by dotted names as nested tables.

    Raises:
        OptionError: a name is both a value and a table.
    """
    tables: dict[str, Any] = {}
    for name, value in assignments.items():
        *path, last = name.split(".")
        table = tables
        for part in path:
            table = table.setdefault(part, {})
            if not isinstance(table, dict):
                raise OptionError(f"{name[:MAX_SHOWN]} needs a table, and '{part[:MAX_SHOWN]}' has a value of its own.")
        table[last] = value
    return tables


def leaves(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted name and the value of each entry of a table, those of its tables included.

    Raises:
        OptionError: a table is inside more tables than any setting is.
    """
    if prefix.count(".") > MAX_DEPTH:
        raise OptionError(f"{prefix[:MAX_SHOWN]}... is inside more than {MAX_DEPTH} tables; no setting is.")
    for name, value in table.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _changed(config: T, table: Mapping[str, Any], *, where: str, prefix: str, known: list[str]) -> T:
    names = {field.name for field in fields(config)}  # pyright: ignore[reportArgumentType]
    kinds, changes = get_type_hints(type(config)), {}
    for key, value in table.items():
        name = f"{prefix}{key}"
        if key not in names:
            raise OptionError(f"{where}: unknown setting '{name[:MAX_SHOWN]}'{_meant(name, known)}")
        current = getattr(config, key)
        if is_dataclass(current):
            if not isinstance(value, Mapping):
                raise OptionError(f"{where}: {name} is a table of settings, such as {name}.{fields(current)[0].name}.")
            changes[key] = _changed(current, value, where=where, prefix=f"{name}.", known=known)
        elif isinstance(value, Mapping) and value and get_origin(kinds[key]) is not Mapping:
            inner = f"{name}.{next(iter(value))}"
            raise OptionError(f"{where}: unknown setting '{inner[:MAX_SHOWN]}'{_meant(inner, known)}")
        else:
            changes[key] = _typed(value, kinds[key], f"{where}: {name}")
    try:
        return replace(config, **changes)  # pyright: ignore[reportArgumentType]
    except (ValueError, TypeError) as failure:
        raise OptionError(f"{where}: {failure}") from failure


def _meant(name: str, known: list[str]) -> str:
    """Return the known dotted name that was probably meant, by its last part first, as a question."""
    by_leaf = {each.rpartition(".")[2]: each for each in known}
    leaf = likeliest(name.rpartition(".")[2], by_leaf)
    near = likeliest(name, known) if leaf is None else by_leaf[leaf]
    return f"; did you mean {near}?" if near else f"; known: {', '.join(known[:8])} and others (docs/USAGE.md)."


def _typed(value: Any, kind: Any, where: str) -> Any:
    """Return a value of a field's type: number, text, truth value, one of several texts, tuple, or table of these."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        kinds = [each for each in arguments if each is not type(None)]
        return _typed(value, kinds[0], where)
    allowed = str(getattr(kind, "__name__", kind))
    if origin is Mapping:
        if isinstance(value, Mapping):
            return {name: _typed(item, arguments[1], f"{where}.{name}") for name, item in leaves(value)}
        allowed = "a table of names"
    elif origin is Literal:
        if value in arguments:
            return value
        allowed = f"one of {', '.join(map(repr, arguments))}"
    elif origin is tuple and not isinstance(value, list | tuple):
        allowed = "a list, such as [0, 0, -9.81]"
    elif origin is tuple:
        items = arguments[:1] * len(value) if arguments[-1] is Ellipsis else arguments
        if len(items) == len(value):
            return tuple(_typed(item, each, where) for item, each in zip(value, items, strict=True))
        allowed = f"{len(items)} values"
    elif kind is float:
        if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max:
            return float(value)
        allowed = "a finite number"
    elif kind is int:
        if isinstance(value, int) and not isinstance(value, bool):
            return value
        allowed = "a whole number"
    elif kind is bool:
        if isinstance(value, bool):
            return value
        allowed = "true or false"
    elif kind is str and isinstance(value, str):
        return value
    raise OptionError(f"{where} must be {allowed}; got {repr(value)[:MAX_SHOWN]}.")
