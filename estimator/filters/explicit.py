"""The paper's extended Kalman filter: positions observed through the simulator f, with multiple shooting.

    x_m+1 = f(x_m, u_m, b) + noise,  noise ~ N(0, V)

for k samples m, the latest and others since the last cut or suture, with J = df/db through the sweeps:

    S = J Sigma J^T + blkdiag(V),  K = Sigma J^T S^-1,  mean += K (x_ref - x_pred),  Sigma = (I - K J) Sigma

It is computed in information form, which is equivalent.

Differences from the paper, and choices where it gives nothing:

- The paper's stacked samples share one common noise (R = [I ... I]), which no sensor has. Here V is block-diagonal.
- As in the paper, an old sample that is drawn again counts again.
- f and J are taken at the non-negative mean, since f has no meaning at b < 0. The innovation counts from there:
  x_pred = f(b) + J (mean - b). To compare f(b) with what belongs to the mean would let b < 0 diverge.
- As in the paper, whose simulated x_m has no noise, noise in x_m is ignored.
- The paper gives neither bending stiffness nor time step nor sweeps (see `physics.simulator`), nor Sigma_0.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jiggle_mj.options import FilterName

from ..belief.gaussian_belief import GaussianBelief
from ..belief.gaussian_information import Gaussian
from ..physics.simulator import SWEEPS_PER_STEP
from ..physics.xpbd import XPBD
from .evidence import Evidence
from .filter import FilterState, GaussianFilter
from .posterior_summary import Convergence, Update, are_finite, unavailable
from .shots import ShotHistory, Shots, predicted, slopes

PRIOR_MEAN = 1e-4
"""The paper's mu_0 [N/m]."""


class ShootingState(FilterState):
    """The belief, and the samples of the trajectory since the last cut or suture."""

    history: ShotHistory
    """Samples that an update may draw."""


class MultipleShooting(GaussianFilter[ShootingState]):
    """The paper's filter for one sheet."""

    simulator: XPBD
    """f; see `physics.simulator`."""
    grip_stiffness: float
    """Stiffness of the springs to the tip [N/m]."""
    samples: int
    """k, the samples of each update."""

    @property
    def name(self) -> FilterName:
        """See `Filter.name`."""
        return "explicit"

    def init(self, key: PRNGKeyArray) -> ShootingState:
        """See `Filter.init`."""
        return ShootingState(
            summary=self.init_summary(),
            release_convergence=Convergence.CONVERGED.code,
            changes=(),
            key=key,
            history=ShotHistory.empty(key),
        )

    def forget(self, state: ShootingState) -> ShootingState:
        """Return the state after a cut or suture: no step from before is drawn."""
        return replace(state, history=state.history.forgotten())

    def update(
        self, state: ShootingState, evidence: Evidence, start: Float[Array, "n 3"]
    ) -> tuple[ShootingState, Update]:
        """See `Filter.update`; one frame and k - 1 earlier ones enter the belief, and start is not used."""
        before = state.summary.belief
        assert isinstance(before, GaussianBelief)
        history, shots = state.history.with_step(evidence, grip_stiffness=self.grip_stiffness).draw(self.samples)
        belief, gaussian, nis = update(self.simulator, before, state.summary.b, shots, sweeps=SWEEPS_PER_STEP)
        b = non_negative(belief, state.summary.b)
        usable = are_finite(gaussian.factor, nis)
        if not usable:
            b = unavailable(b)
        outcome = Update(
            belief=belief,
            x=evidence.y,
            b=b,
            sd=gaussian.sd,
            probability=unavailable(b),
            entropy=gaussian.entropy(),
            nis=nis,
            convergence=Convergence.CONVERGED.code,
        )
        if not (usable and outcome.explains_the_frame):
            return replace(state, history=history.without_latest()), outcome
        return replace(state, summary=outcome, history=history), outcome


@eqx.filter_jit
def update(
    simulator: XPBD, belief: GaussianBelief, b: Float[Array, " n"], shots: Shots, *, sweeps: int
) -> tuple[GaussianBelief, Gaussian, Float[Array, ""]]:
    """Return the belief after all samples together, the same with its precision factorised, and the NIS.

    The NIS is the squared innovation per degree of freedom.

    Args:
        simulator: f.
        belief: before the frame.
        b: where f is linearised [N/m].
        shots: the samples.
        sweeps: Gauss-Seidel sweeps of f.
    """
    beyond = belief.mean() - b

    def evidence_of(shot: Shots):
        def f(b):
            return predicted(simulator, shot, b, sweeps=sweeps)

        J = slopes(f, b)
        weighted = jnp.einsum("ani,nij->anj", J, shot.precision)
        innovation = shot.end - f(b) - jnp.einsum("ani,a->ni", J, beyond)
        chi2 = jnp.einsum("ni,nij,nj->", innovation, shot.precision, innovation)
        return jnp.einsum("ani,bni->ab", weighted, J), jnp.einsum("ani,ni->a", weighted, innovation), chi2

    precision, score, chi2 = (jnp.sum(part, axis=0) for part in jax.lax.map(evidence_of, shots))
    after = belief.add(precision, score + precision @ (b + beyond))
    gaussian = after.gaussian()
    explained = score @ gaussian.solve(score)
    observed = 3 * jnp.sum(jnp.trace(shots.precision, axis1=2, axis2=3) > 0)
    return after, gaussian, (chi2 - explained) / jnp.maximum(observed, 1).astype(b.dtype)


@eqx.filter_jit
def non_negative(belief: GaussianBelief, b: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the mean under b >= 0 [N/m], searched from b."""
    return belief.non_negative_mean(b > 0)
