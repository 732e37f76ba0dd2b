"""The paper's controllers: where the tip goes next, with the tissue in the jaws.

All predict one step with the paper's simulator f. LG-D and LG-H descend the loss from the tip. SL-D descends it from
many samples of the workspace and takes a truncated step towards the best. PMP pulls in one direction and uses no
estimate.

The paper's losses add entropy or displacement, energy and workspace without units. Here each is divided by a scale:

    L_D = -D / D_1cm       + U / U_max + sigma max(0, Omega - 1)
    L_H = ln |I - K J| / n + U / U_max + sigma max(0, Omega - 1)

with U the mean boundary energy, U_max its limit, and D_1cm the value of D for a displacement of all particles by 1 cm
at the prior. The paper gives neither sigma, alpha, gamma nor the box that samples are drawn from.
"""

from collections.abc import Callable
from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from ..filters.shots import slopes
from ..map_rows import map_rows
from ..physics.environment import Grip
from ..physics.simulator import SWEEPS_PER_STEP
from ..physics.xpbd import XPBD
from .objectives import boundary_energy, log_shrinkage, outside, uncertainty_weighted_displacement

WORKSPACE_WEIGHT = 100.0
"""Sigma: 1 cm below the ground costs as much as the energy's limit."""
DESCENT_RATE = 2e-4
"""Alpha, the step of the gradient descent [m^2]: a loss that changes by 1 over 1 cm moves the tip by 2 cm."""
N_SAMPLES, N_ITERATIONS = 100, 5
"""SL-D's samples, and the descent steps of each; both from the paper."""
KEPT_SHARE = 0.1
"""Share of SL-D's best samples that the search for the next action starts with."""
PRIOR_LIFT = 0.01
"""Displacement of all particles that scales D [m]; see D_1cm above."""
MIN_DISTANCE = 1e-12
"""Distance that is taken as 0 [m], so that a step of length 0 has no direction instead of NaN."""

Loss = Callable[[Float[Array, " 3"]], Float[Array, ""]]


class Situation(eqx.Module):
    """What a controller knows: the sheet, the grip and the current belief."""

    x: Float[Array, "n 3"]
    """Positions [m]."""
    tip: Float[Array, " 3"]
    """Position of the tip [m]."""
    length: Float[Array, " n"]
    """Rest length of each particle's spring to the tip [m]."""
    stiffness: Float[Array, " n"]
    """Stiffness of those springs, zero for particles that are not held [N/m]."""
    b: Float[Array, " n"]
    """Mean stiffness of the attachments, not negative [N/m]."""
    covariance: Float[Array, "n n"]
    """Covariance of b [N^2/m^2]."""


class Scales(eqx.Module):
    """Scales by which the terms of a loss are divided."""

    displacement: Float[Array, ""]
    """Typical size of the displacement objective after a pull of 1 cm, D_1cm [m N^2/m^2]."""
    energy: Float[Array, ""]
    """U_max, the limit of the mean boundary energy [J]."""
    noise: Float[Array, ""]
    """Standard deviation of an observed coordinate [m]."""

    @classmethod
    def at_prior(
        cls, rest: Float[Array, "n 3"], covariance: Float[Array, "n n"], *, energy: float, noise: float
    ) -> Self:
        """Return the scales for a sheet at rest under the prior.

        Args:
            rest: positions [m].
            covariance: of b at the prior [N^2/m^2].
            energy: limit of the mean boundary energy [J].
            noise: standard deviation of an observed coordinate [m].
        """
        lifted = rest + jnp.array([[0.0, 0.0, PRIOR_LIFT]])
        return cls(
            displacement=uncertainty_weighted_displacement(lifted, rest, covariance),
            energy=jnp.asarray(energy),
            noise=jnp.asarray(noise),
        )


def displacement_loss(simulator: XPBD, situation: Situation, scales: Scales) -> Loss:
    """Return L_D as a function of the tip [m]."""

    def loss(tip: Float[Array, " 3"]) -> Float[Array, ""]:
        x = next_state(simulator, situation, tip, situation.b)
        displacement = uncertainty_weighted_displacement(x, simulator.rest, situation.covariance)
        return _risk(simulator, situation, scales, tip, x) - displacement / scales.displacement

    return loss


