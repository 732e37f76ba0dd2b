"""Reduced-order unscented Kalman filter on the springs.

The filter of Moireau & Chapelle (2011, doi:10.1051/cocv/2010006), used as for the stochastic boundary conditions of
Peterlik et al. (2017, doi:10.1007/978-3-319-66185-8_62).

One stiffness theta a patch of neighbouring particles, b = theta of its patch. With r patches, P = C C^T and the r + 1
unit simplex points I_j, each frame sends theta_j = theta + C I_j through the equilibrium x*(b, u), with

    slope = 1/(r+1) sum_j (x_j - mean x) (C^-T I_j)^T,
    P^-1 += slope^T R^-1 slope,   theta += P slope^T R^-1 (y - mean x),

the simplex form of the filter written for parameters alone. A negative stiffness is simulated as zero, and the
estimate after a frame is the constrained one. What leaves is the particles' own mean and variance; that particles of a
patch are one stays in here, so the belief's covariance is diagonal.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Bool, Float, Int
from scipy.cluster.vq import kmeans2

from ..belief.boundary_belief import BoundaryBelief, entropy, non_negative_minimum
from ..physics.energy import SheetEnergy
from ..physics.environment import Grip
from ..physics.equilibrium import equilibrium
from ..physics.mesh import SheetMesh
from .evidence import Evidence, Filter, Update, unavailable

PATCHES = 40
"""r; on 10 cm x 10 cm a patch is 16 mm wide."""
STEPS = 40
"""Most Newton steps of an equilibrium."""


class ReducedUnscented(Filter):
    """The filter for one sheet, with the reduced state so far."""

    def __init__(self, mesh: SheetMesh, energy: SheetEnergy, *, grip_stiffness: float, force_tolerance: float) -> None:
        """Lay the patches.

        Args:
            mesh: the sheet.
            energy: of the sheet without attachments and grip.
            grip_stiffness: of the springs to the tip [N/m].
            force_tolerance: of an equilibrium [N].
        """
        self._patch = patches(mesh.rest, min(PATCHES, mesh.n // 4))
        self._r = int(self._patch.max()) + 1
        self._grip_stiffness, self._force_tolerance = grip_stiffness, force_tolerance
        grip = Grip.build(jnp.asarray(mesh.rest), jnp.zeros(3), radius=1.0, stiffness=0.0)
        self._gripped = SheetEnergy.build(mesh.rest, (*energy.terms, grip), energy.layout)
        self._state: BoundaryBelief | None = None

    def update(
        self, belief: BoundaryBelief, b: Float[Array, " n"], evidence: Evidence, start: Float[Array, "n 3"]
    ) -> Update:
        """See `Filter.update`; of the belief only the first one's marginals are used."""
        pull = evidence.pull
        if pull is None:
            raise ValueError("the unscented filter needs Evidence.pull, where the tip is; got None.")
        if self._state is None:
            mean, covariance = belief.moments()
            first = jnp.asarray([np.flatnonzero(self._patch == k)[0] for k in range(self._r)])
            precision = jnp.diag(1 / jnp.diagonal(covariance)[first])
            self._state = BoundaryBelief(precision=precision, shift=precision @ mean[first])
        stiff = jnp.where(evidence.held, self._grip_stiffness, 0.0)
        grip = Grip.of(pull.tip, pull.length, stiff)
        gripped = eqx.tree_at(lambda energy: energy.terms[-1], self._gripped, grip)
        patch = jnp.asarray(self._patch)
        state, x, nis, converged = update(
            gripped, patch, self._state, evidence, start, force_tolerance=jnp.asarray(self._force_tolerance)
        )
        mean, covariance = state.moments()
        theta = non_negative_minimum(state.precision, state.shift, mean > 0)
        if np.isfinite(x).all() and np.isfinite(theta).all():
            self._state = state
        variance = jnp.diagonal(covariance)
        marginals = BoundaryBelief(precision=jnp.diag(1 / variance[patch]), shift=(mean / variance)[patch])
        return Update(
            belief=marginals,
            x=x,
            b=theta[patch],
            sd=jnp.sqrt(variance[patch]),
            probability=unavailable(b),
            entropy=entropy(jnp.linalg.cholesky(marginals.precision)),
            nis=nis,
            converged=converged,
        )


@eqx.filter_jit
def update(
    gripped: SheetEnergy,
    patch: Int[Array, " n"],
    state: BoundaryBelief,
    evidence: Evidence,
    start: Float[Array, "n 3"],
    *,
    force_tolerance: Float[Array, ""],
) -> tuple[BoundaryBelief, Float[Array, "n 3"], Float[Array, ""], Bool[Array, ""]]:
    """The reduced belief after one frame, the mean sheet, the squared innovation per dof, and whether all settled."""
    mean, covariance = state.moments()
    r = len(mean)
    root, simplex = jnp.linalg.cholesky(covariance), jnp.asarray(simplex_points(r))

    def sheet(theta, x):
        b = jnp.maximum(theta, 0)[patch]
        found = equilibrium(gripped, b, x, force_tolerance=force_tolerance, max_steps=STEPS)
        return found.x, found.converged

    middle, converged = sheet(mean, start)
    ends, all_converged = jax.lax.map(lambda point: sheet(mean + root @ point, middle), simplex)
    centre = jnp.mean(ends, axis=0)
    slope = jnp.einsum("jni,jr->rni", ends - centre[None], solve_triangular(root, simplex.T, lower=True, trans=1).T)
    slope = slope / (r + 1)
    weighted = jnp.einsum("rni,nij->rnj", slope, evidence.precision)
    residual = jnp.where(evidence.seen[:, None], evidence.y - centre, 0.0)
    gained, pulled = jnp.einsum("ani,bni->ab", weighted, slope), jnp.einsum("ani,ni->a", weighted, residual)
    after = state.add(gained, pulled + gained @ mean)
    explained = pulled @ cho_solve((jnp.linalg.cholesky(after.precision), True), pulled)
    squared = jnp.einsum("ni,nij,nj->", residual, evidence.precision, residual)
    observed = 3 * jnp.maximum(jnp.sum(evidence.seen), 1)
    nis = (squared - explained) / observed.astype(mean.dtype)
    return after, centre, nis, converged & jnp.all(all_converged)


def patches(rest: Float[np.ndarray, "n 3"], r: int) -> Int[np.ndarray, " n"]:
    """The patch of each particle, at most r of them: Lloyd's k-means of the rest positions, from a fixed seed."""
    label = kmeans2(rest, r, minit="++", rng=np.random.default_rng(0))[1]
    return np.unique(label, return_inverse=True)[1]


def simplex_points(r: int) -> Float[np.ndarray, "_points r"]:
    """R + 1 points of zero mean and unit covariance, all equally far from 0."""
    centred = np.eye(r + 1) - 1 / (r + 1)
    basis = np.linalg.qr(centred[:, :r])[0]
    return np.sqrt(r + 1) * centred @ basis
