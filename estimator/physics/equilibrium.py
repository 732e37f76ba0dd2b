"""The sheet's equilibrium x*(b, u) = argmin U by projected Newton, differentiated by the implicit function theorem.

Each step solves with the positive semi-definite stand-in of the Hessian, roughly if that is enough (an inexact Newton
method [Dembo, Eisenstat & Steihaug 1982, doi:10.1137/0719025]), and backtracks until the energy falls enough (Armijo's
rule). Derivatives use the true Hessian at the solution: dx/dtheta = -H^-1 d(grad U)/dtheta. A step that cannot lower
the energy ends the search and is reported, not hidden.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .block_tridiagonal import BlockTridiagonal, Layout, add_to_diagonal, cholesky, multiply, solve
from .energy import SheetEnergy

ROUGH = 0.1
"""Share of the unbalanced force that a step may leave in the linear model."""


class Equilibrium(eqx.Module):
    """What the search ended with."""

    x: Float[Array, "n 3"]
    """[m]."""
    force: Float[Array, ""]
    """Largest unbalanced force component [N]."""
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


def equilibrium(
    energy: SheetEnergy,
    b: Float[Array, " n"],
    start: Float[Array, "n 3"],
    *,
    force_tolerance: float | Array = 1e-8,
    max_steps: int = 200,
) -> Equilibrium:
    """Minimise U(x; b) from `start` until no particle feels more than `force_tolerance` [N].

    Reverse and forward differentiable in every float of `energy` and in `b`; not in `start`, on which a minimum does
    not depend.
    """
    dynamic, static = eqx.partition(energy, eqx.is_inexact_array)
    x, force, steps = _search(dynamic, static, b, jax.lax.stop_gradient(start), force_tolerance, max_steps)
    return Equilibrium(x=x, force=force, steps=steps, converged=force <= force_tolerance)


def _search(dynamic, static, b, start, force_tolerance, max_steps):
    """The implicitly differentiated search; see `equilibrium`."""

    @jax.custom_jvp
    def solution(dynamic, b, start):
        return _minimise(eqx.combine(dynamic, static), b, start, force_tolerance, max_steps)

    @solution.defjvp
    def tangent(primals, tangents):
        out = solution(*primals)
        primals, tangents = primals[:2], tangents[:2]
        x = out[0]
        _, change = jax.jvp(lambda d, b: eqx.combine(d, static).gradient(x, b), primals, tangents)
        energy = eqx.combine(primals[0], static)
        matrix = energy.hessian(x, primals[1])
        dx = _implicit_solve(energy, matrix, -change)
        return out, (dx, jnp.zeros_like(out[1]), jnp.zeros(out[2].shape, jax.dtypes.float0))

    return solution(dynamic, b, start)


def _implicit_solve(energy, matrix, rhs):
    """H^-1 rhs with a transpose rule, so that reverse mode goes through it."""
    layout = energy.layout
    return jax.lax.custom_linear_solve(
        lambda v: multiply(layout, matrix, v),
        rhs,
        lambda _, r: solve(layout, cholesky(matrix), r),
        symmetric=True,
    )


def _minimise(energy, b, start, force_tolerance, max_steps):
    """Projected Newton with backtracking; returns x, the largest force, and the number of steps."""
    layout = energy.layout

    def newton(state):
        x, value, gradient, count, _ = state
        matrix = energy.hessian(x, b, positive=True)
        shift = 1e-9 * jnp.max(jnp.abs(matrix.diagonal))
        matrix = add_to_diagonal(layout, matrix, jnp.broadcast_to(shift * jnp.eye(3), (len(x), 3, 3)))
        step = newton_step(layout, matrix, gradient)
        slope = jnp.sum(step * gradient)

        def too_far(trial):
            length, (new, _) = trial
            return (~(new <= value + 1e-4 * length * slope + 1e-15 * jnp.abs(value))) & (length > 1e-8)

        def halve(trial):
            length, _ = trial
            return length / 2, energy.value_and_gradient(x + length / 2 * step, b)

        untried = (2 * jnp.ones(()), (jnp.full_like(value, jnp.inf), gradient))
        length, (new, pull) = jax.lax.while_loop(too_far, halve, untried)
        stuck = length <= 1e-8
        moved, new, pull = jax.tree.map(partial(jnp.where, stuck), (x, value, gradient), (x + length * step, new, pull))
        return moved, new, pull, count + 1, stuck

    def unfinished(state):
        _, _, gradient, count, stuck = state
        return (jnp.max(jnp.abs(gradient)) > force_tolerance) & (count < max_steps) & ~stuck

    first = (start, *energy.value_and_gradient(start, b), jnp.zeros((), int), jnp.zeros((), bool))
    x, _, gradient, count, _ = jax.lax.while_loop(unfinished, newton, first)
    return x, jnp.max(jnp.abs(gradient)), count


def newton_step(layout: Layout, matrix: BlockTridiagonal, gradient: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """-A^-1 g; on a CPU from a factor in single precision, in two thirds of the time, if that leaves at most `ROUGH`.

    A GPU waits for each block however wide its numbers are, and a factor that was not enough is lost time.
    """

    def exact(matrix, gradient):
        return -solve(layout, cholesky(matrix), gradient)

    def rough_if_enough(matrix, gradient):
        rough_matrix, rough_gradient = jax.tree.map(lambda part: part.astype(jnp.float32), (matrix, gradient))
        rough = -solve(layout, cholesky(rough_matrix), rough_gradient).astype(gradient.dtype)
        left = jnp.linalg.norm(multiply(layout, matrix, rough) + gradient)
        enough = left <= ROUGH * jnp.linalg.norm(gradient)
        return jax.lax.cond(enough, lambda: rough, lambda: exact(matrix, gradient))

    return jax.lax.platform_dependent(matrix, gradient, cpu=rough_if_enough, default=exact)
