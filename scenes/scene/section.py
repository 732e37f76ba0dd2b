"""Checked fields of a scene: every key has a type and a range, in TOML and in Python alike.

A `Section` is a frozen dataclass whose fields are made by `number`, `integer`, `switch`, `choice`, `vector` and
`points`; construction checks them and raises a `SceneError` that names the key, the value and what is allowed.
"""

import math
from collections.abc import Callable
from dataclasses import MISSING, Field, dataclass, field, fields
from typing import Any, ClassVar

from jiggle_mj.argument_checks import quoted
from jiggle_mj.errors import SceneError
from jiggle_mj.toml_kinds import number as number_of

Check = Callable[[object], Any]
"""Function that returns the value in its stored type, or raises ValueError with what is allowed."""


def _real(value: object, allowed: str) -> float:
    try:
        return number_of(value)
    except TypeError:
        raise ValueError(allowed) from None


def _field(check: Check, default: object) -> Any:
    return field(default=default, metadata={"check": check})


def _interval(above: float | None, at_least: float | None, at_most: float | None, below: float | None) -> str:
    low = f"({above:g}" if above is not None else f"[{at_least:g}" if at_least is not None else "(-inf"
    high = f"{below:g})" if below is not None else f"{at_most:g}]" if at_most is not None else "inf)"
    return f"{low}, {high}"


def number(
    default: float | object = MISSING,
    *,
    unit: str = "",
    above: float | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
    below: float | None = None,
) -> Any:
    """Return a field for a finite number in an interval; without a default the key is required."""
    allowed = f"a number in {_interval(above, at_least, at_most, below)}{f' {unit}' if unit else ''}"

    def check(value: object) -> float:
        real = _real(value, allowed)
        outside = (
            (above is not None and real <= above)
            or (at_least is not None and real < at_least)
            or (at_most is not None and real > at_most)
            or (below is not None and real >= below)
        )
        if outside:
            raise ValueError(allowed)
        return real

    return _field(check, default)


def integer(default: int | object = MISSING, *, at_least: int, at_most: int) -> Any:
    """Return a field for a whole number in an interval."""
    allowed = f"a whole number in [{at_least}, {at_most}]"

    def check(value: object) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not at_least <= value <= at_most:
            raise ValueError(allowed)
        return value

    return _field(check, default)


def switch(default: bool | object = MISSING) -> Any:
    """Return a field for true or false."""

    def check(value: object) -> bool:
        if not isinstance(value, bool):
            raise ValueError("true or false")
        return value

    return _field(check, default)


def choice(default: str | object = MISSING, *, among: tuple[str, ...]) -> Any:
    """Return a field for one of the words `among`."""

    def check(value: object) -> str:
        if not isinstance(value, str) or value not in among:
            raise ValueError("one of " + ", ".join(repr(word) for word in among))
        return value

    return _field(check, default)


def vector(
    default: tuple[float, ...] | object = MISSING,
    *,
    length: int,
    unit: str = "",
    above: float = -math.inf,
    at_most: float = math.inf,
    direction: bool = False,
) -> Any:
    """Return a field for `length` finite numbers within the bounds given; not all 0 if they are a direction."""
    bound = f" in {_interval(above, None, at_most, None)}" if math.isfinite(above) or math.isfinite(at_most) else ""
    allowed = f"a list of {length} numbers{bound}{f' {unit}' if unit else ''}{', not all 0' if direction else ''}"

    def check(value: object) -> tuple[float, ...]:
        if not isinstance(value, list | tuple) or len(value) != length:
            raise ValueError(allowed)
        reals = tuple(_real(entry, allowed) for entry in value)
        if min(reals) <= above or max(reals) > at_most or (direction and not any(reals)):
            raise ValueError(allowed)
        return reals

    return _field(check, default)


def points(default: tuple[tuple[float, float], ...] | object = MISSING, *, at_least: int) -> Any:
    """Return a field for a list of points [x, y] in m."""
    allowed = f"a list of at least {at_least} points [x, y] in m"

    def check(value: object) -> tuple[tuple[float, ...], ...]:
        if not isinstance(value, list | tuple) or len(value) < at_least:
            raise ValueError(allowed)
        if any(not isinstance(point, list | tuple) or len(point) != 2 for point in value):
            raise ValueError(allowed)
        return tuple(tuple(_real(entry, allowed) for entry in point) for point in value)

    return _field(check, default)


def stiffness() -> Any:
    """Return a field for a spring constant per vertex [N/m], or a weld, which is stored as infinity."""
    allowed = "a number above 0 in N/m per vertex, or 'weld'"

    def check(value: object) -> float:
        if value == "weld" or value == math.inf:
            return math.inf
        real = _real(value, allowed)
        if real <= 0:
            raise ValueError(allowed)
        return real

    return _field(check, MISSING)


@dataclass(frozen=True, kw_only=True)
class Section:
    """One table of a scene file, checked when it is built.

    Raises:
        SceneError: a value has the wrong type or is out of its range.
    """

    section: ClassVar[str]
    """Name of the table; error messages begin with it."""

    def __post_init__(self) -> None:
        """Check every field and store it in its type."""
        for f in fields(self):
            object.__setattr__(self, f.name, checked(f, getattr(self, f.name), where=self.section))


def checked(f: Field[Any], value: object, *, where: str) -> Any:
    """Return the value of one field in its stored type.

    Raises:
        SceneError: it has the wrong type or is out of its range.
    """
    try:
        return f.metadata["check"](value)
    except ValueError as error:
        raise SceneError(f"{where}.{f.name} = {quoted(value)}: must be {error}.") from None
