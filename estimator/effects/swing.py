"""Swing of a hanging sheet after its grip stops.

It is the lowest mode, excited by the grip alone. For a chain of length l that hangs by one end, and a sheet alike,

    w^2 = (j / 2)^2 g / l    j = 2.4048, the first zero of the Bessel function J0 [D. Bernoulli 1732]

With the acceleration a of the grip across gravity, the share e of the mass that acts, and the damping rate c, the
deflection d follows

    d'' + 2 c d' + w^2 / e d = -a

and the sheet hangs as if pulled by m w^2 d. This is a closed form, without time steps from frame to frame. The grip
moves straight from report to report, so that a is an impulse at each report.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics.environment import Weight
from .effect import Effect
from .sheet_model import FrameContext, SheetModel
from .terms import DeadLoad

BESSEL = 2.404825557695773
"""First zero of J0."""
MIN_MASS_SHARE = 0.05
"""Share of the mass below which the pull is interpolated to 0, because the period goes to 0 there."""
MIN_LENGTH = 1e-3
"""Smallest length of a hanging sheet [m]; keeps w^2 finite."""
MIN_GRAVITY = 1e-9
"""Gravity that is added in squares [m/s^2], so that the direction of no gravity is finite."""
CRITICAL_SHARE = 1e-6
"""Share of w^2 that |w^2 - c^2| is at least: both solutions stay finite at critical damping."""


def _swing(model: SheetModel, theta: Float[Array, " 2"], context: FrameContext) -> SheetModel:
    """Add the pull of the swing.

    theta: the share e of the mass that acts, air that moves with it included, and the damping rate c [1/s].
    """
    weight, load = model.term(Weight), model.term(DeadLoad)
    g = jnp.sqrt(jnp.sum(weight.gravity**2) + MIN_GRAVITY**2)
    down = weight.gravity / g
    square = (BESSEL / 2) ** 2 * g / jnp.maximum(jnp.ptp(context.rest @ down), MIN_LENGTH)
    share = jnp.maximum(theta[0], MIN_MASS_SHARE)
    d = -_impulse_response(model.time - context.report_times, square / share, theta[1]) @ _impulses(context)
    pull = jnp.minimum(theta[0] / MIN_MASS_SHARE, 1.0) * square * (d - (d @ down) * down)
    return model.with_term(eqx.tree_at(lambda t: t.force, load, load.force + weight.mass[:, None] * pull[None]))


def _impulses(context: FrameContext) -> Float[Array, "reports 3"]:
    """Return the change of the grip's velocity at each report [m/s]; it rests before the first and after the last."""
    duration, displacement = jnp.diff(context.report_times), jnp.diff(context.reports, axis=0)
    velocity = jnp.where(duration[:, None] > 0, displacement / jnp.where(duration > 0, duration, 1.0)[:, None], 0.0)
    rest = jnp.zeros((1, 3))
    return jnp.diff(jnp.concatenate([rest, velocity, rest]), axis=0)


def _impulse_response(
    ago: Float[Array, " reports"], square: Float[Array, ""], rate: Float[Array, ""]
) -> Float[Array, " reports"]:
    """Return the deflection by a unit impulse some time ago [s], for the undamped w^2 and a damping rate."""
    since, smallest = jnp.maximum(ago, 0.0), CRITICAL_SHARE * square
    under, over = (jnp.sqrt(jnp.maximum(sign * (square - rate**2), smallest)) for sign in (1, -1))
    underdamped = jnp.exp(-rate * since) * jnp.sin(under * since) / under
    overdamped = (jnp.exp((over - rate) * since) - jnp.exp(-(over + rate) * since)) / (2 * over)
    return jnp.where(square > rate**2, underdamped, overdamped)


SWING = (
    Effect(
        name="swing",
        acts=_swing,
        units=("", "1/s"),
        prior_sd=(1.0, 5.0),
        initial_guesses=((1.0, 1.0), (2.0, 1.0)),  # the sheet alone, and with the same mass of air
        source="the sheet's own mass; a cloth in air swings for a second",
        confounded_with=("inertia", "image_latency", "viscous_drag"),
        non_negative=True,
        hanging=True,
    ),
)
