"""Settings from the command line: `--declare`, `--config` and `--set`."""

import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import MAX_SHOWN, OptionError
from ..nested_settings import nested, with_settings
from ..options import FilterName

if TYPE_CHECKING:
    from jiggle_mj.estimator import EstimatorConfig

MAX_FILE_BYTES = 2**20
"""Largest file of settings [bytes]."""


def declared(assignments: Iterable[str]) -> dict[str, Any]:
    """Return the declared properties of `--declare NAME=VALUE` by name.

    Raises:
        OptionError: no assignment, an unknown name, or a value that a declaration refuses.
    """
    from ..observation import Declaration

    given = _assignments(assignments, "--declare")
    if "mesh" in given:
        raise OptionError("--declare mesh: a mesh is declared in the recording; see [mesh] in docs/RECORDINGS.md.")
    checked = with_settings(Declaration(), given, where="--declare")
    return {name: getattr(checked, name) for name in given}


def configured(path: Path | None, assignments: Iterable[str], estimator: FilterName) -> "EstimatorConfig":
    """Return the estimator's settings: those of a file, then those of `--set NAME=VALUE` over them.

    Args:
        path: a TOML file with the tables of `EstimatorConfig`; None for the defaults.
        assignments: dotted names and values.
        estimator: the filter, where neither names one.

    Raises:
        OptionError: the file cannot be read, or a name or value is refused.
    """
    from jiggle_mj.estimator import EstimatorConfig

    config = EstimatorConfig(filter=estimator)
    if path is not None:
        config = with_settings(config, _table(path), where=f"--config {path}")
    return with_settings(config, nested(_assignments(assignments, "--set")), where="--set")


def _table(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise OptionError(f"--config {path} is larger than {MAX_FILE_BYTES} bytes; is it a file of settings?")
        return tomllib.loads(path.read_text())
    except OSError as failure:
        raise OptionError(f"--config {path} cannot be read: {failure.strerror}.") from failure
    except (ValueError, RecursionError) as failure:
        raise OptionError(f"--config {path} is no TOML: {str(failure)[:MAX_SHOWN]}.") from failure


def _assignments(texts: Iterable[str], option: str) -> dict[str, Any]:
    """Return NAME=VALUE texts by name; a value is read as TOML, or else is a text."""
    values: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (equals and name.strip() and value.strip()):
            raise OptionError(f"{option} {text[:MAX_SHOWN]}: write NAME=VALUE.")
        try:
            parsed = tomllib.loads(f"value = {value}")
        except (ValueError, RecursionError):
            parsed = {"value": value.strip()}
        values[name.strip()] = parsed["value"] if set(parsed) == {"value"} else value.strip()
    return values
