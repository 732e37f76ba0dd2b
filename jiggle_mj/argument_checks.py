"""Checks of arguments at construction: each returns the value in its stored type, or refuses it by name.

A list stands for an array where that is harmless. Type checkers see annotations and users at run time do not, so public
constructors check what they are given. No check copies an array that is right already.
"""

import math
import os
from collections.abc import Callable
from contextlib import suppress
from operator import index
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from jaxtyping import Shaped

from .errors import MAX_SHOWN, JiggleError, OptionError
from .likely_name import did_you_mean

T = TypeVar("T")
Kind = Literal["numbers", "whole numbers", "booleans", "uint8"]
"""What an array holds."""
DTYPE_KINDS: dict[Kind, str] = {"numbers": "fiu", "whole numbers": "iu", "booleans": "b", "uint8": "u"}
"""Kinds of NumPy data types that pass as each; whole numbers pass as numbers."""


def quoted(value: object) -> str:
    """Return a wrong value for a message, at most `MAX_SHOWN` characters long: an array by its type and shape."""
    if isinstance(value, np.ndarray) and (value.ndim != 1 or value.size > 4):
        return f"an array of {value.dtype} {value.shape}"
    try:
        short = value[:MAX_SHOWN] if isinstance(value, str | bytes) else value
        text = repr(short.tolist() if isinstance(short, np.ndarray) else short)
    except Exception:
        text = f"a {type(value).__name__}"
    text = " ".join(text.split())
    return text if len(text) <= MAX_SHOWN else f"{text[: MAX_SHOWN - 3]}..."


def as_array(
    value: object,
    where: str,
    shape: tuple[int | None, ...],
    *,
    kind: Kind = "numbers",
    finite: bool = True,
    error: type[JiggleError] = OptionError,
) -> Shaped[np.ndarray, "..."]:
    """Return a value as an array.

    Args:
        value: an array, or nested lists.
        where: the argument's name, for the message.
        shape: its shape; None for any length.
        kind: what it holds; floats keep their precision, `uint8` must have that type already.
        finite: refuse NaN and infinity.
        error: the error to raise.

    Raises:
        JiggleError: `error`, where the shape, the type or a number is another.
    """
    expected = "(" + ", ".join("n" if n is None else str(n) for n in shape) + ("," if len(shape) == 1 else "") + ")"
    allowed = f"an array of {kind} of shape {expected}"
    if value is None:
        raise error(f"{where} must be {allowed}; got None.")
    try:
        array = np.asarray(value)
    except Exception as failure:
        raise error(f"{where} must be {allowed}; got {quoted(value)}.") from failure
    if array.size == 0 and not isinstance(value, np.ndarray):
        array = array.astype({"f": float, "i": np.int64, "b": bool, "u": np.uint8}[DTYPE_KINDS[kind][0]])
    right_type = array.dtype.kind in DTYPE_KINDS[kind] and (kind != "uint8" or array.dtype == np.uint8)
    right_shape = array.ndim == len(shape) and all(
        n is None or n == given for n, given in zip(shape, array.shape, strict=False)
    )
    if not (right_type and right_shape):
        raise error(f"{where} must be {allowed}; got {quoted(array if array.ndim else value)}.")
    if kind == "numbers" and array.dtype.kind != "f":
        array = array.astype(float)
    if kind == "whole numbers" and array.dtype.kind == "u":
        array = array.astype(np.int64)  # differences of unsigned numbers are never below 0
    if finite and kind == "numbers" and not np.isfinite(array).all():
        raise error(f"{where} must hold finite numbers only; {_first_not_finite(array)}.")
    return array


def as_number(
    value: object,
    where: str,
    *,
    unit: str = "",
    above: float = -math.inf,
    at_least: float = -math.inf,
    below: float = math.inf,
    error: type[JiggleError] = OptionError,
) -> float:
    """Return a finite number within bounds.

    Raises:
        JiggleError: `error`, where it is no number, not finite, or out of bounds.
    """
    number = math.nan
    if isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool):
        with suppress(OverflowError):  # an integer beyond the largest float
            number = float(value)
    if math.isfinite(number) and above < number < below and number >= at_least:
        return number
    bounds = [
        text
        for text, bounded in (
            (f"above {above:g}", above > -math.inf),
            (f"at least {at_least:g}", at_least > -math.inf),
            (f"below {below:g}", below < math.inf),
        )
        if bounded
    ]
    allowed = " and ".join([*bounds, "finite"]) if bounds else "a finite number"
    raise error(f"{where} must be {allowed}{f', in {unit}' if unit else ''}; got {quoted(value)}.")


