"""Checks of effects that a user adds."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

from jiggle_mj.estimator.attribution.user_effects import check_effects
from jiggle_mj.estimator.effects import Effect


@pytest.mark.parametrize(
    ("acts", "says"),
    [
        (lambda model, theta, context: eqx.tree_at(lambda m: m.tool, model, model.tool[:2] + theta[0]), "same parts"),
        (
            lambda model, theta, context: eqx.tree_at(lambda m: m.tool, model, model.tool + theta[0] + 1.0),
            "change nothing",
        ),
        (
            lambda model, theta, context: eqx.tree_at(lambda m: m.tool, model, model.tool + jnp.sqrt(theta[0])),
            "the derivative at 0 is not finite along the parameters .0.",
        ),
        (lambda model, theta, context: model, "to first order"),
        (lambda model, theta, context: model.nothing, "failed: 'SheetModel' object has no attribute 'nothing'"),
    ],
)
def test_a_users_effect_is_checked_before_it_is_fitted(light, acts, says):
    mine = Effect(name="mine", acts=acts, units=("m",), prior_sd=(1e-3,), source="me")
    problem = light[0].problem
    sheet_with = dataclasses.replace(problem.sheet, library=(mine,))
    with jax.enable_x64(True), pytest.raises(ValueError, match=says):
        check_effects(dataclasses.replace(problem, sheet=sheet_with))
