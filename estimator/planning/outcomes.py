"""Predict many pulls in many scenarios: `PullPredictor.outcome` of every pair of them."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float

from .pull_predictor import CandidatePull, Outcome, PullPredictor

BATCH = 32
"""Pairs of pull and scenario that GPUs predict together. With a fixed number one compilation serves all."""

COMPILER_OPTIONS = {"xla_gpu_enable_triton_gemm": False, "xla_gpu_autotune_level": 0}
"""Options of the compiler for a batch of small products, for each of which it would compile and time dozens of kernels
of its own, for minutes. Without them a batch takes 0.117 s instead of 0.114 s on an H200."""


def outcomes(
    predictor: PullPredictor, candidates: CandidatePull, s: Float[Array, "scenarios n"], *, informative: bool = True
) -> Outcome:
    """Return the outcome of each pull in each scenario: in batches on GPUs, one by one on a CPU.

    Args:
        predictor: predicts each.
        candidates: k pulls.
        s: the scenarios.
        informative: whether to compute the gains.

    Returns:
        Arrays of shape (k, scenarios, ...).
    """
    if jax.default_backend() != "cpu":
        return outcomes_in_batches(predictor, candidates, s, informative=informative)
    pulls = [jax.tree.map(lambda leaf, i=i: leaf[i], candidates) for i in range(len(candidates.to))]
    found = [[_outcome(predictor, pull, scenario, informative=informative) for scenario in s] for pull in pulls]
    stacked = [jax.tree.map(lambda *leaves: jnp.stack(leaves), *row) for row in found]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *stacked)


def outcomes_in_batches(
    predictor: PullPredictor, candidates: CandidatePull, s: Float[Array, "scenarios n"], *, informative: bool = True
) -> Outcome:
    """Return the same as `outcomes`, in batches whose pairs are split over all devices; each iterates by itself."""
    shape = len(candidates.to), len(s)
    pairs = np.resize(np.arange(math.prod(shape)), (-(-math.prod(shape) // BATCH), BATCH))
    found = []
    for batch in pairs:
        pulls = jax.tree.map(lambda leaf, batch=batch: leaf[batch // len(s)], candidates)
        found.append(_batch_outcomes(predictor, pulls, s[batch % len(s)], informative=informative))
    flat = jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[: math.prod(shape)], *found)
    return jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), flat)


@partial(jax.jit, static_argnames="informative", compiler_options=COMPILER_OPTIONS)
def _batch_outcomes(
    predictor: PullPredictor, pulls: CandidatePull, s: Float[Array, "batch n"], *, informative: bool
) -> Outcome:
    """Return the outcome of each pull in its own scenario."""
    devices = jax.devices()[: math.gcd(BATCH, len(jax.devices()))]

    def on_device(predictor: PullPredictor, pulls: CandidatePull, s: Float[Array, "share n"]) -> Outcome:
        return jax.vmap(lambda pull, scenario: _outcome(predictor, pull, scenario, informative=informative))(pulls, s)

    mesh, split, replicated = Mesh(np.array(devices), ("pairs",)), PartitionSpec("pairs"), PartitionSpec()
    sharded = jax.shard_map(on_device, mesh=mesh, in_specs=(replicated, split, split), out_specs=split, check_vma=False)
    return sharded(predictor, pulls, s)


def _outcome(
    predictor: PullPredictor, candidate: CandidatePull, s: Float[Array, " n"], *, informative: bool
) -> Outcome:
    """Return the outcome of one pull; what the jaws hold is not held by attachments too."""
    return predictor.outcome(candidate, jnp.where(candidate.force_unknown, 0.0, s), informative=informative)
