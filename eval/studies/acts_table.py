"""Whether a cut or suture that failed is noticed: acts that worked beside the same acts without any effect.

A scene is lifted at its corners and judged. Then one place at a time is cut that is believed attached, or sewn that is
believed free, in a copy of the tissue and in another copy where the estimator is told so and nothing is done; the two
nearest corners are lifted again, and the evidence is asked which it was.
"""

import copy
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jiggle_mj.actions import Action, Cut, Suture, Wait
from jiggle_mj.estimator import Estimator
from jiggle_mj.estimator.physics.mesh import SheetMesh
from jiggle_mj.estimator.planning.procedures import CUT_WIDTH, free_stretch, tour
from jiggle_mj.recording.declaration import is_current, made_by
from jiggle_mj.scenes import Reference, load_scene
from jiggle_mj.scenes.scene.programme import grasp_points, programme
from jiggle_mj.scenes.scene.scene import Scene

from .main_table import carry_out

SCENES = ("arc", "line", "line_dot", "arc_line", "u_shape")
PLACES = 2
"""Cuts, and sutures, of each scene and seed."""
CUT = 12
"""Particles believed attached that are cut, those nearest to one of them."""
LIFTED = 2
"""Corners, the nearest to an act, that are lifted after it."""
ALARMS = 0.01
"""Share of the acts that worked which may be taken for failed."""


@dataclass(frozen=True)
class Verdict:
    """What the evidence said of one act."""

    kind: str
    """Cut or Suture."""
    works: bool
    """The truth."""
    log_bayes_factor: float
    """Of 'it worked' against 'nothing changed'."""


Verdicts = dict[tuple[str, int], list[Verdict]]
"""By scene and seed."""


def measure(
    scenes: Iterable[str], seeds: Iterable[int], directory: Path, *, executor: Executor, log: Callable[[str], None]
) -> Verdicts:
    """Run what has not been run by this version, and read all of it.

    Args:
        scenes: to run.
        seeds: of noise and places.
        directory: holds a file for each scene and seed.
        executor: runs several at a time.
        log: told of each that is done.
    """
    files = {(scene, seed): directory / f"{scene}-{seed}.json" for scene, seed in product(scenes, seeds)}
    left = {file.stem: partial(_run, *key, file) for key, file in files.items() if _read(file) is None}
    directory.mkdir(parents=True, exist_ok=True)
    carry_out(left, executor, log=log)
    return {key: _read(file) or [] for key, file in files.items()}


def _run(scene: str, seed: int, file: Path) -> None:
    found = [vars(verdict) for verdict in verdicts(load_scene(scene), seed)]
    file.write_text(json.dumps(made_by() | {"verdicts": found}, indent=1) + "\n")


def _read(file: Path) -> list[Verdict] | None:
    if not file.exists():
        return None
    written = json.loads(file.read_text())
    return [Verdict(**one) for one in written["verdicts"]] if is_current(written) else None


def verdicts(scene: Scene, seed: int) -> list[Verdict]:
    """Of all acts in one scene, those that worked and those that did not."""
    rng, found = np.random.default_rng(seed), []
    with Reference(scene, seed=seed, sensing="particles") as reference:
        estimator = Estimator(reference.declaration)
        _show(reference, estimator, programme(scene))
        estimator.release()
        for act in _acts(scene, estimator, rng):
            for works in (True, False):
                factor = _judged(scene, copy.deepcopy(reference), copy.deepcopy(estimator), act, works=works)
                found.append(Verdict(kind=type(act).__name__, works=works, log_bayes_factor=factor))
    return found


def _acts(scene: Scene, estimator: Estimator, rng: np.random.Generator) -> Iterator[Cut | Suture]:
    """Cuts around random particles believed attached, and sutures within halves of the sheet."""
    mesh, detection = SheetMesh(estimator.sheet.rest, estimator.sheet.faces), estimator.detection
    flat, found, plan = mesh.rest[:, :2], np.flatnonzero(detection.attached), scene.procedure
    for middle in rng.choice(found, size=min(PLACES, len(found)), replace=False):
        near = np.argsort(np.linalg.norm(flat[found] - flat[middle], axis=1))[:CUT]
        yield Cut(path=tour(flat[found[near]]), width=CUT_WIDTH * mesh.spacing)
    for angle in rng.uniform(0, 2 * np.pi) + 2 * np.pi / PLACES * np.arange(PLACES):
        beyond = flat @ np.array([np.cos(angle), np.sin(angle)]) < 0
        free = np.where(beyond, 1.0, detection.score)
        path = free_stretch(flat, free, mesh.border, length=plan.suture_length, width=plan.suture_width)
        if path is not None:
            yield Suture(path=path, width=plan.suture_width, stiffness=plan.suture_stiffness)


def _judged(scene: Scene, reference: Reference, estimator: Estimator, act: Cut | Suture, *, works: bool) -> float:
    """The log Bayes factor after an act and two lifts; without any frame that says something of it, 0."""
    if works:
        estimator.update(reference.step(act))
    else:
        estimator.update(replace(reference.step(Wait()), events=(act,)))
    middle = np.asarray(act.path, dtype=float).mean(axis=0)
    nearest = sorted(grasp_points(scene), key=lambda point: float(np.linalg.norm(np.array(point) - middle)))
    lifts = replace(scene, programme=replace(scene.programme, points=tuple(nearest[:LIFTED])))
    _show(reference, estimator, programme(lifts))
    return estimator.change_log_bayes_factor(estimator.changes[-1]) or 0.0


def _show(reference: Reference, estimator: Estimator, actions: Iterator[Action]) -> None:
    for action in actions:
        estimator.update(reference.step(action))


def markdown(found: Mapping[tuple[str, int], list[Verdict]]) -> str:
    """Counts by scene and of all, cuts beside sutures."""
    rows = {scene: [one for key in found if key[0] == scene for one in found[key]] for scene, _ in found}
    rows["all"] = [one for some in found.values() for one in some]
    headings = [f"{kind}: {heading}" for kind in KINDS for heading in HEADINGS]
    lines = ["| scene | " + " | ".join(headings) + " |", "|" + "---|" * (1 + len(headings))]
    return "\n".join([*lines, *(f"| {name} | " + " | ".join(_cells(row)) + " |" for name, row in rows.items())])


def _cells(found: list[Verdict]) -> Iterator[str]:
    for kind in KINDS:
        worked, failed = (
            np.array([one.log_bayes_factor for one in found if one.kind == kind and one.works is works])
            for works in (True, False)
        )
        yield f"{(worked <= 0).sum()} of {len(worked)}"
        yield f"{(failed <= 0).sum()} of {len(failed)}"
        yield f"{(failed < limit(worked)).sum()} of {len(failed)}" if len(worked) else "none worked"


def limit(worked: Float[np.ndarray, " k"]) -> float:
    """The log Bayes factor below which at most `ALARMS` of the acts that worked lie."""
    return float(np.quantile(worked, ALARMS, method="lower"))


KINDS = ("Cut", "Suture")
HEADINGS = ("worked, taken for failed", "failed, noticed", f"noticed at {ALARMS:.0%} false alarms")
