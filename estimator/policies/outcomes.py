"""What many pulls would show and cost in many tissues that could be: `Outlook.outcome` of every pair of them."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, Int
from jiggle_mj.estimator.outlook import Outcome, Outlook, Tug


def outcomes(outlook: Outlook, tugs: Tug, s: Float[Array, "scenarios n"], *, informative: bool = True) -> Outcome:
    """Of each tug in each scenario: at once on GPUs, in turn on a CPU, where one compilation serves any number."""
    if jax.default_backend() != "cpu":
        return at_once(outlook, tugs, s, informative=informative)
    each_tug = [jax.tree.map(lambda leaf, i=i: leaf[i], tugs) for i in range(len(tugs.to))]
    found = [[_outcome(outlook, tug, one, informative=informative) for one in s] for tug in each_tug]
    stacked = [jax.tree.map(lambda *leaves: jnp.stack(leaves), *row) for row in found]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *stacked)


@eqx.filter_jit
def _outcome(outlook: Outlook, tug: Tug, s: Float[Array, " n"], *, informative: bool) -> Outcome:
    return outlook.outcome(tug, jnp.where(tug.loaded, 0.0, s), informative=informative)


@eqx.filter_jit
def at_once(outlook: Outlook, tugs: Tug, s: Float[Array, "scenarios n"], *, informative: bool = True) -> Outcome:
    """The same, the pairs of tug and scenario dealt out to all devices, each of which iterates for itself."""
    shape, devices = (len(tugs.to), len(s)), jax.devices()
    pairs = jnp.arange(-(-math.prod(shape) // len(devices)) * len(devices)) % math.prod(shape)
    known, rest = eqx.partition((outlook, tugs, s), eqx.is_array)

    def some(known: tuple, pairs: Int[Array, " some"]) -> Outcome:
        outlook, tugs, s = eqx.combine(known, rest)

        def one(pair: Int[Array, ""]) -> Outcome:
            tug = jax.tree.map(lambda leaf: leaf[pair // len(s)], tugs)
            return _outcome(outlook, tug, s[pair % len(s)], informative=informative)

        return jax.vmap(one)(pairs)

    dealt, everywhere = PartitionSpec("pairs"), PartitionSpec()
    mesh = Mesh(np.array(devices), ("pairs",))
    found = jax.shard_map(some, mesh=mesh, in_specs=(everywhere, dealt), out_specs=dealt, check_vma=False)(known, pairs)
    return jax.tree.map(lambda leaf: leaf[: math.prod(shape)].reshape(*shape, *leaf.shape[1:]), found)
