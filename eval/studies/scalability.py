"""Study of how planning grows with the sheet: seconds for one action of the paper's SL-D and of ours, at each size.

SL-D draws 100 samples in five iterations. Ours is `our_plan`. Compilation is not counted.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import jax

from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.recording.declaration import is_current, version_entry
from jiggle_mj.recording.output_files import write_text

from ..benchmark.estimator_benchmark import case, sl_d, timed
from ..benchmark.plan_benchmark import our_plan
from ..metrics.result_file import MADE_BY, read_json
from .figures import UNDEFINED
from .study import Study, Table

PARTICLE_COUNTS = (600, 1200, 2400)
"""About how many particles the sheets have: the paper's two sizes, and twice the larger."""
PRINTED = {600: 2.9, 1200: 4.5}
"""Seconds for an action of SL-D in the paper."""
REPEATS = 3
"""Plans of which the median is reported."""


@dataclass(frozen=True)
class PlanTimes:
    """Median seconds of one plan."""

    sl_d_s: float
    """Seconds of the paper's SL-D."""
    ours_s: float
    """Seconds of ours."""


@dataclass(frozen=True, kw_only=True)
class ScalabilityStudy(Study[int, PlanTimes]):
    """Study of planning times; a cell is a number of particles."""

    default_seeds: ClassVar[range] = range(0)
    sizes: tuple[int, ...] = PARTICLE_COUNTS

    def cells(self, seeds: Iterable[int]) -> tuple[int, ...]:
        """Return the sizes; nothing is drawn, so seeds are not used."""
        return self.sizes

    def name(self, cell: int) -> str:
        """Return the name of the file that keeps the times of this size."""
        return f"{cell}.json"

    def run_cell(self, cell: int, path: Path) -> None:
        """Measure on whatever device JAX has, and write the times."""
        with jax.enable_x64(True), one_thread():
            lift = case(cell)
            _, theirs = timed(sl_d(lift), repeats=REPEATS)
            _, ours = timed(our_plan(lift), repeats=REPEATS)
        times = vars(PlanTimes(sl_d_s=theirs, ours_s=ours))
        write_text(path, json.dumps(version_entry() | {"device": _device(), "times": times}, indent=1) + "\n")

    def is_current(self, cell: int, path: Path) -> bool:
        """Say whether this version measured this size on this kind of device."""
        if not path.exists():
            return False
        kept = read_json(path, MADE_BY)
        return is_current(kept) and kept.get("device") == _device()

    def read(self, cell: int, path: Path) -> PlanTimes:
        """Read the times of one size."""
        return PlanTimes(**read_json(path, MADE_BY)["times"])

    def summarise(self, results: Mapping[int, PlanTimes]) -> Table:
        """Return a row for each size, with the paper's printed seconds."""
        rows = []
        for n, times in results.items():
            printed = f"{PRINTED[n]:g} s" if n in PRINTED else UNDEFINED
            rows.append((str(n), printed, f"{times.sl_d_s:.2g} s", f"{times.ours_s:.2g} s"))
        note = f"Medians of three on {_device()}, compilation left out; the paper names no device."
        return Table(headings=("n", "SL-D, paper", "SL-D", "ours"), rows=tuple(rows), beneath=("", note))


def _device() -> str:
    return jax.devices()[0].device_kind
