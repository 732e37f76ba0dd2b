"""The sheet's equilibrium x*(b, u) = argmin U by Newton's method, differentiated by the implicit function theorem.

Each step solves with the Hessian, or, where the step would not lower the energy, with its positive semi-definite
stand-in: near a minimum of a wrinkled sheet that alone converges slowly. It solves in single precision if that is
accurate enough (an inexact Newton method [Dembo, Eisenstat & Steihaug 1982, doi:10.1137/0719025]), and backtracks until
the energy falls enough (Armijo's rule). Derivatives use the true Hessian at the solution:
dx/dtheta = -H^-1 d(grad U)/dtheta. A step that cannot lower the energy ends the search, and the result says so.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .block_tridiagonal import BlockTridiagonal, Layout, add_to_diagonal, cholesky, multiply, solve
from .energy import SheetEnergy

MAX_LINEAR_RESIDUAL = 0.1
"""Largest residual of the linear system that a single-precision step may have [unbalanced force]."""
HESSIAN_SHIFT = 1e-9
"""Multiple of the identity that makes a positive semi-definite Hessian definite [its largest diagonal entry]."""
ARMIJO_SHARE = 1e-4
"""Share of the linear model's decrease of the energy that a step must reach."""
ENERGY_ROUNDING = 1e-15
"""Increase of the energy that counts as rounding; a few units in the last place of float64 [energy]."""
MIN_STEP_LENGTH = 1e-8
"""Length at which backtracking gives up [Newton step]."""


class Equilibrium(eqx.Module):
    """Result of the search."""

    x: Float[Array, "n 3"]
    """Positions [m]."""
    force: Float[Array, ""]
    """Largest unbalanced force component [N]."""
    steps: Int[Array, ""]
    """Number of Newton steps."""
    converged: Bool[Array, ""]
    """Whether `force` is within the tolerance."""


def equilibrium(
    energy: SheetEnergy,
    b: Float[Array, " n"],
    start: Float[Array, "n 3"],
    *,
    force_tolerance: float | Array = 1e-8,
    max_steps: int = 200,
) -> Equilibrium:
    """Return the minimum of U(x; b) that a search from `start` reaches.

    Reverse and forward differentiable in every float of `energy` and in `b`; not in `start`, on which a minimum does
    not depend.

    Args:
        energy: U without the boundary springs.
        b: stiffness of the boundary springs [N/m].
        start: where the search begins [m].
        force_tolerance: largest component of an unbalanced force at which the search has converged [N].
        max_steps: largest number of Newton steps.
    """
    dynamic, static = eqx.partition(energy, eqx.is_inexact_array)
    x, force, steps = _search(dynamic, static, b, jax.lax.stop_gradient(start), force_tolerance, max_steps)
    return Equilibrium(x=x, force=force, steps=steps, converged=force <= force_tolerance)


def _search(dynamic, static, b, start, force_tolerance, max_steps):
    """Return x, the largest force and the number of steps, implicitly differentiable; see `equilibrium`."""

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
    """Return H^-1 rhs, with a transpose rule for reverse mode."""
    layout = energy.layout
    return jax.lax.custom_linear_solve(
        lambda v: multiply(layout, matrix, v),
        rhs,
        lambda _, r: solve(layout, cholesky(matrix), r),
        symmetric=True,
    )


def _minimise(energy, b, start, force_tolerance, max_steps):
    """Return x, the largest force and the number of steps of Newton's method with backtracking."""
    layout = energy.layout

    def newton(state):
        x, value, gradient, count, convex, _ = state
        matrix = jax.lax.cond(
            convex, lambda: energy.hessian(x, b, positive=True), lambda: energy.hessian(x, b, positive=False)
        )
        shift = HESSIAN_SHIFT * jnp.max(jnp.abs(matrix.diagonal))
        matrix = add_to_diagonal(layout, matrix, jnp.broadcast_to(shift * jnp.eye(3), (len(x), 3, 3)))
        step = newton_step(layout, matrix, gradient)
        slope = jnp.sum(step * gradient)
        uphill = ~convex & ~(slope < 0)  # also where the factor is NaN; the next step has the stand-in

        def too_far(trial):
            length, (new, _) = trial
            highest = value + ARMIJO_SHARE * length * slope + ENERGY_ROUNDING * jnp.abs(value)
            return ~uphill & (~(new <= highest)) & (length > MIN_STEP_LENGTH)

        def halve(trial):
            length, _ = trial
            return length / 2, energy.value_and_gradient(x + length / 2 * step, b)

        untried = (2 * jnp.ones(()), (jnp.full_like(value, jnp.inf), gradient))
        length, (new, new_gradient) = jax.lax.while_loop(too_far, halve, untried)
        stuck = ~uphill & (length <= MIN_STEP_LENGTH)
        after = x + length * step, new, new_gradient
        moved, new, new_gradient = jax.tree.map(partial(jnp.where, stuck | uphill), (x, value, gradient), after)
        return moved, new, new_gradient, jnp.where(uphill, count, count + 1), uphill, stuck

    def unfinished(state):
        _, _, gradient, count, _, stuck = state
        return (jnp.max(jnp.abs(gradient)) > force_tolerance) & (count < max_steps) & ~stuck

    no = jnp.zeros((), bool)
    first = (start, *energy.value_and_gradient(start, b), jnp.zeros((), int), no, no)
    x, _, gradient, count, _, _ = jax.lax.while_loop(unfinished, newton, first)
    return x, jnp.max(jnp.abs(gradient)), count


def newton_step(layout: Layout, matrix: BlockTridiagonal, gradient: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Return the Newton step -A^-1 g [m].

    On a CPU the factor is in single precision, which takes two thirds of the time, unless the step then misses
    `MAX_LINEAR_RESIDUAL`. A GPU waits for each block at either precision, so there a second factor would only cost
    time.
    """

    def exact(matrix, gradient):
        return -solve(layout, cholesky(matrix), gradient)

    def single_if_enough(matrix, gradient):
        single = jax.tree.map(lambda part: part.astype(jnp.float32), (matrix, gradient))
        step = -solve(layout, cholesky(single[0]), single[1]).astype(gradient.dtype)
        residual = jnp.linalg.norm(multiply(layout, matrix, step) + gradient)
        enough = residual <= MAX_LINEAR_RESIDUAL * jnp.linalg.norm(gradient)
        return jax.lax.cond(enough, lambda: step, lambda: exact(matrix, gradient))

    return jax.lax.platform_dependent(matrix, gradient, cpu=single_if_enough, default=exact)
