"""Study of how planning grows with the sheet: seconds for one action of the paper's SL-D and of ours, at each size.

SL-D draws 100 samples in five iterations. Ours is what `InformationPolicy` computes where the jaws are: all pulls in
one tissue and the likeliest in another, for what they teach; the place of the tip in sixteen, for the energy that was
predicted there; and one step in sixteen, for whether it is safe. Other places are not evaluated. Compilation is not
counted.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.estimator.config import EstimatorConfig
from jiggle_mj.estimator.filter_builder import build_filter
from jiggle_mj.estimator.planning.information_config import InformationPolicyConfig
from jiggle_mj.estimator.planning.outcomes import outcomes
from jiggle_mj.estimator.planning.pull_predictor import CandidatePull, PullPredictor
from jiggle_mj.recording.declaration import is_current, version_entry
from jiggle_mj.recording.output_files import write_text

from ..benchmark.estimator_benchmark import POINT_SD, Case, case, sl_d, timed
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


def our_plan(lift: Case) -> Callable[[], object]:
    """Return a call that computes what `InformationPolicy` asks of a grasp: what pulls teach, and what is safe."""
    filter = build_filter(lift.mesh, lift.declaration, EstimatorConfig()).by_forces("predicts pulls")
    state = filter.init(jax.random.key(0))
    belief = filter.belief(state)
    everywhere = jnp.ones(len(belief.shift), dtype=bool)
    predictor = PullPredictor.build(filter.balance(state), belief, jnp.eye(3) / POINT_SD**2, everywhere)
    pull, held = lift.frames[-1].pull, lift.frames[-1].held
    assert pull is not None
    config = InformationPolicyConfig()
    ends = pull.before[None] + jnp.asarray(config.pulls)[:, None]
    many = (len(ends), *held.shape)
    candidates = CandidatePull(
        start=jnp.broadcast_to(pull.before[None], ends.shape),
        held=jnp.broadcast_to(held[None], many),
        force_unknown=jnp.broadcast_to(held[None], many),
        to=ends,
    )
    likely, step = (
        jax.tree.map(lambda leaf, count=count: leaf[:count], candidates) for count in (config.n_refined_pulls, 1)
    )
    here = eqx.tree_at(lambda candidate: candidate.to, step, step.start)
    s = belief.bounded(lift.b)

    def plan() -> object:
        counts = 1, config.n_gain_scenarios - 1, config.n_safety_scenarios
        first, more, refined = (jnp.broadcast_to(s[None], (count, len(s))) for count in counts)
        gains = outcomes(predictor, candidates, first), outcomes(predictor, likely, more)
        return gains, [outcomes(predictor, candidate, refined, informative=False) for candidate in (here, step)]

    return plan


def _device() -> str:
    return jax.devices()[0].device_kind
