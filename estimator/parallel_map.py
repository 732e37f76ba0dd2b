"""What does not need each other on all usable cores: compiled code and BLAS leave the interpreter to others."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import jax

from jiggle_mj.worker_processes import usable_cores

T = TypeVar("T")
A_CORE = 2
"""How many take turns on a core: of three that are as long, the third need not wait for two cores to be free."""


def parallel_map(of: Callable[[int], T], keys: Iterable[int]) -> dict[int, T]:
    """What a function gives for each, in their order."""
    keys, wide = list(keys), jax.config.read("jax_enable_x64")

    def one(k: int) -> T:
        with jax.enable_x64(wide):  # which is said by thread
            return of(k)

    with ThreadPoolExecutor(A_CORE * usable_cores()) as pool:
        return dict(zip(keys, pool.map(one, keys), strict=True))
