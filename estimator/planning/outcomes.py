"""What many pulls would show and cost in many tissues that could be: `PullPredictor.outcome` of every pair of them."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float

from .pull_predictor import CandidatePull, Outcome, PullPredictor

BATCH = 32
"""Pairs of pull and scenario that GPUs look at together: one compilation serves any number of either."""


def outcomes(
    predictor: PullPredictor, candidates: CandidatePull, s: Float[Array, "scenarios n"], *, informative: bool = True
) -> Outcome:
    """Of each tug in each scenario: many at once on GPUs, in turn on a CPU."""
    if jax.default_backend() != "cpu":
        return at_once(predictor, candidates, s, informative=informative)
    each_tug = [jax.tree.map(lambda leaf, i=i: leaf[i], candidates) for i in range(len(candidates.to))]
    found = [[_outcome(predictor, candidate, one, informative=informative) for one in s] for candidate in each_tug]
    stacked = [jax.tree.map(lambda *leaves: jnp.stack(leaves), *row) for row in found]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *stacked)


def at_once(
    predictor: PullPredictor, candidates: CandidatePull, s: Float[Array, "scenarios n"], *, informative: bool = True
) -> Outcome:
    """The same in batches, the pairs of each dealt out to all devices, each of which iterates for itself."""
    shape = len(candidates.to), len(s)
    pairs = np.resize(np.arange(math.prod(shape)), (-(-math.prod(shape) // BATCH), BATCH))
    found = []
    for batch in pairs:
        pulls = jax.tree.map(lambda leaf, batch=batch: leaf[batch // len(s)], candidates)
        found.append(_dealt(predictor, pulls, s[batch % len(s)], informative=informative))
    whole = jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[: math.prod(shape)], *found)
    return jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), whole)


@eqx.filter_jit
def _dealt(predictor: PullPredictor, pulls: CandidatePull, s: Float[Array, "batch n"], *, informative: bool) -> Outcome:
    """Of each pull in its own scenario."""
    known, rest = eqx.partition(predictor, eqx.is_array)
    devices = jax.devices()[: math.gcd(BATCH, len(jax.devices()))]

    def some(known: PullPredictor, pulls: CandidatePull, s: Float[Array, "some n"]) -> Outcome:
        whole = eqx.combine(known, rest)
        return jax.vmap(lambda pull, one: _outcome(whole, pull, one, informative=informative))(pulls, s)

    mesh, dealt, everywhere = Mesh(np.array(devices), ("pairs",)), PartitionSpec("pairs"), PartitionSpec()
    shared = jax.shard_map(some, mesh=mesh, in_specs=(everywhere, dealt, dealt), out_specs=dealt, check_vma=False)
    return shared(known, pulls, s)


def _outcome(
    predictor: PullPredictor, candidate: CandidatePull, s: Float[Array, " n"], *, informative: bool
) -> Outcome:
    """What is held by the jaws is not held by attachments."""
    return predictor.outcome(candidate, jnp.where(candidate.force_unknown, 0.0, s), informative=informative)
