"""Simulation-based calibration of the implicit filter: attachments drawn from its prior, one lift, and ranks.

Each cell draws the attachments of one sheet, lifts a corner of it by one of three references (`drawn_pulls`), estimates
as from any recording, and ranks the truth in the posterior (`drawn_quantities`). If the posterior is right for what the
reference does, all ranks are uniform (`rank_statistics`).
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from itertools import product
from pathlib import Path
from typing import ClassVar

import jax
import numpy as np

from jiggle_mj.argument_checks import as_integer
from jiggle_mj.episode import settings
from jiggle_mj.estimator import Estimator
from jiggle_mj.estimator.belief.gaussian_information import GaussianInformation
from jiggle_mj.estimator.belief.posterior_draws import posterior_draws
from jiggle_mj.estimator.belief.prior import prior_belief
from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.estimator.physics.mesh import SheetMesh
from jiggle_mj.options import CalibrationReference
from jiggle_mj.recording.declaration import is_current, version_entry
from jiggle_mj.recording.output_files import write_text
from jiggle_mj.scenes import Scene
from jiggle_mj.scenes.scene.scene import TissueConfig

from ..metrics.calibration import calibration
from ..metrics.calibration_summary import CalibrationDraw, ReferenceSummary, headline, summarised
from ..metrics.rank_statistics import DRAWS, Ranked, RankStatistics
from ..metrics.result_file import MADE_BY, read_json
from .drawn_pulls import REFERENCES, RIGID, drawn_pull, estimator_config
from .drawn_quantities import Quantities
from .figures import UNDEFINED
from .prior_draws import draw_attachments
from .same_engine import sheet
from .study import Study, Table

SHEET = Scene(name="drawn", tissue=TissueConfig(size=(0.05, 0.05), spacing=5e-3))
"""The sheet: 149 particles, at about the density for which the prior is set."""
HEADINGS = ("reference", "posterior", "quantity", "draws", "p of chi2", "uniform", "90 % interval holds (99 % band)",
            "mean rank (99 % band)", "error [sd]", "errors over sd", "of the truth")  # fmt: skip
THIN = 10
"""Sweeps from one draw of the posterior to the next."""


@dataclass(frozen=True, kw_only=True)
class CalibrationCell:
    """One draw from the prior."""

    reference: CalibrationReference
    seed: int


@dataclass(frozen=True, kw_only=True)
class CalibrationStudy(Study[CalibrationCell, CalibrationDraw]):
    """Simulation-based calibration on one sheet."""

    default_seeds: ClassVar[range] = range(100)
    references: tuple[CalibrationReference, ...] = REFERENCES
    scene: Scene = field(default=SHEET)

    def cells(self, seeds: Iterable[int]) -> tuple[CalibrationCell, ...]:
        """Return every reference with every seed."""
        return tuple(CalibrationCell(reference=name, seed=seed) for name, seed in product(self.references, seeds))

    def name(self, cell: CalibrationCell) -> str:
        """Return the name of the file that keeps the ranks of this draw."""
        return f"{cell.reference}-{cell.seed}.json"

    def run_cell(self, cell: CalibrationCell, path: Path) -> None:
        """Draw, simulate, estimate, rank, and write the ranks."""
        found = calibration_draw(self.scene, cell.reference, cell.seed)
        kept = version_entry() | {"settings": self._settings(cell), "draw": asdict(found)}
        write_text(path, json.dumps(kept, indent=1) + "\n")

    def is_current(self, cell: CalibrationCell, path: Path) -> bool:
        """Say whether this version made this draw with these settings."""
        if not path.exists():
            return False
        kept = read_json(path, MADE_BY)
        return is_current(kept) and kept.get("settings") == self._settings(cell)

    def read(self, cell: CalibrationCell, path: Path) -> CalibrationDraw:
        """Read the ranks of one draw."""
        kept = read_json(path, MADE_BY)["draw"]
        ranks = {
            method: {name: Ranked(**each) for name, each in kept[method].items()} for method in ("draws", "belief")
        }
        return CalibrationDraw(**kept | ranks)

    def summarise(self, results: Mapping[CalibrationCell, CalibrationDraw]) -> Table:
        """Return a row for each reference, posterior and quantity, and what was found beneath."""
        found = summaries(results)
        rows = [
            (summary.name, method, name, *_cells(stats))
            for summary in found
            for method, by_name in summary.ranks.items()
            for name, stats in by_name.items()
        ]
        sentences = [sentence for summary in found for sentence in summary.sentences()]
        return Table(headings=HEADINGS, rows=tuple(rows), beneath=("", headline(found), "", *sentences))

    def _settings(self, cell: CalibrationCell) -> dict[str, str]:
        return settings(estimator_config(cell.reference)) | {"scene": self.scene.name}


def _cells(stats: RankStatistics) -> tuple[str, ...]:
    """Return the figures of one quantity as text."""
    low, high = stats.coverage_band
    share = UNDEFINED if np.isnan(stats.share_of_truth) else f"{stats.share_of_truth:.2f}"
    return (
        str(stats.count),
        f"{stats.p_value:.2g}",
        "yes" if stats.uniform else "**no**",
        f"{stats.coverage:.2f} ({low:.2f} to {high:.2f})",
        f"{stats.mean_rank:.2f} ({stats.mean_rank_band[0]:.2f} to {stats.mean_rank_band[1]:.2f})",
        f"{stats.error_in_sd:+.2f}",
        f"{stats.error_ratio:.2f}",
        share,
    )


def summaries(results: Mapping[CalibrationCell, CalibrationDraw]) -> list[ReferenceSummary]:
    """Return what the draws of each reference give."""
    found: dict[str, list[CalibrationDraw]] = {}
    for cell, draw in results.items():
        found.setdefault(cell.reference, []).append(draw)
    return summarised(found)


@cache
def _prepared(scene: Scene) -> tuple[SheetMesh, Quantities]:
    """Return what all draws of a process share: the mesh, and the compiled quantities."""
    mesh, _ = sheet(scene)
    with jax.enable_x64(True), one_thread():
        return mesh, Quantities.build(mesh, scene.declared.declaration())


def calibration_draw(scene: Scene, reference: CalibrationReference, seed: int) -> CalibrationDraw:
    """Return the ranks of one draw from the prior.

    The attachments are the same for each reference.

    Raises:
        OptionError: the seed is below 0.
    """
    seed = as_integer(seed, "seed", at_least=0)
    config, declaration, (mesh, quantities) = (
        estimator_config(reference),
        scene.declared.declaration(),
        _prepared(scene),
    )
    with jax.enable_x64(True), one_thread():
        prior = prior_belief(mesh, reference=declaration.membrane_stiffness, config=config.prior, belief=config.belief)
        s = np.minimum(draw_attachments(prior.prior, np.random.default_rng([seed, 0])), RIGID)
    rng = np.random.default_rng([seed, 1])
    pull = drawn_pull(scene, reference, s, rng)
    estimator = Estimator(pull.declaration, config=config)
    for observation in pull.observed(rng):
        estimator.update(observation)
    estimator.release()
    belief, detection, attachments = estimator.belief, estimator.detection, estimator.attachment_belief
    with jax.enable_x64(True), one_thread():
        evidence = GaussianInformation(precision=attachments.precision, shift=attachments.shift)
        key = jax.random.key(seed % 2**32)  # larger ones are refused by JAX, and not by NumPy
        draws = np.asarray(posterior_draws(attachments.prior, evidence, key, count=DRAWS, thin=THIN))
        by_draws = quantities.by_draws(s, draws, rng)
        by_belief = quantities.by_belief(s, attachments, belief, rng)
    b, attached = declaration.membrane_stiffness * s / (1 - s), s > 0
    figures = calibration(belief, b, attached, probability=detection.score)
    return CalibrationDraw(
        draws=by_draws,
        belief=by_belief,
        probability=detection.score.tolist(),
        attached=attached.tolist(),
        coverage=figures.coverage_90,
        coverage_attached=figures.coverage_attached,
        nees_attached=figures.nees_attached,
        force_sd_ratio=detection.force_sd_ratio,
        converged=detection.converged,
    )