def entropy_loss(simulator: XPBD, situation: Situation, scales: Scales) -> Loss:
    """Return L_H as a function of the tip [m]; it costs n times as much as L_D."""

    def loss(tip: Float[Array, " 3"]) -> Float[Array, ""]:
        def f(b: Float[Array, " n"]) -> Float[Array, "n 3"]:
            return next_state(simulator, situation, tip, b)

        dx_db = slopes(f, situation.b)
        entropy_change = log_shrinkage(dx_db, situation.covariance, scales.noise) / len(dx_db)
        return _risk(simulator, situation, scales, tip, f(situation.b)) + entropy_change

    return loss


def next_state(
    simulator: XPBD, situation: Situation, tip: Float[Array, " 3"], b: Float[Array, " n"]
) -> Float[Array, "n 3"]:
    """Return f(x_t, a, b), the state after one step of the tip to `tip` [m]."""
    grip = Grip.of(tip, situation.length, situation.stiffness)
    return simulator.step(situation.x, b, grip, sweeps=SWEEPS_PER_STEP)


def _risk(
    simulator: XPBD, situation: Situation, scales: Scales, tip: Float[Array, " 3"], x: Float[Array, "n 3"]
) -> Float[Array, ""]:
    """Return the energy and workspace terms of both losses."""
    energy = boundary_energy(x, simulator.rest, situation.b) / len(x)
    return energy / scales.energy + WORKSPACE_WEIGHT * outside(tip)


def local_step(loss: Loss, tip: Float[Array, " 3"], *, longest: float | Array) -> Float[Array, " 3"]:
    """Return LG-D's or LG-H's action a_t = a_t-1 - alpha grad L, no further from the tip than `longest` [m]."""
    return _towards(tip, tip - DESCENT_RATE * jax.grad(loss)(tip), longest)


class Samples(eqx.Module):
    """Tips that SL-D has tried, best first."""

    tips: Float[Array, "k 3"]
    """Positions [m]."""
    loss: Float[Array, " k"]
    """Loss of each; infinite where it is not finite."""


def large_step(
    loss: Loss,
    low: Float[Array, " 3"],
    high: Float[Array, " 3"],
    key: PRNGKeyArray,
    previous: Samples | None = None,
    *,
    samples: int = N_SAMPLES,
    iterations: int = N_ITERATIONS,
) -> Samples:
    """Return SL-D's search: uniform samples of a box and the best previous ones, each moved by gradient descent.

    Args:
        loss: function of a tip.
        low: lower corner of the workspace [m].
        high: upper corner [m].
        key: of the samples.
        previous: result of the search for the last action.
        samples: number of samples.
        iterations: descent steps of each.

    Returns:
        Where they ended; those whose loss is not finite come last.
    """
    tips = jax.random.uniform(key, (samples, 3), low.dtype, low[None], high[None])
    if previous is not None:
        kept = round(KEPT_SHARE * samples)
        tips = tips.at[:kept].set(previous.tips[:kept])

    def descend(tip: Float[Array, " 3"]) -> tuple[Float[Array, " 3"], Float[Array, ""]]:
        def step(tip: Float[Array, " 3"], _: None) -> tuple[Float[Array, " 3"], None]:
            return jnp.clip(tip - DESCENT_RATE * jax.grad(loss)(tip), low, high), None

        tip, _ = jax.lax.scan(step, tip, length=iterations)
        return tip, loss(tip)

    tips, losses = map_rows(descend, tips)
    losses = jnp.where(jnp.isfinite(losses), losses, jnp.inf)
    order = jnp.argsort(losses)
    return Samples(tips=tips[order], loss=losses[order])


def truncated_step(samples: Samples, tip: Float[Array, " 3"], *, longest: float | Array) -> Float[Array, " 3"]:
    """Return SL-D's action: towards the best sample by gamma, `longest` [m], or to the sample where it is nearer."""
    return _towards(tip, samples.tips[0], longest)


PRIMITIVES = {
    "up": (0.0, 0.0, 1.0),
    "forward": (0.0, 1.0, 0.0),
    "backward": (0.0, -1.0, 0.0),
    "left": (-1.0, 0.0, 0.0),
    "right": (1.0, 0.0, 0.0),
}
"""Directions of the paper's motion primitives; down is forbidden, because the ground is there."""


def _towards(tip: Float[Array, " 3"], to: Float[Array, " 3"], longest: float | Array) -> Float[Array, " 3"]:
    """Return the point towards `to` that is no further from the tip than `longest` [m]."""
    displacement = to - tip
    distance = jnp.linalg.norm(displacement)
    return tip + displacement * jnp.minimum(1.0, longest / jnp.maximum(distance, MIN_DISTANCE))
