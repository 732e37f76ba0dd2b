"""Checks effects that a user adds, before minutes are spent on them."""

import jax
import jax.numpy as jnp
import numpy as np

from ..effects import LIBRARY
from ..effects.effect import Effect
from ..effects.sheet_model import FrameContext, SheetModel
from .problem import Problem
from .sheet import look


def check_effects(problem: Problem) -> None:
    """Try every effect that is not of the library on a frame.

    Raises:
        ValueError: two have one name, one changes the shape of a part of the model, does something where its
            parameters are 0, or has no finite derivative there.
    """
    names = [effect.name for effect in problem.sheet.library]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"effects need names of their own; there are several called {', '.join(twice)}.")
    states = np.stack([one.state for one in problem.history.frames])
    last = len(states) - 1
    moment, frame = problem.history.moment(last, states), problem.history.frames[last].frame
    plain = problem.sheet.plain(moment, frame.way)
    for effect in problem.sheet.library:
        if effect not in LIBRARY:
            _check(effect, plain, moment, jnp.asarray(states[last]))


def _check(effect: Effect, plain: SheetModel, moment: FrameContext, x: jax.Array) -> None:
    zero = jnp.zeros(effect.size)
    try:
        changed = effect.acts(plain, zero, moment)
    except Exception as failure:
        raise ValueError(f"Effect {effect.name}: acts(model, theta, moment) failed: {failure}") from failure
    shapes = [jax.tree.map(lambda part: (jnp.shape(part), jnp.result_type(part)), one) for one in (plain, changed)]
    if jax.tree.structure(plain) != jax.tree.structure(changed) or shapes[0] != shapes[1]:
        raise ValueError(
            f"Effect {effect.name} must return a SheetModel of the same parts, shapes and types as it was given; "
            "change parts by equinox.tree_at, and numbers by jax.numpy."
        )

    def shown(theta: jax.Array) -> jax.Array:
        model = effect.acts(plain, theta, moment)
        parts = (model.energy.internal_gradient(x), look(model, x), model.tool, model.energy.rest)
        return jnp.concatenate([part.ravel() for part in parts])

    without = jnp.concatenate(
        [part.ravel() for part in (plain.energy.internal_gradient(x), look(plain, x), plain.tool, moment.rest)]
    )
    if not np.allclose(shown(zero), without, rtol=0, atol=1e-9):
        raise ValueError(f"Effect {effect.name} must do nothing where all its parameters are 0.")
    derivative = np.asarray(jax.jacfwd(shown)(zero))
    if not np.isfinite(derivative).all():
        bad = np.flatnonzero(~np.isfinite(derivative).all(axis=0)).tolist()
        raise ValueError(f"Effect {effect.name}: no finite derivative at 0 along the parameters {bad}.")
    if not (derivative.any() or effect.initial_guesses):
        raise ValueError(f"Effect {effect.name} changes neither forces, anchors, tool nor view to first order.")
