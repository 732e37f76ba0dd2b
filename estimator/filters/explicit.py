"""The paper's extended Kalman filter: positions observed through the simulator f, with multiple shooting.

    x_m+1 = f(x_m, u_m, b) + noise,  noise ~ N(0, V)

for k samples m, the latest and others since the last cut or suture, with J = df/db through the sweeps:

    S = J Sigma J^T + blkdiag(V),  K = Sigma J^T S^-1,  mean += K (x_ref - x_pred),  Sigma = (I - K J) Sigma

Computed in the information form, which is the same.

Where the paper has a slip: its stacked samples have one noise that is common to all (R = [I ... I]), which no sensor
has; here V is block-diagonal. An old sample that is drawn again is counted again, as in the paper. A mean below zero is
simulated as zero and stays as it is. The paper states neither the stiffness of bending nor step nor sweeps; see below.
No weight and no bed, as in the paper.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float, Int
from jiggle_mj.estimator.belief import BoundaryBelief, entropy, standard_deviations
from jiggle_mj.estimator.environment import Grip
from jiggle_mj.estimator.filters.evidence import Evidence, Update
from jiggle_mj.estimator.membrane import EdgeMembrane
from jiggle_mj.estimator.mesh import SheetMesh
from jiggle_mj.estimator.xpbd import XPBD, hinge_springs

from jiggle_mj.observation import Declaration

HINGE = 1 / 30
"""Stiffness of the springs across hinges [membrane stiffness]."""
TIME_STEP, SWEEPS = 0.02, 20
"""Of f [s], and Gauss-Seidel sweeps."""
PRIOR_MEAN = 1e-4
"""The paper's mu_0 [N/m]."""
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
    precision: Float[Array, "k n 3 3"]
    """Inverse covariance of `end`, zero where nothing was observed [1/m^2]."""


class MultipleShooting:
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
        self._grip_stiffness, self._samples = grip_stiffness, samples
        self._rng = np.random.default_rng(0)
        self._history: list[Shots] = []

    def update(
        self, belief: BoundaryBelief, b: Float[Array, " n"], evidence: Evidence, start: Float[Array, "n 3"]
    ) -> Update:
        """Take one frame and k - 1 earlier ones into the belief; b and start are not used."""
        pull = evidence.pull
        if pull is None:
            raise ValueError("MultipleShooting needs Evidence.pull, the step that led to the frame; got None.")
        stiffness = jnp.where(evidence.held, self._grip_stiffness, 0.0)
        parts = (pull.before, pull.tip, pull.length, stiffness, evidence.y, evidence.precision)
        self._history.append(Shots(*(part[None] for part in parts)))
        chosen = [self._history[m] for m in draw_samples(len(self._history) - 1, 0, self._samples, self._rng)]
        empty = eqx.tree_at(lambda shot: shot.precision, self._history[-1], replace_fn=jnp.zeros_like)
        chosen += [empty] * (self._samples - len(chosen))
        shots = jax.tree.map(lambda *parts: jnp.concatenate(parts), *chosen)
        belief, factor, nis = update(self._simulator, belief, shots, sweeps=SWEEPS)
        return Update(
            belief=belief,
            x=evidence.y,
            b=jnp.maximum(cho_solve((factor, True), belief.shift), 0),
            sd=standard_deviations(factor),
            entropy=entropy(factor),
            nis=nis,
        )


def simulator(mesh: SheetMesh, declaration: Declaration) -> XPBD:
    """The paper's f for a sheet: springs on edges and across hinges."""
    k = declaration.membrane_stiffness
    springs = EdgeMembrane.build(mesh, stiffness=k), hinge_springs(mesh, stiffness=HINGE * k)
    return XPBD.build(mesh, springs, areal_density=declaration.areal_density, time_step=TIME_STEP)


@eqx.filter_jit
def update(
    simulator: XPBD, belief: BoundaryBelief, shots: Shots, *, sweeps: int
) -> tuple[BoundaryBelief, Float[Array, "n n"], Float[Array, ""]]:
    """The belief after all samples at once, its precision's Cholesky factor, and the squared innovation per dof."""
    mean = belief.mean()
    b = jnp.maximum(mean, 0)
    columns = jnp.eye(len(b), dtype=b.dtype)

    def one(shot: Shots):
        grip = Grip(vertices=np.arange(len(b))[:, None], tip=shot.tip, length=shot.length, stiffness=shot.stiffness)

        def f(b):
            return simulator.step(shot.start, b, grip, sweeps=sweeps)

        slope = jax.lax.map(lambda d: jax.jvp(f, (b,), (d,))[1], columns, batch_size=AT_ONCE)
        weighted = jnp.einsum("ani,nij->anj", slope, shot.precision)
        residual = shot.end - f(b)
        squared = jnp.einsum("ni,nij,nj->", residual, shot.precision, residual)
        return jnp.einsum("ani,bni->ab", weighted, slope), jnp.einsum("ani,ni->a", weighted, residual), squared

    gained, pulled, squared = (jnp.sum(part, axis=0) for part in jax.lax.map(one, shots))
    after = belief.add(gained, pulled + gained @ mean)
    factor = jnp.linalg.cholesky(after.precision)
    explained = pulled @ cho_solve((factor, True), pulled)
    observed = 3 * jnp.sum(jnp.trace(shots.precision, axis1=2, axis2=3) > 0)
    return after, factor, (squared - explained) / jnp.maximum(observed, 1).astype(b.dtype)


def draw_samples(latest: int, since: int, k: int, rng: np.random.Generator) -> Int[np.ndarray, " _k"]:
    """The latest time step and k - 1 others, uniformly from `since` to the one before it, as far as there are any."""
    earlier = np.arange(since, latest)
    return np.append(rng.choice(earlier, size=min(k - 1, len(earlier)), replace=False), latest)
