"""Study of whether closing the loop names the effects that a scene holds and nobody declares."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from scipy.stats import norm

from jiggle_mj.episode import observe
from jiggle_mj.estimator.attribution.close_loop import UNEXPLAINED
from jiggle_mj.recording.declaration import is_current
from jiggle_mj.recording.mcap_files import truth_path
from jiggle_mj.scenes import Reference, programme

from ..metrics.result_file import MADE_BY, read_json
from ..runs.closing_the_loop import DISCREPANCY, close_loop
from ..runs.compiled_functions import drop_many_compiled
from .coarse_layouts import rough_bed
from .study import Study, Table
from .undeclared_panel import (
    IMAGES,
    INSIDE,
    ON_LAYOUTS,
    OUTSIDE,
    ROWS,
    TOGETHER,
    USUAL_GROUPS,
    PanelRow,
    rows_of,
    scene_with,
)

COVERAGE = 0.95
"""Probability that the intervals of an effect's parameters are meant to hold."""
SHOWN_PARAMETERS = 3
"""Parameters of an effect that a cell shows; more are cut off."""

Discrepancy = Mapping[str, Any]
"""Content of discrepancy.json."""


@dataclass(frozen=True, kw_only=True)
class UndeclaredCell:
    """One run: a row of the panel and a seed."""

    row: str
    """Name of the panel's row."""
    seed: int
    """Seed of mesh, noise and scene."""


@dataclass(frozen=True, kw_only=True)
class UndeclaredStudy(Study[UndeclaredCell, Discrepancy]):
    """Study of undeclared effects."""

    default_seeds: ClassVar[range] = range(5)
    rows: tuple[str, ...] = rows_of(USUAL_GROUPS)
    """Names of the panel's rows."""

    def cells(self, seeds: Iterable[int]) -> tuple[UndeclaredCell, ...]:
        """Return every row with every seed."""
        return tuple(UndeclaredCell(row=row, seed=seed) for row, seed in product(self.rows, seeds))

    def name(self, cell: UndeclaredCell) -> str:
        """Return the run's folder name."""
        return f"{cell.row.replace(',', '').replace(' ', '_')}-{cell.seed}"

    def run_cell(self, cell: UndeclaredCell, path: Path) -> None:
        """Record the row's scene, and close the loop over the recording."""
        path.mkdir(parents=True, exist_ok=True)
        drop_many_compiled()
        scene, recording = scene_with(cell.row, cell.seed), path / "run.mcap"
        with Reference(scene, seed=cell.seed, sensing=ROWS[cell.row].sensing) as reference:
            for _ in observe(reference, programme(scene), recording, seed=cell.seed, overwrite=True):
                pass
        close_loop(recording, path, truth=truth_path(recording), overwrite=True)

    def is_current(self, cell: UndeclaredCell, path: Path) -> bool:
        """Say whether this version wrote the folder's discrepancy.json."""
        file = path / DISCREPANCY
        return file.exists() and is_current(read_json(file, MADE_BY))

    def read(self, cell: UndeclaredCell, path: Path) -> Discrepancy:
        """Read discrepancy.json."""
        return read_json(path / DISCREPANCY, MADE_BY)

    def summarise(self, results: Mapping[UndeclaredCell, Discrepancy]) -> Table:
        """Return a row for each row of the panel, and sums over its groups beneath."""
        rows = []
        for name in dict.fromkeys(cell.row for cell in results):
            runs = [found for cell, found in results.items() if cell.row == name]
            errors = [(1e3 * run["held_out"]["before_rms_m"], 1e3 * run["held_out"]["after_rms_m"]) for run in runs]
            rows.append(
                (
                    name,
                    _counted([", ".join(named(run)) or "nothing" for run in runs]),
                    _counted([run["verdict"] for run in runs]),
                    "; ".join(_theta(run) for run in runs),
                    "; ".join(f"{before:.2f} → {after:.2f}" for before, after in errors),
                    "; ".join(f"{_pug(run, 'before')} → {_pug(run, 'after')}" for run in runs),
                )
            )
        held_out = "held-out mm, before → after"
        return Table(
            headings=("undeclared", "named (of seeds)", "verdicts", "theta (sd)", held_out, "PUG at one ring"),
            rows=tuple(rows),
            beneath=("", *_sums(results)),
        )


