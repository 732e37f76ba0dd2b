"""The paper's extended Kalman filter: positions observed through the simulator f, with multiple shooting.

    x_m+1 = f(x_m, u_m, b) + noise,  noise ~ N(0, V)

for k samples m, the latest and others since the last cut or suture, with J = df/db through the sweeps:

    S = J Sigma J^T + blkdiag(V),  K = Sigma J^T S^-1,  mean += K (x_ref - x_pred),  Sigma = (I - K J) Sigma

Computed in the information form, which is the same.

Where the paper has a slip or says nothing:

- Its stacked samples have one noise that is common to all (R = [I ... I]), which no sensor has; V is block-diagonal.
- An old sample that is drawn again is counted again, as in the paper.
- f and J are taken at the non-negative mean, since f has no meaning at b < 0; the innovation counts from there, so
  x_pred = f(b) + J (mean - b). Comparing f(b) with what belongs to the mean lets b < 0 run away.
- Noise in x_m is ignored, as in the paper, whose simulated x_m has none.
- Neither the stiffness of bending nor step nor sweeps are stated; see `shots`. Nor is Sigma_0.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float

from jiggle_mj.observation import Declaration

from ..belief.boundary_belief import BoundaryBelief, entropy, standard_deviations
from ..physics.mesh import SheetMesh
from ..physics.simulator import SWEEPS_PER_STEP, simulator
from ..physics.xpbd import XPBD
from .evidence import Evidence, Filter, Update, unavailable
from .shots import ShotHistory, Shots, predicted, slopes

PRIOR_MEAN = 1e-4
"""The paper's mu_0 [N/m]."""


class MultipleShooting(Filter):
    """The filter for one sheet, with the samples so far."""

    def __init__(self, mesh: SheetMesh, declaration: Declaration, *, grip_stiffness: float, samples: int) -> None:
        """Build the simulator.

        Args:
            mesh: the sheet.
            declaration: its membrane stiffness and areal density are used.
            grip_stiffness: of the springs to the tip [N/m].
            samples: k.
        """
        self._simulator = simulator(mesh, declaration)
        self._history = ShotHistory(grip_stiffness=grip_stiffness, samples=samples)

    def forget(self) -> None:
        """After a cut or suture: draw no step from before it."""
        self._history.forget()

    def update(
        self, belief: BoundaryBelief, b: Float[Array, " n"], evidence: Evidence, start: Float[Array, "n 3"]
    ) -> Update:
        """Take one frame and k - 1 earlier ones into the belief; start is not used."""
        belief, factor, nis = update(self._simulator, belief, b, self._history.add(evidence), sweeps=SWEEPS_PER_STEP)
        b = non_negative(belief, b)
        if not (np.isfinite(factor).all() and np.isfinite(nis)):
            self._history.reject()
            b = unavailable(b)
        return Update(
            belief=belief,
            x=evidence.y,
            b=b,
            sd=standard_deviations(factor),
            probability=unavailable(b),
            entropy=entropy(factor),
            nis=nis,
            converged=jnp.asarray(True),
        )


@eqx.filter_jit
def update(
    simulator: XPBD, belief: BoundaryBelief, b: Float[Array, " n"], shots: Shots, *, sweeps: int
) -> tuple[BoundaryBelief, Float[Array, "n n"], Float[Array, ""]]:
    """The belief after all samples at once, its precision's Cholesky factor, and the squared innovation per dof.

    `b` is where f is linearised [N/m].
    """
    ahead = belief.mean() - b

    def one(shot: Shots):
        def f(b):
            return predicted(simulator, shot, b, sweeps=sweeps)

        slope = slopes(f, b)
        weighted = jnp.einsum("ani,nij->anj", slope, shot.precision)
        innovation = shot.end - f(b) - jnp.einsum("ani,a->ni", slope, ahead)
        squared = jnp.einsum("ni,nij,nj->", innovation, shot.precision, innovation)
        return jnp.einsum("ani,bni->ab", weighted, slope), jnp.einsum("ani,ni->a", weighted, innovation), squared

    gained, pulled, squared = (jnp.sum(part, axis=0) for part in jax.lax.map(one, shots))
    after = belief.add(gained, pulled + gained @ (b + ahead))
    factor = jnp.linalg.cholesky(after.precision)
    explained = pulled @ cho_solve((factor, True), pulled)
    observed = 3 * jnp.sum(jnp.trace(shots.precision, axis1=2, axis2=3) > 0)
    return after, factor, (squared - explained) / jnp.maximum(observed, 1).astype(b.dtype)


@eqx.filter_jit
def non_negative(belief: BoundaryBelief, b: Float[Array, " n"]) -> Float[Array, " n"]:
    """The constrained mean, sought from b."""
    return belief.non_negative_mean(b > 0)
