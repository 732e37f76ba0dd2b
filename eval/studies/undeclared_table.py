"""Whether closing the loop names what a scene holds and nobody declares: the panel, run and counted."""

import json
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import norm

from jiggle_mj.episode import observe
from jiggle_mj.estimator.attribution.closing import UNEXPLAINED
from jiggle_mj.recording.declaration import is_current
from jiggle_mj.recording.mcap_files import truth_path
from jiggle_mj.scenes import Reference, programme

from ..runs.closing_the_loop import DISCREPANCY, close_loop
from .main_table import carry_out
from .undeclared_panel import IMAGES, INSIDE, NOTHING, OUTSIDE, ROWS, TOGETHER, PanelRow, scene_with

Found = dict[tuple[str, int], dict[str, Any]]
"""discrepancy.json by what is undeclared and seed."""


def measure(
    names: Iterable[str], seeds: Iterable[int], directory: Path, *, executor: Executor, log: Callable[[str], None]
) -> Found:
    """Run what has not been run by this version, and read all of it.

    Args:
        names: of the panel's rows.
        seeds: of mesh, noise and scene.
        directory: holds a folder for each.
        executor: runs several at a time.
        log: told of each that is done.
    """
    folders = {(name, seed): directory / _folder(name, seed) for name, seed in product(names, seeds)}
    left = {
        folder.name: partial(_run, *key, folder) for key, folder in folders.items() if not _done(folder / DISCREPANCY)
    }
    carry_out(left, executor, log=log)
    return {key: json.loads((folder / DISCREPANCY).read_text()) for key, folder in folders.items()}


def _folder(name: str, seed: int) -> str:
    return f"{name.replace(',', '').replace(' ', '_')}-{seed}"


def _done(file: Path) -> bool:
    return file.exists() and is_current(json.loads(file.read_text()))


def _run(undeclared: str, seed: int, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    scene, recording = scene_with(undeclared, seed), folder / "run.mcap"
    with Reference(scene, seed=seed, sensing=ROWS[undeclared].sensing) as reference:
        for _ in observe(reference, programme(scene), recording, seed=seed, overwrite=True):
            pass
    close_loop(recording, folder, truth=truth_path(recording), overwrite=True)


def named(found: Mapping[str, Any]) -> list[str]:
    """Effects that a run names, with those that they could not be told from."""
    return [one["name"] for one in found["effects"]] + found["ambiguous_with"]


def markdown(runs: Found) -> str:
    """A line for each that was undeclared, and sums."""
    lines = [
        "| undeclared | named (of seeds) | verdicts | theta (sd) | held-out mm, before → after | PUG at one ring |",
        "|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(name for name, _ in runs):
        mine = [found for (one, _), found in runs.items() if one == name]
        held = [(1e3 * one["held_out"]["before_rms_m"], 1e3 * one["held_out"]["after_rms_m"]) for one in mine]
        cells = [
            _counted([", ".join(named(one)) or "nothing" for one in mine]),
            _counted([one["verdict"] for one in mine]),
            "; ".join(_theta(one) for one in mine),
            "; ".join(f"{before:.2f} → {after:.2f}" for before, after in held),
            "; ".join(f"{_pug(one, 'before')} → {_pug(one, 'after')}" for one in mine),
        ]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, "", *_sums(runs)])


def _sums(runs: Found) -> list[str]:
    said = []
    for what, rows in (("One effect", INSIDE), ("Two effects", TOGETHER), ("One effect, from images", IMAGES)):
        if mine := [(ROWS[name], found) for (name, _), found in runs.items() if name in rows]:
            said.append(f"{what}: {_right(mine)}; {_gained([found for _, found in mine])}; {_covered(mine)}.")
    if nothing := [found for (name, _), found in runs.items() if name in NOTHING]:
        said.append(f"Nothing undeclared: {sum(bool(one['effects']) for one in nothing)} of {len(nothing)} named.")
    if outside := [found for (name, _), found in runs.items() if name in OUTSIDE]:
        honest = sum(one["verdict"] in UNEXPLAINED for one in outside)
        said.append(f"Not in the library: {honest} of {len(outside)} unexplained or with a remainder.")
    return said


def _right(runs: list[tuple[PanelRow, dict[str, Any]]]) -> str:
    """How often each effect of a row was added, and how often it was among those named."""
    added = sum({one["name"] for one in found["effects"]} >= set(row.effects) for row, found in runs)
    first = sum(found["effects"][:1] != [] and found["effects"][0]["name"] in row.effects for row, found in runs)
    among = sum(set(named(found)) >= set(row.effects) for row, found in runs)
    return f"named first in {first} of {len(runs)}, all added in {added}, all among those named in {among}"


def _covered(runs: list[tuple[PanelRow, dict[str, Any]]]) -> str:
    """How many parameters of effects that were added lie within 95 % intervals, of those with a true value."""
    within = [
        abs(theta - true) <= norm.ppf(0.975) * sd
        for row, found in runs
        for one in found["effects"]
        for theta, sd, true in zip(one["theta"], one["sd"], row.sizes.get(one["name"], ()), strict=False)
    ]
    return f"{sum(within)} of {len(within)} parameters within their 95 % interval"


def _gained(runs: list[dict[str, Any]]) -> str:
    gains = [1 - one["held_out"]["after_rms_m"] / one["held_out"]["before_rms_m"] for one in runs]
    return f"held-out error falls by {np.median(gains):.0%} at the median, and rises in {sum(g < 0 for g in gains)}"


def _counted(what: list[str]) -> str:
    return "; ".join(f"{one} ({what.count(one)})" for one in dict.fromkeys(what))


def _theta(found: Mapping[str, Any]) -> str:
    if not found["effects"]:
        return "-"
    one = found["effects"][0]
    values = [f"{value:.3g} ({sd:.2g})" for value, sd in zip(one["theta"], one["sd"], strict=True)]
    return ", ".join(values[:3]) + (" …" if len(values) > 3 else "")


def _pug(found: Mapping[str, Any], when: str) -> str:
    pug = found[f"detection_{when}"]["by_dilation"]["1"]["pug"]
    return "-" if pug is None else f"{pug:.2f}"
