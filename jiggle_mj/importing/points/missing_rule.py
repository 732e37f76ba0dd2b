"""The key `missing` of `[points]`: which finite coordinates stand for a point that was not seen."""

import operator
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from ... import toml_kinds as kinds
from ...errors import RecordingError
from ..data_folder import quoted

OPERATORS: dict[str, Callable[[Any, Any], Any]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<=": operator.le,
    ">=": operator.ge,
    "<": operator.lt,
    ">": operator.gt,
}
"""Comparisons of a rule, the longer signs first."""
RULE = re.compile(r"\s*(?P<column>.*?)\s*(?P<sign>==|!=|<=|>=|<|>)\s*(?P<value>[^=<>]+?)\s*")
"""A rule is written `COLUMN OPERATOR NUMBER`."""
AXES = ("x", "y", "z")
"""Names of the coordinates in a rule, and in headings where the user names no columns."""
FLOAT32_ROUNDING = 1e-6
"""Relative difference between a number and what a file of 32-bit floats holds of it."""


@dataclass(frozen=True, kw_only=True)
class MissingRule:
    """Which points are unseen: those at a place, those whose value in a column compares with a number, or none."""

    place: tuple[float, float, float] | None = None
    """Coordinates of unseen points, in the unit of the data."""
    column: str | None = None
    """Heading or number of a column, name of an array in the archive, or x, y or z."""
    sign: str = "=="
    """A key of `OPERATORS`."""
    value: float = 0.0
    """Number with which the column is compared."""

    def unseen_by_place(self, positions: Float[np.ndarray, "t n 3"]) -> Bool[np.ndarray, "t n"]:
        """Return which positions are at the rule's place, to the rounding of a file."""
        if self.place is None:
            return np.zeros(positions.shape[:2], bool)
        place = np.array(self.place)
        return np.asarray(np.all(np.abs(positions - place) <= FLOAT32_ROUNDING * np.abs(place), axis=2))

    def unseen_by_value(self, values: Float[np.ndarray, "t n"]) -> Bool[np.ndarray, "t n"]:
        """Return where the values of the rule's column compare as the rule says."""
        return OPERATORS[self.sign](values, self.value)


def read_missing(value: Any, where: str) -> MissingRule:
    """Return the rule that a value of `missing` states.

    Args:
        value: `"none"`; a number, which all three coordinates have; three numbers; or `"COLUMN OPERATOR NUMBER"`.
        where: the table, for errors.

    Raises:
        RecordingError: the value is none of these.
    """
    try:
        if isinstance(value, list):
            x, y, z = kinds.vector(value)
            return MissingRule(place=(x, y, z))
        if not isinstance(value, str):
            number = kinds.number(value)
            return MissingRule(place=(number, number, number))
        if value == "none":
            return MissingRule()
        rule = RULE.fullmatch(value)
        if rule and rule["column"]:
            return MissingRule(column=rule["column"], sign=rule["sign"], value=kinds.number(float(rule["value"])))
    except (TypeError, ValueError, OverflowError):
        pass
    raise RecordingError(
        f'{where} missing must be "COLUMN OPERATOR NUMBER", as "sigma == -1", a number that x, y and z all have, three '
        f'numbers, or "none"; got {quoted(value)}.'
    )
