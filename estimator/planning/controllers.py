"""The paper's controllers: where the tip goes next, with the tissue in the jaws.

All look one step ahead through the paper's simulator f. LG-D and LG-H descend the loss from the tip; SL-D descends it
from many samples of the workspace and goes a truncated step towards the best; PMP pulls one way and looks at nothing.

The paper's losses add entropy or displacement, energy and workspace without units. Here each is over a scale:

    L_D = -D / D_1cm       + U / U_max + sigma max(0, Omega - 1)
    L_H = ln |I - K J| / n + U / U_max + sigma max(0, Omega - 1)

with U the mean boundary energy, U_max its limit, and D_1cm what a displacement of all particles by 1 cm is worth at the
prior. The paper states neither sigma, alpha, gamma nor the box that samples are drawn from.
"""

from collections.abc import Callable
from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from ..filters.shots import slopes
from ..physics.environment import Grip
from ..physics.simulator import SWEEPS_PER_STEP
from ..physics.xpbd import XPBD
from .objectives import boundary_energy, log_shrinkage, outside, uncertainty_weighted_displacement

OUTSIDE = 100.0
"""Sigma: 1 cm below the ground costs as much as the energy's limit."""
ALPHA = 2e-4
"""Of the descent [m^2]: a loss that changes by 1 over 1 cm moves the tip by 2 cm."""
SAMPLES, ITERATIONS, KEPT = 100, 5, 0.1
"""Of SL-D, and the share of the best samples that the next action begins with."""

Loss = Callable[[Float[Array, " 3"]], Float[Array, ""]]


class Situation(eqx.Module):
    """What a controller knows: the sheet, the grip and the belief of the moment."""

    x: Float[Array, "n 3"]
    """Positions [m]."""
    tip: Float[Array, " 3"]
    """[m]."""
    length: Float[Array, " n"]
    """Rest length of each particle's spring to the tip [m]."""
    stiffness: Float[Array, " n"]
    """Of those springs, zero for particles that are not held [N/m]."""
    b: Float[Array, " n"]
    """Non-negative mean [N/m]."""
    covariance: Float[Array, "n n"]
    """Of b [N^2/m^2]."""


class Scales(eqx.Module):
    """What the parts of a loss are measured by."""

    displacement: Float[Array, ""]
    """D_1cm [m N^2/m^2]."""
    energy: Float[Array, ""]
    """U_max, of the mean boundary energy [J]."""
    noise: Float[Array, ""]
    """Standard deviation of an observed coordinate [m]."""

    @classmethod
    def at_prior(
        cls, rest: Float[Array, "n 3"], covariance: Float[Array, "n n"], *, energy: float, noise: float
    ) -> Self:
        """Of a sheet at rest whose b has that covariance."""
        lifted = rest + jnp.array([[0.0, 0.0, 0.01]])
        return cls(
            displacement=uncertainty_weighted_displacement(lifted, rest, covariance),
            energy=jnp.asarray(energy),
            noise=jnp.asarray(noise),
        )


def displacement_loss(simulator: XPBD, situation: Situation, scales: Scales) -> Loss:
    """L_D of a tip."""

    def loss(tip: Float[Array, " 3"]) -> Float[Array, ""]:
        x = ahead(simulator, situation, tip, situation.b)
        worth = uncertainty_weighted_displacement(x, simulator.rest, situation.covariance)
        return _risk(simulator, situation, scales, tip, x) - worth / scales.displacement

    return loss


def entropy_loss(simulator: XPBD, situation: Situation, scales: Scales) -> Loss:
    """L_H of a tip; n times as much work as L_D."""

    def loss(tip: Float[Array, " 3"]) -> Float[Array, ""]:
        def f(b: Float[Array, " n"]) -> Float[Array, "n 3"]:
            return ahead(simulator, situation, tip, b)

        slope = slopes(f, situation.b)
        worth = log_shrinkage(slope, situation.covariance, scales.noise) / len(slope)
        return _risk(simulator, situation, scales, tip, f(situation.b)) + worth

    return loss


