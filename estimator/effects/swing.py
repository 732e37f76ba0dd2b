"""A hanging sheet swings on when its grip stops.

Its lowest mode, moved by the grip alone: of a chain that hangs by one end and is l long, and of a sheet alike,

    w^2 = (j / 2)^2 g / l    j = 2.4048, the first zero of the Bessel function J0 [D. Bernoulli 1732]

With the grip's acceleration a across gravity, the share e of its mass that shows, and the damping rate c, it is off by

    d'' + 2 c d' + w^2 / e d = -a

and hangs as if pulled by m w^2 d: there are no steps in time from frame to frame in it. The grip goes straight from
report to report, so that a is a kick at each.
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
LEAST = 0.05
"""Share of the mass below which what swings is interpolated to nothing: its period goes to zero there."""
SHORTEST, WEAKEST = 1e-3, 1e-9
"""Length of a sheet that hangs, and gravity that it hangs by, at least [m, m/s^2]."""


def _swing(model: SheetModel, theta: Float[Array, " 2"], moment: FrameContext) -> SheetModel:
    """theta: the share of the mass that the frames show, air that goes with it included, and the damping rate c."""
    weight, load = model.term(Weight), model.term(DeadLoad)
    g = jnp.sqrt(jnp.sum(weight.gravity**2) + WEAKEST**2)
    down = weight.gravity / g
    square = (BESSEL / 2) ** 2 * g / jnp.maximum(jnp.ptp(moment.rest @ down), SHORTEST)
    share = jnp.maximum(theta[0], LEAST)
    d = -_ringing(model.time - moment.report_times, square / share, theta[1]) @ _kicks(moment)
    pull = jnp.minimum(theta[0] / LEAST, 1.0) * square * (d - (d @ down) * down)
    return model.with_term(eqx.tree_at(lambda t: t.force, load, load.force + weight.mass[:, None] * pull[None]))


def _kicks(moment: FrameContext) -> Float[Array, "reports 3"]:
    """By how much the grip's velocity changes at each report; it stood before the first and after the last [m/s]."""
    lasted, gone = jnp.diff(moment.report_times), jnp.diff(moment.reports, axis=0)
    speed = jnp.where(lasted[:, None] > 0, gone / jnp.where(lasted > 0, lasted, 1.0)[:, None], 0.0)
    stood = jnp.zeros((1, 3))
    return jnp.diff(jnp.concatenate([stood, speed, stood]), axis=0)


def _ringing(
    ago: Float[Array, " reports"], square: Float[Array, ""], rate: Float[Array, ""]
) -> Float[Array, " reports"]:
    """Deflection by a unit kick so long ago of what swings at w^2 without damping [s]."""
    since, nearly = jnp.maximum(ago, 0.0), 1e-6 * square
    under, over = (jnp.sqrt(jnp.maximum(sign * (square - rate**2), nearly)) for sign in (1, -1))
    swings = jnp.exp(-rate * since) * jnp.sin(under * since) / under
    creeps = (jnp.exp((over - rate) * since) - jnp.exp(-(over + rate) * since)) / (2 * over)
    return jnp.where(square > rate**2, swings, creeps)


SWING = (
    Effect(
        name="swing",
        acts=_swing,
        units=("", "1/s"),
        prior_sd=(1.0, 5.0),
        initial_guesses=((1.0, 1.0), (2.0, 1.0)),  # of itself, and with as much air
        source="the sheet's own mass; a cloth in air swings for a second",
        confounded_with=("inertia", "image_latency", "viscous_drag"),
        non_negative=True,
        hanging=True,
    ),
)
