"""Study of whether a failed cut or suture is noticed: acts that worked, and the same acts without any effect.

A scene is lifted at its corners, and the attachments are estimated. Then one place at a time is cut that is believed
attached, or sewn that is believed free. That happens in one copy of the tissue. In another copy the estimator gets the
same event, and nothing is done. The two nearest corners are lifted again, and the log Bayes factor decides between
the two.
"""

import copy
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from jiggle_mj.actions import Action, Cut, Suture, Wait
from jiggle_mj.estimator import Estimator
from jiggle_mj.estimator.physics.mesh import SheetMesh
from jiggle_mj.estimator.planning.procedures import CUT_WIDTH, free_stretch, tour
from jiggle_mj.recording.declaration import is_current, version_entry
from jiggle_mj.recording.output_files import write_text
from jiggle_mj.scenes import Reference, load_scene
from jiggle_mj.scenes.scene.programme import grasp_points, programme
from jiggle_mj.scenes.scene.scene import Scene

from ..metrics.result_file import MADE_BY, read_json
from .study import Study, Table

SCENES = ("arc", "line", "line_dot", "arc_line", "u_shape")
ACTS_OF_A_KIND = 2
"""Cuts, and sutures, of each scene and seed: each costs two copies of the tissue and four lifts."""
CUT_PARTICLES = 12
"""Particles believed attached that are cut: those nearest to one of them."""
LIFTED_CORNERS = 2
"""Corners, the nearest to an act, that are lifted after it."""
FALSE_ALARM_RATE = 0.01
"""Share of the acts that worked which may be taken for failed."""
KINDS = ("Cut", "Suture")
HEADINGS = ("worked, taken for failed", "failed, noticed", f"noticed at {FALSE_ALARM_RATE:.0%} false alarms")


@dataclass(frozen=True)
class Verdict:
    """Evidence about one act."""

    kind: str
    """Cut or Suture."""
    works: bool
    """Whether the act was carried out, the truth."""
    log_bayes_factor: float
    """Log Bayes factor of 'it worked' against 'nothing changed' [nat]."""


@dataclass(frozen=True, kw_only=True)
class ActsCell:
    """Cell that holds all acts of one scene and seed."""

    scene: str
    seed: int


@dataclass(frozen=True, kw_only=True)
class ActsStudy(Study[ActsCell, list[Verdict]]):
    """Study of acts that worked and acts that did not."""

    default_seeds: ClassVar[range] = range(6)
    scenes: tuple[str, ...] = SCENES
    acts_of_a_kind: int = ACTS_OF_A_KIND

    def cells(self, seeds: Iterable[int]) -> tuple[ActsCell, ...]:
        """Return every scene with every seed."""
        return tuple(ActsCell(scene=scene, seed=seed) for scene, seed in product(self.scenes, seeds))

    def name(self, cell: ActsCell) -> str:
        """Return the name of the cell's file."""
        return f"{cell.scene}-{cell.seed}.json"

    def run_cell(self, cell: ActsCell, path: Path) -> None:
        """Write the verdicts of all acts to the cell's file."""
        found = [vars(verdict) for verdict in self.verdicts(cell)]
        write_text(path, json.dumps(version_entry() | {"verdicts": found}, indent=1) + "\n")

    def verdicts(self, cell: ActsCell) -> list[Verdict]:
        """Carry out all acts of a cell, and return the evidence about each."""
        return verdicts(load_scene(cell.scene), cell.seed, acts_of_a_kind=self.acts_of_a_kind)

    def is_current(self, cell: ActsCell, path: Path) -> bool:
        """Say whether this version wrote the file."""
        return path.exists() and is_current(read_json(path, MADE_BY))

    def read(self, cell: ActsCell, path: Path) -> list[Verdict]:
        """Read the verdicts from the cell's file."""
        return [Verdict(**verdict) for verdict in read_json(path, MADE_BY)["verdicts"]]

    def summarise(self, results: Mapping[ActsCell, list[Verdict]]) -> Table:
        """Return counts by scene and of all scenes: cuts, then sutures."""
        by_scene: dict[str, list[Verdict]] = {}
        for cell, found in results.items():
            by_scene.setdefault(cell.scene, []).extend(found)
        by_scene["all"] = [verdict for found in results.values() for verdict in found]
        return Table(
            headings=("scene", *(f"{kind}: {heading}" for kind in KINDS for heading in HEADINGS)),
            rows=tuple((name, *_counts(found)) for name, found in by_scene.items()),
        )


