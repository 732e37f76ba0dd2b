"""Figures of `result.json` as cells of a table, and whether a folder holds them."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from jiggle_mj.episode import ESTIMATE, RESULT, settings
from jiggle_mj.estimator import EstimatorConfig
from jiggle_mj.recording.declaration import version_entry
from jiggle_mj.recording.estimate import read_estimate

from ..metrics.result_file import Json, read_result

UNDEFINED = "\N{EN DASH}"
"""Cell of a figure that is not defined."""

Columns = Iterable[tuple[str, tuple[str, ...], float, int]]
"""Heading, place in result.json, factor and digits of each column."""


def is_scored(folder: Path, config: EstimatorConfig) -> bool:
    """Say whether a folder holds a run that was scored, made by this version with these settings."""
    if not (folder / RESULT).exists():
        return False
    figures, made_with = read_result(folder / RESULT), read_estimate(folder / ESTIMATE).metadata
    expected = settings(config) | version_entry()
    current = all(made_with.get(name) == expected_value for name, expected_value in expected.items())
    return current and value(figures, ("detection", "n_attached")) is not None


def value(run: Json, path: tuple[str, ...]) -> float | None:
    """Return the figure at a place of result.json; None where it is null or missing."""
    figure: object = run
    for key in path:
        figure = figure[key] if isinstance(figure, dict) else None
    return None if figure is None else float(str(figure))


def mean_and_range(values: Iterable[float | None], factor: float, digits: int) -> str:
    """Return the mean of the known values as text, and behind it their range where they differ.

    Args:
        values: None where a figure is not defined.
        factor: multiplies each, for the unit of the table.
        digits: after the decimal point.
    """
    known = factor * np.array([value for value in values if value is not None])
    if not len(known):
        return UNDEFINED
    mean, low, high = (f"{number:.{digits}f}" for number in (known.mean(), known.min(), known.max()))
    return mean if low == high else f"{mean} ({low}…{high})"


def figure_cells(runs: Iterable[Json], columns: Columns) -> list[str]:
    """Return the mean and range over runs for each column."""
    runs = tuple(runs)
    return [mean_and_range([value(run, path) for run in runs], factor, digits) for _, path, factor, digits in columns]
