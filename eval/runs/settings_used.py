"""The settings of a run, and where each came from, as the result files hold them."""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

from jiggle_mj.errors import OptionError
from jiggle_mj.estimator import EstimatorConfig
from jiggle_mj.nested_settings import dotted
from jiggle_mj.observation import Declaration

from ..metrics.result_file import Json


def with_declared(declaration: Declaration, declare: Mapping[str, Any] | None) -> Declaration:
    """Return a declaration with some properties replaced.

    Raises:
        OptionError: there is no such property, or its value is out of range.
    """
    if unknown := set(declare or {}) - {field.name for field in fields(Declaration)}:
        raise OptionError(f"declare: a declaration has no '{min(unknown)}'.")
    try:
        return replace(declaration, **(declare or {}))
    except ValueError as failure:
        raise OptionError(f"declare: {failure}") from failure


def settings_used(
    declaration: Declaration, config: EstimatorConfig, *, declare: Mapping[str, Any] | None, declared: bool
) -> Json:
    """Return the declared properties with their origin, and those settings of the estimator that are no defaults.

    Args:
        declaration: as it was used.
        config: as it was used.
        declare: properties that the caller or the command line gave.
        declared: whether the recording holds a declaration.
    """
    origin = "recording" if declared else "default"
    defaults = dict(dotted(EstimatorConfig()))
    properties = {field.name: getattr(declaration, field.name) for field in fields(declaration) if field.name != "mesh"}
    if not declaration.effects:
        del properties["effects"]
    return {
        "declaration": {
            name: {"value": list(value) if isinstance(value, tuple) else value,
                   "from": "argument" if name in (declare or {}) else origin}
            for name, value in properties.items()
        },
        "estimator": {name: value for name, value in dotted(config) if value != defaults[name]},
    }  # fmt: skip


def assumed(declaration: Declaration, *, declare: Mapping[str, Any] | None, declared: bool) -> str | None:
    """Return the sentence on what is assumed where neither recording nor caller declares the stiffness; else None."""
    if declared or "membrane_stiffness" in (declare or {}):
        return None
    return (
        f"membrane stiffness {declaration.membrane_stiffness:g} N/m assumed: b scales with it. The recording declares "
        "nothing; give what you know, --declare membrane_stiffness=..."
    )
