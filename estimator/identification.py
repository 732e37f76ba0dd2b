"""The sheet's own parameters from a recording, with the attachments unknown.

In every frame the balance of forces is linearised at the equilibrium that the belief predicts, where only the grip
pulls. There dr/dlog(factor) does not hold the noise of what was seen, which at the observed state would bias the
answer. With r = (1 - s) f + s b_ref d as in `force_balance`, D = dr/ds, G = dr/dlog(factor) and e = r + H (y - x),

    e + D ds + G dlog(factor) ~ N(0, N).

Frames add up. ds is marginalised with the belief's sites, which stand for the prior of s, and the remainder is a
Gauss-Newton step of the log factors. Then the attachments are estimated again with the changed sheet, until no factor
moves.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .belief.attachment_belief import AttachmentBelief
from .filters.evidence import Evidence
from .filters.filter import FilterState, ForceBalanceFilter
from .filters.force_balance import ForceBalance
from .filters.posterior_summary import PosteriorSummary
from .physics.ratios import ratios, scaled

MAX_PASSES = 12
"""Most Gauss-Newton steps, each with a refinement of the attachments."""
PRIOR_SD = 2.0
"""Prior standard deviation of a log factor [nat]: without evidence a parameter stays as declared."""
MIN_FACTOR_PRECISION = 1e-9
"""Precision that keeps the covariance finite where the frames hold no evidence [1/nat^2]."""
MAX_LOG_STEP = 1.0
"""Longest step of a log factor [nat]."""
LAST_STEP = 0.1
"""Length of the step that ends the search [standard error of the log factor]."""


@dataclass(frozen=True, kw_only=True)
class Identification:
    """The sheet's parameters, and the filter's state with them."""

    factors: dict[str, float]
    """Factor on each declared ratio, by name [1]."""
    log_sd: dict[str, float]
    """Standard error of each log factor [nat]."""
    state: FilterState
    """The filter's state with the changed sheet."""
    summary: PosteriorSummary
    """Posterior over the attachments with it."""
    converged: bool
    """Whether the last step was short."""


def identify(
    filter: ForceBalanceFilter, state: FilterState, *, on_pass: Callable[[dict[str, float]], None]
) -> Identification:
    """Find the factors on the sheet's declared ratios after all frames, and the attachments with them.

    Args:
        filter: the filter.
        state: its state, released.
        on_pass: called with the factors after each pass, for progress.
    """
    declared = filter.balance(state).energy
    names = ratios(declared)
    log_factors, passes = np.zeros(len(names)), 0
    belief, b = filter.belief(state), state.summary.b
    while True:
        s, balance = belief.bounded(b), filter.balance(state)
        frames = (_information(balance, evidence, x, s) for evidence, x in filter.frames(state))
        step, covariance = reduce(JointInformation.__add__, frames).step(belief, s, log_factors)
        converged = bool((np.abs(step) < LAST_STEP * np.sqrt(np.diagonal(covariance))).all())
        log_factors = log_factors + np.clip(step, -MAX_LOG_STEP, MAX_LOG_STEP)
        on_pass(dict(zip(names, np.exp(log_factors), strict=True)))
        state, summary = filter.refit(state, scaled(declared, jnp.asarray(log_factors)))
        belief, b = filter.belief(state), state.summary.b
        passes += 1
        if converged or passes == MAX_PASSES:
            break
    return Identification(
        factors=dict(zip(names, np.exp(log_factors).tolist(), strict=True)),
        log_sd=dict(zip(names, np.sqrt(np.diagonal(covariance)).tolist(), strict=True)),
        state=state,
        summary=summary,
        converged=converged,
    )


class JointInformation(eqx.Module):
    """Evidence of frames about s and the log factors together, in information form."""

    precision: Float[Array, "n n"]
    """Precision of s."""
    cross: Float[Array, "n k"]
    """Precision between s and the log factors."""
    factor_precision: Float[Array, "k k"]
    """Precision of the log factors."""
    score: Float[Array, " n"]
    """Gradient of the log likelihood by s."""
    factor_score: Float[Array, " k"]
    """Gradient of the log likelihood by the log factors."""

    def __add__(self, other: "JointInformation") -> "JointInformation":
        """Return the evidence of both together."""
        return jax.tree.map(jnp.add, self, other)

    def step(
        self, belief: AttachmentBelief, s: Float[Array, " n"], log_factors: Float[np.ndarray, " k"]
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
        """Return a Gauss-Newton step of the log factors, and the covariance by the frames alone, s marginalised.

        Args:
            belief: its sites are the prior of s.
            s: where the frames were linearised.
            log_factors: where they were linearised [nat].
        """
        precision = self.precision + jnp.diag(belief.site_precision)
        score = self.score + belief.site_shift - belief.site_precision * s
        explained = jnp.linalg.solve(precision, jnp.column_stack([self.cross, score]))
        own = np.asarray(self.factor_precision - self.cross.T @ explained[:, :-1])
        own = own + MIN_FACTOR_PRECISION * np.eye(len(log_factors))
        own_score = np.asarray(self.factor_score - self.cross.T @ explained[:, -1])
        prior = PRIOR_SD**-2 * np.eye(len(log_factors))
        return np.linalg.solve(own + prior, own_score - prior @ log_factors), np.linalg.inv(own)


@eqx.filter_jit
def _information(
    balance: ForceBalance, evidence: Evidence, x: Float[Array, "n 3"], s: Float[Array, " n"]
) -> JointInformation:
    """Return one frame's evidence, linearised at the equilibrium predicted from x."""
    frame = balance.linearise(balance.predict(x, s, evidence), s, evidence)
    fit = balance.fit(frame)
    information = balance.information(frame, fit)

    def residual_force(log_factor: Float[Array, " k"]) -> Float[Array, "n 3"]:
        return (1 - s)[:, None] * scaled(balance.energy, log_factor).internal_gradient(frame.x)

    G = jax.jacfwd(residual_force)(jnp.zeros(len(ratios(balance.energy))))
    whitened = jax.vmap(lambda column: balance.whitened(frame, column), in_axes=2, out_axes=2)(G)
    return JointInformation(
        precision=information.precision,
        cross=jnp.einsum("ni,nik->nk", balance.calibrated(frame, fit), whitened),
        factor_precision=jnp.einsum("nik,nil->kl", G, whitened),
        score=information.score,
        factor_score=-jnp.einsum("nik,ni->k", whitened, fit.residual),
    )
