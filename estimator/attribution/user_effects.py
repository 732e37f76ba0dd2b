"""Check effects that a user adds, before minutes are spent on fits."""

import jax
import jax.numpy as jnp
import numpy as np

from ..effects import LIBRARY
from ..effects.effect import Effect
from ..effects.sheet_model import FrameContext, SheetModel, look
from .problem import Problem

ROUNDING = 1e-9
"""Change of a force [N] or position [m] that counts as none."""


def check_effects(problem: Problem) -> None:
    """Check every effect that is not in the library on one frame.

    Raises:
        ValueError: two effects have one name; or one fails, changes the shape of a part of the model, changes the model
            where its parameters are 0, has no finite derivative there, or has no effect at all.
    """
    names = [effect.name for effect in problem.sheet.library]
    if duplicates := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"effects must have different names; several are called {', '.join(duplicates)}.")
    states = np.stack([timed.state for timed in problem.history.frames])
    last = len(states) - 1
    context, frame = problem.history.context(last, states), problem.history.frames[last].frame
    plain = problem.sheet.plain(context, frame.displacement)
    for effect in problem.sheet.library:
        if effect not in LIBRARY:
            _check(effect, plain, context, jnp.asarray(states[last]))


def _check(effect: Effect, plain: SheetModel, context: FrameContext, x: jax.Array) -> None:
    """Check one effect on a frame with particles at x."""
    zero = jnp.zeros(effect.size)
    try:
        changed = effect.acts(plain, zero, context)
    except Exception as failure:
        raise ValueError(f"Effect {effect.name}: acts(model, theta, context) failed: {failure}") from failure
    shapes = [jax.tree.map(lambda part: (jnp.shape(part), jnp.result_type(part)), one) for one in (plain, changed)]
    if jax.tree.structure(plain) != jax.tree.structure(changed) or shapes[0] != shapes[1]:
        raise ValueError(
            f"Effect {effect.name} must return a SheetModel with the same parts, shapes and types as it is given; "
            "change parts by equinox.tree_at, and numbers by jax.numpy."
        )

    def parts(model: SheetModel) -> jax.Array:
        several = (model.energy.internal_gradient(x), look(model, x), model.tool, model.energy.rest, model.force_factor)
        return jnp.concatenate([part.ravel() for part in several])

    def outputs(theta: jax.Array) -> jax.Array:
        return parts(effect.acts(plain, theta, context))

    if not np.allclose(outputs(zero), parts(plain), rtol=0, atol=ROUNDING):
        raise ValueError(f"Effect {effect.name} must change nothing where all its parameters are 0.")
    derivative = np.asarray(jax.jacfwd(outputs)(zero))
    if not np.isfinite(derivative).all():
        bad = np.flatnonzero(~np.isfinite(derivative).all(axis=0)).tolist()
        raise ValueError(f"Effect {effect.name}: the derivative at 0 is not finite along the parameters {bad}.")
    if not (derivative.any() or effect.initial_guesses):
        raise ValueError(f"Effect {effect.name} changes neither forces, anchors, tool nor view to first order.")
