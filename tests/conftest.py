"""Settings that every test shares: offscreen OpenGL, JAX on the CPU in float64, no silent rank promotion.

The environment is set before mujoco or jax is imported, which is when they read it.
"""

import os

os.environ.setdefault("MUJOCO_GL", "egl")
os.environ["JAX_PLATFORMS"] = "cpu"

import itertools
from collections.abc import Callable

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")


@pytest.fixture
def getkey() -> Callable[[], jax.Array]:
    """A source of random keys: a new one at each call, the same ones in each run of a test."""
    seeds = itertools.count()
    return lambda: jax.random.key(next(seeds))
