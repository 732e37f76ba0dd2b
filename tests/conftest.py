"""Settings that every test shares: offscreen OpenGL, JAX on the CPU in float64, strict promotion, checked signatures.

The environment is set before mujoco or jax is imported, which is when they read it. What one process of a run has
compiled, the others take over. Compiled in a hurry, as no test runs long: a quarter of the time; and by one thread,
as there is a process for each core.
"""

import os
import tempfile

os.environ["MUJOCO_GL"] = os.environ.get("MUJOCO_GL") or "egl"
os.environ["JAX_PLATFORMS"] = "cpu"
os.environ.setdefault(
    "XLA_FLAGS",  # given, even as "", it stays: XLA_FLAGS= make test compiles as users do
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1",
)
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:  # the first process of a run sets it, and workers inherit it
    compiled = tempfile.TemporaryDirectory()
    os.environ["JAX_COMPILATION_CACHE_DIR"] = compiled.name
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import beartype.typing  # noqa: F401  # named in CHECKER
import jax
import jaxtyping
import pytest

CHECKER = (
    "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True, "
    "hint_overrides=beartype.FrozenDict({beartype.typing.Self: object})))"
)
"""An int is a float, as type checkers have it; Self is unknown to beartype in a method that is decorated on its own."""

jaxtyping.install_import_hook("jiggle_mj", CHECKER)
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


MAPS = 30_000
"""Memory maps from which on what a process compiled is dropped. Linux grants 65530, and XLA, which takes several for
each compiled function, dies of the lack of one."""


SHARED = ("light", "one_by_one")
"""Fixtures of a session that take a minute: who needs one goes to the process that has it."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Keep the tests of a file in one process, and those of a shared fixture (xdist's --dist loadgroup)."""
    for item in items:
        needs = [name for name in SHARED if name in getattr(item, "fixturenames", ())]
        item.add_marker(pytest.mark.xdist_group(needs[0] if needs else item.path.stem))


@pytest.fixture(autouse=True, scope="module")
def room_for_compiled_functions() -> Iterator[None]:
    """Drop what was compiled, after a file of tests, if there is much of it."""
    yield
    if Path("/proc/self/maps").read_bytes().count(b"\n") > MAPS:
        jax.clear_caches()


@pytest.fixture
def getkey() -> Callable[[], jax.Array]:
    """A source of random keys: a new one at each call, the same ones in each run of a test."""
    seeds = itertools.count()
    return lambda: jax.random.key(next(seeds))
