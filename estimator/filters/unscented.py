"""Reduced-order unscented Kalman filter on the springs.

The filter of Moireau & Chapelle (2011, doi:10.1051/cocv/2010006), used as for the stochastic boundary conditions of
Peterlik et al. (2017, doi:10.1007/978-3-319-66185-8_62).

One stiffness theta holds for a patch of neighbouring particles: b = theta of its patch. With r patches, P = C C^T and
the r + 1 points I_j of the unit simplex, each frame sends theta_j = theta + C I_j through the equilibrium x*(b, u):

    slope = 1/(r+1) sum_j (x_j - mean x) (C^-T I_j)^T,
    P^-1 += slope^T R^-1 slope,   theta += P slope^T R^-1 (y - mean x),

the simplex form of the filter written for parameters alone. A negative stiffness is simulated as zero, and the
estimate after a frame is the constrained one.

The summary holds the particles' own means and variances only: its covariance is diagonal. That particles of a patch
share one stiffness is known in `UnscentedState.reduced` alone.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from scipy.cluster.vq import kmeans2

from jiggle_mj.options import FilterName

from ..belief.gaussian_belief import GaussianBelief, non_negative_minimum
from ..physics.energy import SheetEnergy
from ..physics.environment import Grip
from ..physics.equilibrium import equilibrium
from ..physics.mesh import SheetMesh
from .evidence import Evidence
from .filter import FilterState, GaussianFilter
from .posterior_summary import Convergence, Update, are_finite, unavailable

PATCHES = 40
"""r, the largest number of patches; on 10 cm x 10 cm a patch is 16 mm wide."""
MIN_PARTICLES = 4
"""Particles in a patch, on average, at least: a small sheet has fewer patches than `PATCHES`."""
MAX_NEWTON_STEPS = 40
"""Most Newton steps of an equilibrium."""
PATCH_SEED = 0
"""Seed of the k-means that lays the patches: part of the mesh, not of the draws of a filter."""


class UnscentedState(FilterState):
    """The particles' marginals, and the belief over the patches."""

    reduced: GaussianBelief | None
    """Belief over the stiffness of each patch; None before the first frame."""


