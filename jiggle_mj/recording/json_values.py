"""JSON objects from files of unknown origin: every key has a kind, as in `toml_kinds`; nothing else gets through."""

import json
from collections.abc import Callable
from typing import Any

from ..argument_checks import quoted
from ..errors import RecordingError
from ..toml_kinds import REQUIRED

MAX_JSON_BYTES = 1 << 26
"""Longest JSON text that is read [byte]: 64 MiB, some thousand times a usual one."""


def parse_object(data: bytes | str, where: str, *, not_finite: bool = False) -> dict[str, Any]:
    """Return the JSON object in a text.

    Args:
        data: the text.
        where: what it is, for messages.
        not_finite: take NaN and Infinity, which are no JSON and which many programs write, as numbers.

    Raises:
        RecordingError: no JSON, NaN or Infinity in it that is not taken, nested too deeply, too long, or no object.
    """
    if len(data) > MAX_JSON_BYTES:
        raise RecordingError(f"{where} is JSON of {len(data)} bytes; at most {MAX_JSON_BYTES} are read.")
    try:
        value = json.loads(data, parse_constant=float if not_finite else _refuse_constant)
    except (ValueError, RecursionError) as failure:
        raise RecordingError(f"{where} is not JSON ({failure}): {quoted(data)}") from failure
    if not isinstance(value, dict):
        raise RecordingError(f"{where} is JSON, but no object {{...}}: {quoted(data)}")
    return value


def entry(values: dict[str, Any], key: str, kind: Callable[[Any], Any], where: str, default: Any = REQUIRED) -> Any:
    """Return the value of a key, or the default where the key is missing.

    Raises:
        RecordingError: the key is missing without a default, or its value is not of that kind.
    """
    if key not in values:
        if default is REQUIRED:
            raise RecordingError(f"{where} lacks '{key}'; it has {quoted(list(values))}.")
        return default
    try:
        return kind(values[key])
    except TypeError as failure:
        raise RecordingError(f"{where} has {key} = {quoted(values[key])}; it must be {failure}.") from failure


def parse_list(text: str, kind: Callable[[Any], Any], where: str) -> list[Any]:
    """Return the JSON list in a text, each item of a kind.

    Raises:
        RecordingError: no JSON list, or an item of another kind.
    """
    items = parse_object(f'{{"items": {text}}}', where)["items"]
    if not isinstance(items, list):
        raise RecordingError(f"{where} must be a JSON list; got {quoted(text)}.")
    return [entry({"item": item}, "item", kind, where) for item in items]


def optional(kind: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return the kind that also allows null."""
    return lambda value: None if value is None else kind(value)


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no JSON")
