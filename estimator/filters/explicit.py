"""The paper's extended Kalman filter: positions observed through the simulator f, with multiple shooting.

    x_m+1 = f(x_m, u_m, b) + noise,  noise ~ N(0, V)

for k samples m, the latest and others since the last cut or suture, with J = df/db through the sweeps:

    S = J Sigma J^T + blkdiag(V),  K = Sigma J^T S^-1,  mean += K (x_ref - x_pred),  Sigma = (I - K J) Sigma

Computed in the information form, which is the same.

Where the paper has a slip: its stacked samples have one noise that is common to all (R = [I ... I]), which no sensor
has; here V is block-diagonal. An old sample that is drawn again is counted again, as in the paper. A mean below zero is
simulated as zero and stays as it is.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from jiggle_mj.estimator.belief import BoundaryBelief
from jiggle_mj.estimator.environment import Grip
from jiggle_mj.estimator.xpbd import XPBD

AT_ONCE = 100
"""Columns of the Jacobian that are computed together, which bounds the memory."""


class Shots(eqx.Module):
    """Samples of the trajectory, each of one step."""

    start: Float[Array, "k n 3"]
    """x_m, the particles before the step [m]."""
    tip: Float[Array, "k 3"]
    """u_m, where the tip moved [m]."""
    length: Float[Array, "k n"]
    """Rest length of each particle's spring to the tip [m]."""
    stiffness: Float[Array, "k n"]
    """Of those springs, zero for particles that are not held [N/m]."""
    end: Float[Array, "k n 3"]
    """x_m+1, what was observed after it; anything finite where nothing was [m]."""
    precision: Float[Array, "k n"]
    """Inverse variance of each coordinate of `end`, zero where nothing was observed [1/m^2]."""


class ExplicitFilter(eqx.Module):
    """The filter for one sheet."""

    simulator: XPBD
    sweeps: int = eqx.field(static=True)
    """Of a step."""

    def update(self, belief: BoundaryBelief, shots: Shots) -> BoundaryBelief:
        """Take the samples into the belief."""
        mean = belief.mean()
        b = jnp.maximum(mean, 0)
        columns = jnp.eye(len(b), dtype=b.dtype)

        def one(belief: BoundaryBelief, shot: Shots) -> tuple[BoundaryBelief, None]:
            grip = Grip(vertices=np.arange(len(b))[:, None], tip=shot.tip, length=shot.length, stiffness=shot.stiffness)

            def f(b):
                return self.simulator.step(shot.start, b, grip, sweeps=self.sweeps)

            slope = jax.lax.map(lambda d: jax.jvp(f, (b,), (d,))[1], columns, batch_size=AT_ONCE)
            weighted = slope * shot.precision[None, :, None]
            gained = jnp.einsum("ani,bni->ab", weighted, slope)
            residual = shot.end - f(b)
            return belief.add(gained, jnp.einsum("ani,ni->a", weighted, residual) + gained @ mean), None

        return jax.lax.scan(one, belief, shots)[0]


def draw_samples(latest: int, since: int, k: int, rng: np.random.Generator) -> Int[np.ndarray, " _k"]:
    """The latest time step and k - 1 others, uniformly from `since` to the one before it, as far as there are any."""
    earlier = np.arange(since, latest)
    return np.append(rng.choice(earlier, size=min(k - 1, len(earlier)), replace=False), latest)
