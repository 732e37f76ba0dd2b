"""How planning grows with the sheet: seconds for one action of the paper's SL-D and for one of ours, at each size.

SL-D: 100 samples, five iterations. Ours, as `InformationPolicy` plans where the jaws are: all pulls in one tissue and
the likeliest in another for what they teach; the place of the tip in sixteen, for what the energy was predicted to be;
and one step in sixteen, for whether it is safe. Other places are not looked at. Compilation is not counted.
"""

from collections.abc import Callable, Iterable

import equinox as eqx
import jax
import jax.numpy as jnp

from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.estimator.config import EstimatorConfig
from jiggle_mj.estimator.filters.build import build_filter
from jiggle_mj.estimator.planning.information_config import InformationPolicyConfig
from jiggle_mj.estimator.planning.outcomes import outcomes
from jiggle_mj.estimator.planning.pull_predictor import CandidatePull, PullPredictor

from ..benchmark.estimator_benchmark import NOISE, Case, case, sl_d, timed

SIZES = (600, 1200, 2400)
PRINTED = {600: 2.9, 1200: 4.5}
"""Seconds for an action of SL-D in the paper."""

Times = dict[int, tuple[float, float]]
"""Seconds of SL-D and ours, by size."""


def scalability(sizes: Iterable[int], *, log: Callable[[str], None]) -> Times:
    """Measure on whatever device is there; `log` is told what comes next."""
    found: Times = {}
    with jax.enable_x64(True), one_thread():
        for n in sizes:
            log(f"n = {n}")
            one = case(n)
            _, theirs = timed(sl_d(one), repeats=3)
            _, ours = timed(our_plan(one), repeats=3)
            found[n] = theirs, ours
    return found


def our_plan(one: Case) -> Callable[[], object]:
    """What `InformationPolicy` asks of a grasp: what pulls teach, and whether the best is safe."""
    filter = build_filter(one.mesh, one.declaration, EstimatorConfig()).by_forces("predicts pulls")
    state = filter.init(jax.random.key(0))
    belief = filter.belief(state)
    everywhere = jnp.ones(len(belief.shift), dtype=bool)
    predictor = PullPredictor.build(filter.balance(state), belief, jnp.eye(3) / NOISE**2, everywhere)
    pull, held = one.frames[-1].pull, one.frames[-1].held
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
    s = belief.bounded(one.b)

    def plan() -> object:
        counts = 1, config.n_gain_scenarios - 1, config.n_safety_scenarios
        first, more, refined = (jnp.broadcast_to(s[None], (count, len(s))) for count in counts)
        told = outcomes(predictor, candidates, first), outcomes(predictor, likely, more)
        return told, [outcomes(predictor, candidate, refined, informative=False) for candidate in (here, step)]

    return plan


def markdown(times: Times) -> str:
    """A line for each size, the paper's printed seconds beside it."""
    device = jax.devices()[0].device_kind
    lines = ["| n | SL-D, paper | SL-D | ours |", "|---|---|---|---|"]
    for n, (theirs, ours) in times.items():
        printed = f"{PRINTED[n]:g} s" if n in PRINTED else "\N{EN DASH}"
        lines.append(f"| {n} | {printed} | {theirs:.2g} s | {ours:.2g} s |")
    return "\n".join([*lines, "", f"Medians of three on {device}, compilation left out; the paper names no device."])
