"""Strict reading of TOML tables: every key has a kind, and an unknown key is an error.

A kind is a function that returns the value, or raises `TypeError` with the description of an allowed value.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from .argument_checks import quoted
from .errors import RecordingError
from .likely_name import did_you_mean, likeliest

MAX_COUNT = (1 << 31) - 1
"""Largest whole number: signed 32 bits, in which recordings store numbers of points and grasps."""
MISSPELT = 0.75
"""Likeness from which a given key is offered for one that is missing: `units` is like `unit`, `time_unit` is not."""
REQUIRED = object()
"""Default of a key without a default."""


class StrictTable:
    """A table of a TOML file that remembers which of its keys were read."""

    def __init__(self, values: dict[str, Any], where: str, *, given: bool = True) -> None:
        self.values, self.where, self.given, self.known = values, where, given, set[str]()

    def take(self, key: str, kind: Callable[[Any], Any], default: Any = REQUIRED) -> Any:
        """Return the value of a key, or the default where the key is missing.

        Raises:
            RecordingError: the key is missing without a default, or its value is not of that kind.
        """
        self.known.add(key)
        if key not in self.values:
            if default is REQUIRED:
                given = likeliest(key, set(self.values) - self.known, likeness=MISSPELT)
                meant = "." if given is None else f"; did you write {quoted(given)} for it?"
                raise RecordingError(f"{self.where} lacks the key '{key}'{meant}")
            return default
        try:
            return kind(self.values[key])
        except TypeError as failure:
            raise RecordingError(f"{self.where} {key} must be {failure}; got {quoted(self.values[key])}.") from failure

    def table(self, key: str, *, optional: bool = False) -> "StrictTable":
        """Return the table under a key; an optional table that is missing is empty."""
        values = self.take(key, table, {} if optional else REQUIRED)
        path = self.where.partition(" [")[2].rstrip("]")
        inner = f"{path}.{key}" if path else key
        return StrictTable(values, f"{self.where.partition(' [')[0]} [{inner}]", given=key in self.values)

    def direction(self, key: str) -> Float[np.ndarray, " 3"]:
        """Return the unit vector along a key's three numbers."""
        given = np.array(self.take(key, vector))
        length = np.linalg.norm(given)
        if not length > 0:
            raise RecordingError(f"{self.where} {key} must be a vector that is not zero; got {given.tolist()}.")
        return given / length

    def refuse_unknown(self) -> None:
        """Refuse keys that were not read.

        Raises:
            RecordingError: a key is unknown; names the first one, and all known keys.
        """
        unknown = sorted(set(self.values) - self.known)
        if unknown:
            raise RecordingError(
                f"{self.where} has the unknown key {quoted(unknown[0])}{did_you_mean(unknown[0], self.known)} Known: "
                f"{', '.join(sorted(self.known))}."
            )


def text(value: Any) -> str:
    """Return a string."""
    if not isinstance(value, str):
        raise TypeError("a text")
    return value


def texts(value: Any) -> tuple[str, ...]:
    """Return a list of strings as a tuple."""
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise TypeError("a list of texts")
    return tuple(value)


def flag(value: Any) -> bool:
    """Return true or false."""
    if not isinstance(value, bool):
        raise TypeError("true or false")
    return value


def number(value: Any) -> float:
    """Return a finite number."""
    return _finite(value, "a number")


def positive(value: Any) -> float:
    """Return a finite number above 0."""
    real = _finite(value, "a number above 0")
    if not real > 0:
        raise TypeError("a number above 0")
    return real


def not_negative(value: Any) -> float:
    """Return a finite number of at least 0."""
    real = _finite(value, "a number from 0")
    if not real >= 0:
        raise TypeError("a number from 0")
    return real


def integer(value: Any) -> int:
    """Return an integer that fits 32 bits; a float that is whole counts, as some writers of JSON know no others."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= MAX_COUNT or value % 1:
        raise TypeError(f"a whole number from -{MAX_COUNT} to {MAX_COUNT}")
    return int(value)


def count(value: Any) -> int:
    """Return an integer from 0 to `MAX_COUNT`."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MAX_COUNT:
        raise TypeError("a whole number from 0")
    return value


def counts(value: Any) -> list[int]:
    """Return a list of integers of at least 0."""
    if not isinstance(value, list):
        raise TypeError("a list of whole numbers")
    return [count(item) for item in value]


def vector(value: Any) -> list[float]:
    """Return three numbers."""
    if not isinstance(value, list) or len(value) != 3:
        raise TypeError("three numbers")
    return [number(item) for item in value]


def numbers(value: Any) -> list[float]:
    """Return a list of numbers."""
    if not isinstance(value, list):
        raise TypeError("a list of numbers")
    return [number(item) for item in value]


def matrix(value: Any) -> list[list[float]]:
    """Return three rows of three numbers."""
    if not isinstance(value, list) or len(value) != 3:
        raise TypeError("three rows of three numbers")
    return [vector(row) for row in value]


def table(value: Any) -> dict[str, Any]:
    """Return a table as it is."""
    if not isinstance(value, dict):
        raise TypeError("a table")
    return value


def tables(value: Any) -> list[dict[str, Any]]:
    """Return a list of tables as it is."""
    if not isinstance(value, list):
        raise TypeError("a list of tables")
    return [table(item) for item in value]


def _finite(value: Any, kind: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(kind)
    try:
        real = float(value)
    except OverflowError:
        raise TypeError(kind) from None
    if not math.isfinite(real):
        raise TypeError(kind)
    return real
