"""The paper's baseline: Adam [Kingma & Ba 2015, arXiv:1412.6980] on the multiple-shooting loss through the simulator f.

    L(b) = 1/k sum_m |x_m+1 - f(x_m, u_m, b)|^2,   over the particles that were seen,

a number of steps in each frame from the last estimate, with the moments of the gradient kept, under b >= 0. The paper
gives neither rate nor steps. There is no uncertainty: belief, sd, entropy and nis are NaN.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from jiggle_mj.options import FilterName

from ..belief.gaussian_belief import GaussianBelief
from ..physics.simulator import SWEEPS_PER_STEP
from ..physics.xpbd import XPBD
from .evidence import Evidence
from .explicit import ShootingState
from .filter import GaussianFilter
from .posterior_summary import Convergence, Update, unavailable
from .shots import ShotHistory, Shots, predicted

RATE = 1e-3
"""Adam's learning rate, about the change of b in a step [membrane stiffness]."""
ADAM_STEPS = 25
"""Steps of Adam in each frame."""


class AdamState(ShootingState):
    """The estimate, the samples of the trajectory, and the moments of the gradient."""

    moments: optax.OptState
    """Adam's moments of the gradient."""


class AdamShooting(GaussianFilter[AdamState]):
    """Gradient descent for one sheet."""

    simulator: XPBD
    """f; see `physics.simulator`."""
    grip_stiffness: float
    """Stiffness of the springs to the tip [N/m]."""
    samples: int
    """k, the samples of each update."""
    rate: float
    """Adam's learning rate [N/m]."""

    @property
    def name(self) -> FilterName:
        """See `Filter.name`."""
        return "adam"

    def init(self, key: PRNGKeyArray) -> AdamState:
        """See `Filter.init`."""
        return AdamState(
            summary=self.init_summary(),
            release_convergence=Convergence.CONVERGED.code,
            changes=(),
            key=key,
            history=ShotHistory.empty(key),
            moments=optax.adam(self.rate).init(jnp.zeros(len(self.prior.shift))),
        )

    def forget(self, state: AdamState) -> AdamState:
        """Return the state after a cut or suture: no step from before is drawn."""
        return replace(state, history=state.history.forgotten())

    def update(self, state: AdamState, evidence: Evidence, start: Float[Array, "n 3"]) -> tuple[AdamState, Update]:
        """See `Filter.update`; descend from b on one frame and k - 1 earlier ones. Belief and start are not used."""
        history, shots = state.history.with_step(evidence, grip_stiffness=self.grip_stiffness).draw(self.samples)
        b, moments = descend(self.simulator, state.summary.b, state.moments, shots, rate=self.rate)
        none = unavailable(b)
        outcome = Update(
            belief=GaussianBelief(precision=jnp.broadcast_to(none, (len(b), len(b))), shift=none),
            x=evidence.y,
            b=b,
            sd=none,
            probability=none,
            entropy=none[0],
            nis=none[0],
            convergence=Convergence.CONVERGED.code,
        )
        if not outcome.explains_the_frame:
            return replace(state, history=history.without_latest()), outcome
        return replace(state, summary=outcome, history=history, moments=moments), outcome


def loss(simulator: XPBD, b: Float[Array, " n"], shots: Shots) -> Float[Array, ""]:
    """Return the paper's L [m^2]; a sample without weight counts nothing."""
    seen = jnp.trace(shots.precision, axis1=2, axis2=3) > 0
    end = jax.lax.map(lambda shot: predicted(simulator, shot, b, sweeps=SWEEPS_PER_STEP), shots)
    squared = jnp.sum(jnp.where(seen, jnp.sum((shots.end - end) ** 2, axis=2), 0))
    return squared / jnp.sum(jnp.any(seen, axis=1)).astype(b.dtype)


@eqx.filter_jit
def descend(
    simulator: XPBD, b: Float[Array, " n"], moments: optax.OptState, shots: Shots, *, rate: float
) -> tuple[Float[Array, " n"], optax.OptState]:
    """Return b after `ADAM_STEPS` steps of Adam [N/m], and the moments; `rate` [N/m]."""
    adam = optax.adam(rate)

    def step(state, _):
        b, moments = state
        gradient = jax.grad(loss, argnums=1)(simulator, b, shots)
        with jax.numpy_dtype_promotion("standard"):  # optax raises a float to its integer count
            move, moments = adam.update(gradient, moments)
        return (optax.projections.projection_non_negative(optax.apply_updates(b, move)), moments), None

    return jax.lax.scan(step, (b, moments), length=ADAM_STEPS)[0]