def as_integer(
    value: object, where: str, *, at_least: int | None = None, error: type[JiggleError] = OptionError
) -> int:
    """Return a whole number; true and false are none, and neither is 3.0.

    Raises:
        JiggleError: `error`, where it is no whole number, or too small.
    """
    try:
        whole = None if isinstance(value, bool) else index(value)  # type: ignore[arg-type]
    except TypeError:
        whole = None
    if whole is None or (at_least is not None and whole < at_least):
        bound = "" if at_least is None else f" of at least {at_least}"
        raise error(f"{where} = {quoted(value)}: must be an integer{bound}.")
    return whole


def as_flag(value: object, where: str, *, error: type[JiggleError] = OptionError) -> bool:
    """Return true or false.

    Raises:
        JiggleError: `error`, where it is neither.
    """
    if not isinstance(value, bool | np.bool_):
        raise error(f"{where} must be True or False; got {quoted(value)}.")
    return bool(value)


def as_choice(value: object, where: str, among: tuple[str, ...], *, error: type[JiggleError] = OptionError) -> Any:
    """Return one of the words `among`.

    Raises:
        JiggleError: `error`, where it is none of them; the message has the likely one.
    """
    if not isinstance(value, str) or value not in among:
        raise error(
            f"{where} = {quoted(value)}: must be one of {', '.join(map(repr, among))}{did_you_mean(value, among)}"
        )
    return value


def as_instance(
    value: object,
    where: str,
    cls: type[T],
    *,
    hint: str = "",
    error: type[JiggleError] = OptionError,
) -> T:
    """Return an object of a class; `hint` says how to make one.

    Raises:
        JiggleError: `error`, where it is an object of another class.
    """
    if not isinstance(value, cls):
        article = "an" if cls.__name__[0] in "AEIOU" else "a"
        raise error(f"{where} must be {article} {cls.__name__}; got {quoted(value)}.{f' {hint}' if hint else ''}")
    return value


def as_tuple_of(
    value: object, where: str, classes: type | tuple[type, ...], *, error: type[JiggleError] = OptionError
) -> tuple[Any, ...]:
    """Return a list or tuple of objects of some classes as a tuple.

    Raises:
        JiggleError: `error`, where it is no list or tuple, or an entry is of another class.
    """
    names = " or ".join(cls.__name__ for cls in (classes if isinstance(classes, tuple) else (classes,)))
    if not isinstance(value, list | tuple) or not all(isinstance(entry, classes) for entry in value):
        raise error(f"{where} must be a tuple of {names}; got {quoted(value)}.")
    return tuple(value)


def as_path(value: object, where: str, *, error: type[JiggleError] = OptionError) -> Path:
    """Return a path that is given as a text or a path.

    Raises:
        JiggleError: `error`, where it is something else.
    """
    if not isinstance(value, str | os.PathLike):
        raise error(f"{where} must be a path; got {quoted(value)}.")
    return Path(value)


def as_function(value: object, where: str, *, error: type[JiggleError] = OptionError) -> Callable[..., Any]:
    """Return an object that can be called.

    Raises:
        JiggleError: `error`, where it cannot.
    """
    if not callable(value):
        raise error(f"{where} must be a function; got {quoted(value)}.")
    return value


def store(frozen: object, **values: object) -> None:
    """Set fields of a frozen dataclass while it is constructed."""
    for name, value in values.items():
        object.__setattr__(frozen, name, value)


def _first_not_finite(array: Shaped[np.ndarray, "..."]) -> str:
    place = tuple(int(axis[0]) for axis in np.nonzero(~np.isfinite(array)))
    return f"[{', '.join(map(str, place))}] is {array[place]}"