def verdicts(scene: Scene, seed: int, *, acts_of_a_kind: int = ACTS_OF_A_KIND) -> list[Verdict]:
    """Carry out all acts in one scene, each with and without its effect, and return the evidence about each.

    Args:
        scene: the tissue.
        seed: of noise and places.
        acts_of_a_kind: cuts, and sutures.
    """
    rng, found = np.random.default_rng(seed), []
    with Reference(scene, seed=seed, sensing="particles") as reference:
        estimator = Estimator(reference.declaration)
        _observe(reference, estimator, programme(scene))
        estimator.release()
        for act in _acts(scene, estimator, rng, acts_of_a_kind):
            for works in (True, False):
                factor = log_bayes_factor_after(
                    scene, copy.deepcopy(reference), copy.deepcopy(estimator), act, works=works
                )
                found.append(Verdict(kind=type(act).__name__, works=works, log_bayes_factor=factor))
    return found


def log_bayes_factor_after(
    scene: Scene, reference: Reference, estimator: Estimator, act: Cut | Suture, *, works: bool
) -> float:
    """Return the log Bayes factor of 'it worked' after an act and lifts of the nearest corners [nat].

    It is 0 where no frame shows anything of the act.

    Args:
        scene: whose corners are lifted.
        reference: the tissue, which changes.
        estimator: of that tissue, which changes.
        act: is carried out, or only reported to the estimator.
        works: whether it is carried out.
    """
    if works:
        estimator.update(reference.step(act))
    else:
        estimator.update(replace(reference.step(Wait()), events=(act,)))
    middle = np.asarray(act.path, dtype=float).mean(axis=0)
    nearest = sorted(grasp_points(scene), key=lambda point: float(np.linalg.norm(np.array(point) - middle)))
    lifts = replace(scene, programme=replace(scene.programme, points=tuple(nearest[:LIFTED_CORNERS])))
    _observe(reference, estimator, programme(lifts))
    return estimator.change_log_bayes_factor(estimator.changes[-1]) or 0.0


def limit(successful: Float[np.ndarray, " k"]) -> float:
    """Return the log Bayes factor below which at most `FALSE_ALARM_RATE` of the acts that worked lie [nat]."""
    return float(np.quantile(successful, FALSE_ALARM_RATE, method="lower"))


def _acts(scene: Scene, estimator: Estimator, rng: np.random.Generator, count: int) -> Iterator[Cut | Suture]:
    """Yield cuts around random particles believed attached, and sutures within halves of the sheet."""
    mesh, detection = SheetMesh(estimator.sheet.rest, estimator.sheet.faces), estimator.detection
    flat, found, plan = mesh.rest[:, :2], np.flatnonzero(detection.attached), scene.procedure
    for middle in rng.choice(found, size=min(count, len(found)), replace=False):
        near = np.argsort(np.linalg.norm(flat[found] - flat[middle], axis=1))[:CUT_PARTICLES]
        yield Cut(path=tour(flat[found[near]]), width=CUT_WIDTH * mesh.spacing)
    for angle in rng.uniform(0, 2 * np.pi) + 2 * np.pi / count * np.arange(count):
        beyond = flat @ np.array([np.cos(angle), np.sin(angle)]) < 0
        free = np.where(beyond, 1.0, detection.score)
        path = free_stretch(flat, free, mesh.border, length=plan.suture_length, width=plan.suture_width)
        if path is not None:
            yield Suture(path=path, width=plan.suture_width, stiffness=plan.suture_stiffness)


def _observe(reference: Reference, estimator: Estimator, actions: Iterator[Action]) -> None:
    for action in actions:
        estimator.update(reference.step(action))


def _counts(found: list[Verdict]) -> Iterator[str]:
    """Yield the three cells of each kind of act."""
    for kind in KINDS:
        successful, failed = (
            np.array([verdict.log_bayes_factor for verdict in found if verdict.kind == kind and verdict.works is works])
            for works in (True, False)
        )
        yield f"{(successful <= 0).sum()} of {len(successful)}"
        yield f"{(failed <= 0).sum()} of {len(failed)}"
        yield f"{(failed < limit(successful)).sum()} of {len(failed)}" if len(successful) else "none worked"
