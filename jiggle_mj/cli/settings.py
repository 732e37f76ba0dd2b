"""Settings from the command line: `--declare`, `--config` and `--set`."""

import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import MAX_SHOWN, OptionError
from ..nested_settings import leaves, nested, with_settings
from ..options import FilterName
from ..recording.settings_file import read_table

if TYPE_CHECKING:
    from jiggle_mj.estimator import EstimatorConfig

FILE_SUFFIX = ".toml"
"""End of what `--declare` takes for a file."""


def declared(given: Iterable[str]) -> dict[str, Any]:
    """Return the declared properties of `--declare NAME=VALUE` and `--declare FILE.toml` by name, the last one counts.

    Raises:
        OptionError: no assignment, a file that cannot be read, an unknown name, or a value that a declaration refuses.
    """
    from ..recording.declaration_file import checked_properties

    values: dict[str, Any] = {}
    for text in given:
        is_file = Path(text).suffix == FILE_SUFFIX
        values |= dict(leaves(read_table(Path(text), "--declare"))) if is_file else _assignments([text], "--declare")
    return checked_properties(nested(values), where="--declare")


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
        config = with_settings(config, read_table(path, "--config"), where=f"--config {path}")
    return with_settings(config, nested(_assignments(assignments, "--set")), where="--set")


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