class ReducedUnscented(GaussianFilter[UnscentedState]):
    """The filter for one sheet."""

    patch: Int[np.ndarray, " n"]
    """Patch of each particle."""
    gripped: SheetEnergy
    """Energy of the sheet with a grip as its last term."""
    grip_stiffness: float
    """Stiffness of the springs to the tip [N/m]."""
    force_tolerance: float
    """Residual force at which an equilibrium is found [N]."""

    @classmethod
    def build(
        cls,
        mesh: SheetMesh,
        energy: SheetEnergy,
        *,
        prior: GaussianBelief,
        prior_sd: float,
        grip_stiffness: float,
        force_tolerance: float,
    ) -> "ReducedUnscented":
        """Lay the patches over a sheet.

        Args:
            mesh: the sheet.
            energy: of the sheet without attachments and grip.
            prior: belief before the first frame; only its marginals are used.
            prior_sd: see `GaussianFilter`.
            grip_stiffness: of the springs to the tip [N/m].
            force_tolerance: residual force at which an equilibrium is found [N].
        """
        grip = Grip.build(jnp.asarray(mesh.rest), jnp.zeros(3), radius=1.0, stiffness=0.0)
        return cls(
            prior=prior,
            prior_sd=prior_sd,
            patch=patches(mesh.rest, min(PATCHES, mesh.n // MIN_PARTICLES)),
            gripped=SheetEnergy.build(mesh.rest, (*energy.terms, grip), energy.layout),
            grip_stiffness=grip_stiffness,
            force_tolerance=force_tolerance,
        )

    @property
    def name(self) -> FilterName:
        """See `Filter.name`."""
        return "unscented"

    def init(self, key: PRNGKeyArray) -> UnscentedState:
        """See `Filter.init`."""
        return UnscentedState(
            summary=self.init_summary(),
            release_convergence=Convergence.CONVERGED.code,
            changes=(),
            key=key,
            reduced=None,
        )

    def update(
        self, state: UnscentedState, evidence: Evidence, start: Float[Array, "n 3"]
    ) -> tuple[UnscentedState, Update]:
        """See `Filter.update`; the belief over particles is used before the first frame only."""
        pull = evidence.pull
        if pull is None:
            raise ValueError("the unscented filter needs Evidence.pull, where the tip is; got None.")
        stiff = jnp.where(evidence.held, self.grip_stiffness, 0.0)
        grip = Grip.of(pull.tip, pull.length, stiff)
        gripped = eqx.tree_at(lambda energy: energy.terms[-1], self.gripped, grip)
        patch, before = jnp.asarray(self.patch), self._reduced(state)
        reduced, x, nis, converged = update(
            gripped, patch, before, evidence, start, force_tolerance=jnp.asarray(self.force_tolerance)
        )
        mean, covariance = reduced.moments()
        theta = non_negative_minimum(reduced.precision, reduced.shift, mean > 0)
        variance = jnp.diagonal(covariance)
        marginals = GaussianBelief(precision=jnp.diag(1 / variance[patch]), shift=(mean / variance)[patch])
        outcome = Update(
            belief=marginals,
            x=x,
            b=theta[patch],
            sd=jnp.sqrt(variance[patch]),
            probability=unavailable(state.summary.b),
            entropy=marginals.entropy(),
            nis=nis,
            convergence=Convergence.SEARCH_CUT_OFF.unless(converged),
        )
        if not are_finite(x, theta):
            return replace(state, reduced=before), outcome
        return replace(state, summary=outcome, reduced=reduced), outcome

    def _reduced(self, state: UnscentedState) -> GaussianBelief:
        """Return the belief over the patches; before the first frame, of the first particle of each."""
        if state.reduced is not None:
            return state.reduced
        belief = state.summary.belief
        assert isinstance(belief, GaussianBelief)
        mean, covariance = belief.moments()
        first = jnp.asarray([np.flatnonzero(self.patch == k)[0] for k in range(int(self.patch.max()) + 1)])
        precision = jnp.diag(1 / jnp.diagonal(covariance)[first])
        return GaussianBelief(precision=precision, shift=precision @ mean[first])


@eqx.filter_jit
def update(
    gripped: SheetEnergy,
    patch: Int[Array, " n"],
    state: GaussianBelief,
    evidence: Evidence,
    start: Float[Array, "n 3"],
    *,
    force_tolerance: Float[Array, ""],
) -> tuple[GaussianBelief, Float[Array, "n 3"], Float[Array, ""], Bool[Array, ""]]:
    """Return the reduced belief after one frame, the mean state [m], the NIS, and whether all equilibria were found.

    The NIS is the squared innovation per degree of freedom.
    """
    mean, covariance = state.moments()
    r = len(mean)
    root, simplex = jnp.linalg.cholesky(covariance), jnp.asarray(simplex_points(r))

    def sheet(theta, x):
        b = jnp.maximum(theta, 0)[patch]
        found = equilibrium(gripped, b, x, force_tolerance=force_tolerance, max_steps=MAX_NEWTON_STEPS)
        return found.x, found.converged

    middle, converged = sheet(mean, start)
    ends, all_converged = jax.lax.map(lambda point: sheet(mean + root @ point, middle), simplex)
    centre = jnp.mean(ends, axis=0)
    slope = jnp.einsum("jni,jr->rni", ends - centre[None], solve_triangular(root, simplex.T, lower=True, trans=1).T)
    slope = slope / (r + 1)
    weighted = jnp.einsum("rni,nij->rnj", slope, evidence.precision)
    residual = jnp.where(evidence.seen[:, None], evidence.y - centre, 0.0)
    precision, score = jnp.einsum("ani,bni->ab", weighted, slope), jnp.einsum("ani,ni->a", weighted, residual)
    after = state.add(precision, score + precision @ mean)
    explained = score @ after.gaussian().solve(score)
    chi2 = jnp.einsum("ni,nij,nj->", residual, evidence.precision, residual)
    observed = 3 * jnp.maximum(jnp.sum(evidence.seen), 1)
    nis = (chi2 - explained) / observed.astype(mean.dtype)
    return after, centre, nis, converged & jnp.all(all_converged)


def patches(rest: Float[np.ndarray, "n 3"], r: int) -> Int[np.ndarray, " n"]:
    """Return the patch of each particle, at most r of them, by Lloyd's k-means of the rest positions [m]."""
    label = kmeans2(rest, r, minit="++", rng=np.random.default_rng(PATCH_SEED))[1]
    return np.unique(label, return_inverse=True)[1]


def simplex_points(r: int) -> Float[np.ndarray, "_points r"]:
    """Return r + 1 points of zero mean and unit covariance, all equally far from 0."""
    centred = np.eye(r + 1) - 1 / (r + 1)
    basis = np.linalg.qr(centred[:, :r])[0]
    return np.sqrt(r + 1) * centred @ basis
