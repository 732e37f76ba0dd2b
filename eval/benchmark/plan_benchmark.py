"""Time of one plan of ours, on all devices that JAX has.

A plan is what `InformationPolicy` computes where the jaws are: all pulls in one tissue and the likeliest in another,
for what they teach; the place of the tip in sixteen, for the energy that was predicted there; and one step in sixteen,
for whether it is safe. Other places are not evaluated. GPUs share the pairs of pull and tissue among themselves
(`outcomes`).
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp

from jiggle_mj.estimator import EstimatorConfig
from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.estimator.filter_builder import build_filter
from jiggle_mj.estimator.planning.information_config import InformationPolicyConfig
from jiggle_mj.estimator.planning.outcomes import outcomes
from jiggle_mj.estimator.planning.pull_predictor import CandidatePull, PullPredictor

from .estimator_benchmark import POINT_SD, SLOW_REPEATS, Case, Metrics, case, timed

SIZES = (600,)
"""About how many particles the sheet has."""


def plan_benchmark(sizes: tuple[int, ...], *, log: Callable[[str], None]) -> Metrics:
    """Time a plan at each size, and how long it compiles.

    Args:
        sizes: particles, about.
        log: gets a line before each size.
    """
    metrics: Metrics = {
        "device": {"value": jax.devices()[0].device_kind, "unit": "name"},
        "devices": {"value": len(jax.devices()), "unit": "count"},
    }
    with jax.enable_x64(True), one_thread():
        for n in sizes:
            log(f"n = {n}")
            compiled, seconds = timed(our_plan(case(n)), repeats=SLOW_REPEATS)
            metrics[f"plan_n{n}_s"] = {"value": seconds, "unit": "s"}
            metrics[f"plan_n{n}_compile_s"] = {"value": compiled, "unit": "s"}
    return metrics


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