def ahead(simulator: XPBD, situation: Situation, tip: Float[Array, " 3"], b: Float[Array, " n"]) -> Float[Array, "n 3"]:
    """f(x_t, a, b), the state one step ahead [m]."""
    grip = Grip.of(tip, situation.length, situation.stiffness)
    return simulator.step(situation.x, b, grip, sweeps=SWEEPS_PER_STEP)


def _risk(
    simulator: XPBD, situation: Situation, scales: Scales, tip: Float[Array, " 3"], x: Float[Array, "n 3"]
) -> Float[Array, ""]:
    energy = boundary_energy(x, simulator.rest, situation.b) / len(x)
    return energy / scales.energy + OUTSIDE * outside(tip)


def local_step(loss: Loss, tip: Float[Array, " 3"], *, longest: float | Array) -> Float[Array, " 3"]:
    """LG-D or LG-H: a_t = a_t-1 - alpha grad L, no further than `longest` [m]."""
    return _towards(tip, tip - ALPHA * jax.grad(loss)(tip), longest)


class Samples(eqx.Module):
    """The tips that SL-D has tried, best first."""

    tips: Float[Array, "k 3"]
    """[m]."""
    loss: Float[Array, " k"]


def large_step(
    loss: Loss,
    low: Float[Array, " 3"],
    high: Float[Array, " 3"],
    key: PRNGKeyArray,
    before: Samples | None = None,
    *,
    samples: int = SAMPLES,
    iterations: int = ITERATIONS,
) -> Samples:
    """SL-D's search: uniform samples of a box and the best of those before, each descended.

    Args:
        loss: of a tip.
        low: lower corner of the workspace [m].
        high: upper corner [m].
        key: draws the samples.
        before: what the search for the last action ended with.
        samples: how many.
        iterations: of the descent of each.

    Returns:
        Where they ended; those whose loss is no number come last.
    """
    tips = jax.random.uniform(key, (samples, 3), low.dtype, low[None], high[None])
    if before is not None:
        kept = round(KEPT * samples)
        tips = tips.at[:kept].set(before.tips[:kept])

    def descended(tip: Float[Array, " 3"]) -> tuple[Float[Array, " 3"], Float[Array, ""]]:
        def one(tip: Float[Array, " 3"], _: None) -> tuple[Float[Array, " 3"], None]:
            return jnp.clip(tip - ALPHA * jax.grad(loss)(tip), low, high), None

        tip, _ = jax.lax.scan(one, tip, length=iterations)
        return tip, loss(tip)

    tips, found = _each(descended, tips)
    found = jnp.where(jnp.isfinite(found), found, jnp.inf)
    order = jnp.argsort(found)
    return Samples(tips=tips[order], loss=found[order])


def truncated_step(found: Samples, tip: Float[Array, " 3"], *, longest: float | Array) -> Float[Array, " 3"]:
    """SL-D's action: towards the best sample by gamma, `longest` [m], or all the way where it is nearer."""
    return _towards(tip, found.tips[0], longest)


PRIMITIVES = {
    "up": (0.0, 0.0, 1.0),
    "forward": (0.0, 1.0, 0.0),
    "backward": (0.0, -1.0, 0.0),
    "left": (-1.0, 0.0, 0.0),
    "right": (1.0, 0.0, 0.0),
}
"""The paper's motion primitives; down is forbidden, as the ground is there."""


def _each(function: Callable, tips: Float[Array, "k 3"]):
    """Of every tip: in turn on a CPU, which is faster there, and at once on a GPU."""
    return jax.lax.platform_dependent(
        tips, cpu=lambda tips: jax.lax.map(function, tips), default=lambda tips: jax.vmap(function)(tips)
    )


def _towards(tip: Float[Array, " 3"], to: Float[Array, " 3"], longest: float | Array) -> Float[Array, " 3"]:
    way = to - tip
    far = jnp.linalg.norm(way)
    return tip + way * jnp.minimum(1.0, longest / jnp.maximum(far, 1e-12))
