"""Declared effects as a model: what is refused, and what each part of a frame becomes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.errors import OptionError
from jiggle_mj.estimator import Estimator, EstimatorConfig
from jiggle_mj.estimator.effects import LIBRARY
from jiggle_mj.estimator.effects.corrected_model import PARTS, CorrectedModel, declared_effects, resting
from jiggle_mj.estimator.effects.sheet_model import look
from jiggle_mj.estimator.physics.environment import Weight
from jiggle_mj.estimator.physics.surrogate import surrogate
from jiggle_mj.observation import Declaration
from tests.support.small_sheet import DECLARATION, lifts, sheet

EXACT = 1e-12
"""Rounding of forces [N] and lengths [m]."""
IN_THE_AIR = dataclasses.replace(DECLARATION, bed=False, gravity=(0.0, 0.0, 0.0))
UPRIGHT = dataclasses.replace(DECLARATION, bed=False, gravity=(0.0, -9.81, 0.0))
"""The small sheet, hanging in its own plane."""


def with_effects(declaration: Declaration, **effects: tuple[float, ...]) -> Declaration:
    return dataclasses.replace(declaration, effects=effects)


def usual(name: str) -> tuple[str, tuple[float, ...]]:
    """Return the declared name and values of an effect of one prior standard deviation, at its second site if any."""
    effect = next(one for one in LIBRARY if one.name == name)
    return (name if effect.sites == 1 else f"{name}.1"), effect.prior_sd


@pytest.mark.parametrize(
    ("effects", "says"),
    [
        ({"gravty": (0.1,)}, "gravty is no effect of the library; did you mean 'gravity'?"),
        ({"gravity": (0.1,)}, r"gravity needs 3 values \[g, g, g\]; got 1"),
        ({"friction": (-0.1,)}, "friction must not be negative"),
        ({"inclusion": (1.0,)}, "inclusion is at one of 36 sites; write inclusion.SITE with a number from 0 to 35"),
        ({"inclusion.36": (1.0,)}, "with a number from 0 to 35"),
        ({"inclusion.014": (1.0,)}, "with a number from 0 to 35"),
        ({f"inclusion.{'9' * 5000}": (1.0,)}, "with a number from 0 to 35"),
        ({"friction.0": (0.1,)}, "friction has no sites; write friction"),
        ({"swing": (1.0, 1.0)}, "applies only to a sheet with weight and no bed"),
        ({"tool_latency": (0.1,)}, "tool_latency needs what the tool reports after each frame"),
        ({"gravity": (0.1, 0.0, np.nan)}, "finite numbers only"),
    ],
)
def test_an_effect_that_cannot_be_used_is_refused_by_name(effects, says):
    with pytest.raises(OptionError, match=says):
        Estimator(with_effects(DECLARATION, **effects))


@pytest.mark.parametrize("name", ["explicit", "adam", "nnls", "unscented"])
def test_filters_without_a_force_balance_refuse_effects(name):
    with pytest.raises(OptionError, match=f"need the filter 'implicit'; this one is '{name}'"):
        Estimator(with_effects(DECLARATION, stretch=(0.1,)), config=EstimatorConfig(filter=name))


def test_springs_along_edges_refuse_effects():
    with pytest.raises(OptionError, match="need membrane 'triangles'"):
        Estimator(with_effects(DECLARATION, stretch=(0.1,)), config=EstimatorConfig(membrane="edges"))


@pytest.mark.parametrize("name", ["bed", "friction"])
def test_an_effect_of_the_bed_is_refused_for_a_sheet_without_one(name):
    key, values = usual(name)
    with jax.enable_x64(True), pytest.raises(OptionError, match=f"{name} has nothing to act on in this sheet"):
        CorrectedModel.build(sheet(), with_effects(IN_THE_AIR, **{key: values}))


CARRIED = [effect for effect in LIBRARY if not effect.needs_later_reports]


@pytest.mark.parametrize("effect", CARRIED, ids=lambda one: one.name)
def test_every_effect_of_the_library_changes_some_part_of_a_sheet_that_it_applies_to(effect):
    key, values = usual(effect.name)
    declaration = with_effects(UPRIGHT if effect.hanging else DECLARATION, **{key: values})
    with jax.enable_x64(True):
        model = CorrectedModel.build(sheet(), declaration)
        changed = [part for part in PARTS if model.that_change(part)]
    assert changed
    assert ("view" in changed or "tool" in changed) == (effect.sensing or effect.name == "surface_height")


def test_values_stand_at_their_site_in_the_order_in_which_effects_act():
    declared = declared_effects(with_effects(DECLARATION, **{"camera_bias": (0.0,) * 6, "inclusion.7": (0.5,)}))
    assert list(declared) == ["inclusion", "camera_bias"]
    np.testing.assert_array_equal(declared["inclusion"], 0.5 * (np.arange(36) == 7))


def test_declared_gravity_is_the_sheet_declared_with_that_gravity():
    """0.4 g sideways, and none of the weight's own: a second way to the same energy."""
    with jax.enable_x64(True):
        x = jnp.asarray(lifts()[2].x)
        model = CorrectedModel.build(sheet(), with_effects(DECLARATION, gravity=(0.4, 0.0, 1.0)))
        forces = model.at_rest.internal_gradient(x)
        plain = surrogate(sheet(), DECLARATION)
        weight = next(term for term in plain.terms if isinstance(term, Weight))
        more = np.asarray(weight.mass)[:, None] * 9.80665 * np.array([0.4, 0.0, 1.0])
        np.testing.assert_allclose(forces, plain.internal_gradient(x) - more, rtol=0, atol=EXACT)


def test_a_model_looks_at_what_a_moved_camera_sees():
    with jax.enable_x64(True):
        model = CorrectedModel.build(sheet(), with_effects(DECLARATION, camera_bias=(1e-3, 2e-3, 3e-3, 0.0, 0.0, 0.0)))
        x = jnp.asarray(lifts()[2].x)
        seen = look(model.model(resting(jnp.asarray(sheet().rest)), jnp.zeros(3)), x)
        np.testing.assert_allclose(seen, x + jnp.array([[1e-3, 2e-3, 3e-3]]), rtol=0, atol=EXACT)
        assert model.that_change("view") == ["camera_bias"] and not model.that_change("tool")
