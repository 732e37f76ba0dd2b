"""The paper's baseline: Adam [Kingma & Ba 2015, arXiv:1412.6980] on the multiple-shooting loss through the simulator f.

    L(b) = 1/k sum_m |x_m+1 - f(x_m, u_m, b)|^2,   particles that were not seen left out,

a number of steps per frame from the last estimate, moments of the gradient carried on, b kept at b >= 0. The paper
states neither rate nor steps; see below. There is no uncertainty: belief, sd, entropy and nis are NaN, 'not stated'.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from jiggle_mj.observation import Declaration

from ..belief.boundary_belief import BoundaryBelief
from ..physics.mesh import SheetMesh
from ..physics.simulator import SWEEPS_PER_STEP, simulator
from ..physics.xpbd import XPBD
from .evidence import Evidence, Filter, Update, unavailable
from .shots import ShotHistory, Shots, predicted

RATE = 1e-3
"""Adam's learning rate, which is about how far b moves in a step [membrane stiffness]."""
STEPS = 25
"""Of Adam, each frame."""


class AdamShooting(Filter):
    """Gradient descent for one sheet, with the samples so far."""

    def __init__(self, mesh: SheetMesh, declaration: Declaration, *, grip_stiffness: float, samples: int) -> None:
        """Build the simulator; see `MultipleShooting`."""
        self._simulator = simulator(mesh, declaration)
        self._history = ShotHistory(grip_stiffness=grip_stiffness, samples=samples)
        self._rate = RATE * declaration.membrane_stiffness
        self._moments = optax.adam(self._rate).init(jnp.zeros(mesh.n))

    def forget(self) -> None:
        """After a cut or suture: draw no step from before it."""
        self._history.forget()

    def update(
        self, belief: BoundaryBelief, b: Float[Array, " n"], evidence: Evidence, start: Float[Array, "n 3"]
    ) -> Update:
        """Descend from b on one frame and k - 1 earlier ones; belief and start are not used."""
        b, moments = descend(self._simulator, b, self._moments, self._history.add(evidence), rate=self._rate)
        if np.isfinite(b).all():
            self._moments = moments
        else:
            self._history.reject()
        none = unavailable(b)
        return Update(
            belief=BoundaryBelief(precision=jnp.broadcast_to(none, (len(b), len(b))), shift=none),
            x=evidence.y,
            b=b,
            sd=none,
            probability=none,
            entropy=none[0],
            nis=none[0],
            converged=jnp.asarray(True),
        )


def loss(simulator: XPBD, b: Float[Array, " n"], shots: Shots) -> Float[Array, ""]:
    """The paper's L [m^2]; a sample that fills up M counts nothing."""
    seen = jnp.trace(shots.precision, axis1=2, axis2=3) > 0
    end = jax.lax.map(lambda shot: predicted(simulator, shot, b, sweeps=SWEEPS_PER_STEP), shots)
    squared = jnp.sum(jnp.where(seen, jnp.sum((shots.end - end) ** 2, axis=2), 0))
    return squared / jnp.sum(jnp.any(seen, axis=1)).astype(b.dtype)


@eqx.filter_jit
def descend(
    simulator: XPBD, b: Float[Array, " n"], moments: optax.OptState, shots: Shots, *, rate: float
) -> tuple[Float[Array, " n"], optax.OptState]:
    """B after `STEPS` of Adam, and its moments; `rate` [N/m]."""
    adam = optax.adam(rate)

    def step(state, _):
        b, moments = state
        slope = jax.grad(loss, argnums=1)(simulator, b, shots)
        with jax.numpy_dtype_promotion("standard"):  # optax raises a float to its integer count
            move, moments = adam.update(slope, moments)
        return (optax.projections.projection_non_negative(optax.apply_updates(b, move)), moments), None

    return jax.lax.scan(step, (b, moments), length=STEPS)[0]
