"""Apply a function to independent keys on all usable cores, in threads.

Compiled code and BLAS release the interpreter lock, so that threads are enough.
"""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import jax

from jiggle_mj.worker_processes import usable_cores

T = TypeVar("T")
THREADS_PER_CORE = 2
"""Threads that share a core. With one thread a core, the third of three equal jobs would wait on two cores until a
whole core is free."""


def parallel_map(function: Callable[[int], T], keys: Iterable[int]) -> dict[int, T]:
    """Return the value of the function for each key, in the order of the keys.

    Every thread uses the caller's `jax_enable_x64` and `jax_default_device`. An exception of any call is raised here.
    """
    keys = list(keys)
    x64, device = jax.config.read("jax_enable_x64"), jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]

    def call(key: int) -> T:
        with jax.enable_x64(x64), jax.default_device(device):  # settings of each thread
            return function(key)

    with ThreadPoolExecutor(THREADS_PER_CORE * usable_cores()) as pool:
        return dict(zip(keys, pool.map(call, keys), strict=True))