def _listed(cell: UndeclaredCell, found: Discrepancy) -> Discrepancy:
    """Return what a run found, without the friction of a rough bed where its row does not list it."""
    row = ROWS[cell.row]
    if row.coarse_layout is None or not rough_bed(cell.seed) or "friction" in row.effects:
        return found
    return {
        **found,
        "effects": [effect for effect in found["effects"] if effect["name"] != "friction"],
        "ambiguous_with": [name for name in found["ambiguous_with"] if name != "friction"],
    }


def named(found: Discrepancy) -> list[str]:
    """Return the effects that a run names, and those that the data cannot distinguish from them."""
    return [effect["name"] for effect in found["effects"]] + found["ambiguous_with"]


Runs = list[tuple[PanelRow, Discrepancy]]


def _sums(results: Mapping[UndeclaredCell, Discrepancy]) -> list[str]:
    sentences = []
    on_layouts = {name: row for name, row in ON_LAYOUTS.items() if row.effects}
    groups = (("One effect", INSIDE), ("Two effects", TOGETHER), ("One effect, from images", IMAGES))
    for what, rows in (*groups, ("One effect, on several layouts", on_layouts)):
        if runs := [(ROWS[cell.row], _listed(cell, found)) for cell, found in results.items() if cell.row in rows]:
            gained = _gained([found for _, found in runs])
            sentences.append(f"{what}: {_right(runs)}; {gained}; {_covered(runs)}.")
    nothing = [
        _listed(cell, found) for cell, found in results.items() if not (ROWS[cell.row].effects or cell.row in OUTSIDE)
    ]
    if nothing:
        named_runs = sum(bool(found["effects"]) for found in nothing)
        sentences.append(f"Nothing undeclared: {named_runs} of {len(nothing)} named.")
    if outside := [found for cell, found in results.items() if cell.row in OUTSIDE]:
        honest = sum(found["verdict"] in UNEXPLAINED for found in outside)
        sentences.append(f"Not in the library: {honest} of {len(outside)} unexplained or with a remainder.")
    return sentences


def _right(runs: Runs) -> str:
    """Say how often each effect of a row was added, and how often it was among those named."""
    added = sum({effect["name"] for effect in found["effects"]} >= set(row.effects) for row, found in runs)
    first = sum(found["effects"][:1] != [] and found["effects"][0]["name"] in row.effects for row, found in runs)
    among = sum(set(named(found)) >= set(row.effects) for row, found in runs)
    return f"named first in {first} of {len(runs)}, all added in {added}, all among those named in {among}"


def _covered(runs: Runs) -> str:
    """Say how many parameters with a true value lie within their interval, over the effects that were added."""
    within = [
        abs(theta - true) <= norm.ppf((1 + COVERAGE) / 2) * sd
        for row, found in runs
        for effect in found["effects"]
        for theta, sd, true in zip(effect["theta"], effect["sd"], row.sizes.get(effect["name"], ()), strict=False)
    ]
    return f"{sum(within)} of {len(within)} parameters within their {100 * COVERAGE:g} % interval"


def _gained(runs: list[Discrepancy]) -> str:
    gains = [1 - run["held_out"]["after_rms_m"] / run["held_out"]["before_rms_m"] for run in runs]
    return f"held-out error falls by {np.median(gains):.0%} at the median, and rises in {sum(g < 0 for g in gains)}"


def _counted(texts: list[str]) -> str:
    return "; ".join(f"{text} ({texts.count(text)})" for text in dict.fromkeys(texts))


def _theta(found: Discrepancy) -> str:
    if not found["effects"]:
        return "-"
    first = found["effects"][0]
    values = [f"{value:.3g} ({sd:.2g})" for value, sd in zip(first["theta"], first["sd"], strict=True)]
    return ", ".join(values[:SHOWN_PARAMETERS]) + (" …" if len(values) > SHOWN_PARAMETERS else "")


def _pug(found: Discrepancy, when: str) -> str:
    pug = found[f"detection_{when}"]["by_dilation"]["1"]["pug"]
    return "-" if pug is None else f"{pug:.2f}"
