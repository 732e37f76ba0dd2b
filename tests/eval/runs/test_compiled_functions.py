"""Compiled functions are dropped where a process has many of them, and are kept where it has not."""

import jax
import jax.numpy as jnp
import pytest

from jiggle_mj.eval.runs import compiled_functions
from jiggle_mj.eval.runs.compiled_functions import drop_many_compiled


@pytest.fixture
def traced():
    """Return a compiled function, and how often it was traced."""
    traces = list[int]()

    @jax.jit
    def double(x):
        traces.append(1)
        return 2 * x

    double(jnp.ones(3))
    return double, traces


@pytest.mark.skipif(not compiled_functions.MAPS.exists(), reason="only Linux lists the memory maps of a process")
def test_many_memory_maps_drop_what_is_compiled_and_few_keep_it(traced):
    double, traces = traced
    assert not drop_many_compiled(most=10**9)
    double(jnp.ones(3))
    assert len(traces) == 1
    assert drop_many_compiled(most=1)
    assert double(jnp.ones(3)).tolist() == [2, 2, 2] and len(traces) == 2


def test_where_nothing_is_known_of_memory_maps_nothing_is_dropped(traced, tmp_path, monkeypatch):
    double, traces = traced
    monkeypatch.setattr(compiled_functions, "MAPS", tmp_path / "none")
    assert not drop_many_compiled(most=0)
    double(jnp.ones(3))
    assert len(traces) == 1
