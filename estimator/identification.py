"""The sheet's own parameters from a recording, with the attachments unknown.

In every frame the balance of forces is linearised at the equilibrium that the belief predicts, where only the grip
pulls: there no slope carries the noise of what was seen, which at the observed state would bend the answer. With
r = (1 - s) f + s b_ref d as in `force_balance`, D = dr/ds, G = dr/dlog(factor) and e = r + H (y - x),

    e + D ds + G dlog(factor) ~ N(0, N),

frames add up, ds is marginalised with what the belief says of s beside the frames (its sites), and the rest is a
Gauss-Newton step. Then the attachments are found anew by the sheet thus changed, until no factor moves.
"""

from collections.abc import Callable
from functools import reduce

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .belief.attachment_belief import AttachmentBelief
from .filters.evidence import Evidence, PosteriorSummary
from .filters.force_balance import ForceBalance
from .filters.implicit import ImplicitFilter
from .physics.ratios import ratios, scaled

PASSES = 12
PRIOR_SD = 2.0
"""Of a log factor: what the frames say nothing of stays as declared."""
FAINT = 1e-9
"""Information that keeps the covariance finite where the frames say nothing."""
STEP = 1.0
"""Longest step of a log factor."""
AT_REST = 0.1
"""A step of less than this share of its standard error is the last."""


def identify(
    filter: ImplicitFilter,
    belief: AttachmentBelief,
    b: Float[Array, " n"],
    *,
    on_pass: Callable[[dict[str, float]], None],
) -> tuple[dict[str, float], dict[str, float], PosteriorSummary, bool]:
    """Find the factors after all frames, and the attachments with them; the filter goes on with both.

    Returns their factors by name, the standard errors of the logarithms, what is stated with them, and whether the
    search came to rest.

    Args:
        filter: whose jaws have just opened.
        belief: stated then.
        b: stated then [N/m].
        on_pass: told of the factors after each pass.
    """
    declared = filter.energy
    names = ratios(declared)
    found, small, passes = np.zeros(len(names)), False, 0
    while True:
        s = belief.bounded(b)
        frames = (_information(*frame, s) for frame in filter.frames())
        step, covariance = reduce(Joint.__add__, frames).step(belief, s, found)
        small = bool((np.abs(step) < AT_REST * np.sqrt(np.diagonal(covariance))).all())
        found = found + np.clip(step, -STEP, STEP)
        on_pass(dict(zip(names, np.exp(found), strict=True)))
        summary = filter.of(belief, scaled(declared, jnp.asarray(found)))
        assert isinstance(summary.belief, AttachmentBelief)
        belief, b = summary.belief, summary.b
        passes += 1
        if small or passes == PASSES:
            break
    return (
        dict(zip(names, np.exp(found).tolist(), strict=True)),
        dict(zip(names, np.sqrt(np.diagonal(covariance)).tolist(), strict=True)),
        summary,
        small,
    )


class Joint(eqx.Module):
    """What frames say of s and of the factors together."""

    precision: Float[Array, "n n"]
    cross: Float[Array, "n k"]
    own: Float[Array, "k k"]
    pulled: Float[Array, " n"]
    own_pulled: Float[Array, " k"]

    def __add__(self, other: "Joint") -> "Joint":
        """What both say."""
        return jax.tree.map(jnp.add, self, other)

    def step(
        self, belief: AttachmentBelief, s: Float[Array, " n"], found: Float[np.ndarray, " k"]
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
        """Step of the log factors from where they are, and the covariance that the frames give them, whatever s is."""
        precision = self.precision + jnp.diag(belief.site_precision)
        pulled = self.pulled + belief.site_shift - belief.site_precision * s
        explained = jnp.linalg.solve(precision, jnp.column_stack([self.cross, pulled]))
        own = np.asarray(self.own - self.cross.T @ explained[:, :-1]) + FAINT * np.eye(len(found))
        pull = np.asarray(self.own_pulled - self.cross.T @ explained[:, -1])
        declared = PRIOR_SD**-2 * np.eye(len(found))
        return np.linalg.solve(own + declared, pull - declared @ found), np.linalg.inv(own)


@eqx.filter_jit
def _information(balance: ForceBalance, evidence: Evidence, x: Float[Array, "n 3"], s: Float[Array, " n"]) -> Joint:
    frame = balance.linearise(balance.predict(x, s, evidence), s, evidence)
    fit = balance.fit(frame)
    seen = balance.information(frame, fit)

    def unbalanced(log_factor: Float[Array, " k"]) -> Float[Array, "n 3"]:
        return (1 - s)[:, None] * scaled(balance.energy, log_factor).internal_gradient(frame.x)

    slope = jax.jacfwd(unbalanced)(jnp.zeros(len(ratios(balance.energy))))
    whitened = jax.vmap(lambda g: balance.whitened(frame, g), in_axes=2, out_axes=2)(slope)
    return Joint(
        precision=seen.precision,
        cross=jnp.einsum("ni,nik->nk", balance.calibrated(frame, fit), whitened),
        own=jnp.einsum("nik,nil->kl", slope, whitened),
        pulled=seen.pulled,
        own_pulled=-jnp.einsum("nik,ni->k", whitened, fit.residual),
    )
