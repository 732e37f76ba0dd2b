"""Non-negative least squares on the springs, the interior-point line of work [Xu et al. 2022, the paper's reference].

At an observed state x the balance of forces is linear in b. Over all frames,

    min over b >= 0 of   sum_t sum_i tau^-2 |grad_i U(x_t) + b_i (x_t,i - a_i)|^2  +  |b - mean_0|^2 / sd_0^2,

without the particles that the grip may pull at. The noise of the positions does not enter: x_t is the equilibrium of
the sheet on springs to what was observed, since the noise of the raw positions would exceed the forces. The last term
decides for particles that never moved; it is the prior that all filters share. The uncertainty is that of the least
squares, for forces that are wrong by tau independently.
"""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jiggle_mj.options import FilterName

from ..belief.gaussian_belief import GaussianBelief
from ..physics.energy import SheetEnergy
from .evidence import Evidence
from .filter import FilterState, GaussianFilter
from .posterior_summary import Convergence, Update, unavailable
from .tethered import Tethered

SMOOTH_FORCE = 1 / 4
"""Residual force at which the smooth state is found [tau]: well below the error that the regression assumes."""


class NonNegativeLeastSquares(GaussianFilter[FilterState]):
    """The regression for one sheet; the belief holds the frames so far."""

    energy: SheetEnergy
    """Energy of the sheet without attachments [J]."""
    tethered: Tethered
    """The same sheet on springs to observed positions."""
    force_sd: Float[Array, ""]
    """tau, the standard deviation of the model's force error [N]."""

    @classmethod
    def build(
        cls, energy: SheetEnergy, *, prior: GaussianBelief, prior_sd: float, force_sd: float
    ) -> "NonNegativeLeastSquares":
        """Prepare the regression for a sheet's energy without attachments.

        Args:
            energy: of the sheet.
            prior: belief before the first frame.
            prior_sd: see `GaussianFilter`.
            force_sd: tau [N].
        """
        return cls(
            prior=prior,
            prior_sd=prior_sd,
            energy=energy,
            tethered=Tethered.build(energy),
            force_sd=jnp.asarray(force_sd, dtype=float),
        )

    @property
    def name(self) -> FilterName:
        """See `Filter.name`."""
        return "nnls"

    def init(self, key: PRNGKeyArray) -> FilterState:
        """See `Filter.init`."""
        return FilterState(
            summary=self.init_summary(), release_convergence=Convergence.CONVERGED.code, changes=(), key=key
        )

    def update(self, state: FilterState, evidence: Evidence, start: Float[Array, "n 3"]) -> tuple[FilterState, Update]:
        """See `Filter.update`; the search for the smooth state begins at `start`, with springs b."""
        belief = state.summary.belief
        assert isinstance(belief, GaussianBelief)
        outcome = _updated(self.energy, self.tethered, self.force_sd, belief, state.summary.b, evidence, start)
        return (replace(state, summary=outcome) if outcome.explains_the_frame else state), outcome


@eqx.filter_jit
def _updated(
    energy: SheetEnergy,
    tethered: Tethered,
    force_sd: Float[Array, ""],
    belief: GaussianBelief,
    b: Float[Array, " n"],
    evidence: Evidence,
    start: Float[Array, "n 3"],
) -> Update:
    """Return the belief after one frame, and the smooth state."""
    smooth = tethered.settle(b, evidence, start, force_sd=force_sd, force_tolerance=force_sd * SMOOTH_FORCE)
    x = smooth.x
    weight = jnp.where(evidence.force_unknown, 0.0, force_sd**-2)
    d, force = x - energy.rest, energy.gradient(x, jnp.zeros_like(b))
    precision, shift = weight * jnp.sum(d**2, axis=1), -weight * jnp.sum(d * force, axis=1)
    mean = belief.mean()
    chi2 = weight * jnp.sum((force + mean[:, None] * d) ** 2, axis=1)
    after = belief.add(jnp.diag(precision), shift)
    gaussian = after.gaussian()
    score = shift - precision * mean
    explained = jnp.sum(score**2 / jnp.diagonal(after.precision))
    degrees = 3 * jnp.maximum(jnp.sum(weight > 0), 1).astype(b.dtype)
    return Update(
        belief=after,
        x=x,
        b=after.non_negative_mean(b > 0),
        sd=gaussian.sd,
        probability=unavailable(b),
        entropy=gaussian.entropy(),
        nis=(jnp.sum(chi2) - explained) / degrees,
        convergence=Convergence.SEARCH_CUT_OFF.unless(smooth.converged),
    )
