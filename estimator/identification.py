"""The sheet's own parameters from a recording, with the attachments unknown.

In every frame the balance of forces is linearised at the equilibrium that the belief predicts, where only the grip
pulls. There dr/dlog(factor) does not hold the noise of what was seen, which at the observed state would bias the
answer. With r = (1 - s) f + s b_ref d as in `force_balance`, D = dr/ds, G = dr/dlog(factor) and e = r + H (y - x),

    e + D ds + G dlog(factor) + U du ~ N(0, N),

with u the `nuisances`. Frames add up. ds is marginalised with the belief's sites, which stand for the prior of s, then
u, and the remainder is a Gauss-Newton step of the log factors. Then the attachments are estimated again with the
changed sheet, until no factor moves. The standard errors are those of the last step with the noise inflated by what all
frames share (`Noise.shared`); the steps themselves are not, as D, shrunk by a larger noise, would bias them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .filters.evidence import Evidence
from .filters.filter import FilterState, ForceBalanceFilter
from .filters.force_balance import ForceBalance
from .filters.noise import Noise
from .filters.posterior_summary import PosteriorSummary
from .joint_information import JointInformation, Remainder
from .nuisances import dr_dnuisance, prior_sd
from .physics.ratios import chosen, ratios, scaled

MAX_PASSES = 12
"""Most Gauss-Newton steps, each with a refinement of the attachments."""
PRIOR_SD = 2.0
"""Prior standard deviation of a log factor [nat]: without evidence a parameter stays as declared."""
MAX_LOG_STEP = 1.0
"""Longest step of a log factor [nat]."""
LAST_STEP = 0.1
"""Length of the step that ends the search [standard error of the log factor]."""
ATTACHMENTS = "the attachments"
"""What a ratio may be confounded with, other than another ratio and a nuisance parameter."""


@dataclass(frozen=True, kw_only=True)
class Identification:
    """The sheet's parameters, and the filter's state with them."""

    factors: dict[str, float]
    """Factor on each declared ratio that was asked for, by name [1]."""
    log_sd: dict[str, float]
    """Standard error of each log factor [nat]."""
    trades_with: dict[str, tuple[str, float]]
    """What each ratio is confounded with most, and the size of their correlation: another ratio, `ATTACHMENTS` (the
    multiple correlation with all of them together), or a nuisance parameter."""
    state: FilterState
    """The filter's state with the changed sheet."""
    summary: PosteriorSummary
    """Posterior over the attachments with it."""
    converged: bool
    """Whether the last step was short."""


def identify(
    filter: ForceBalanceFilter,
    state: FilterState,
    *,
    faces: Int[np.ndarray, "f 3"],
    height_sd: float,
    parameters: Sequence[str] = (),
    on_pass: Callable[[dict[str, float]], None],
) -> Identification:
    """Find the factors on the sheet's declared ratios after all frames, and the attachments with them.

    Args:
        filter: the filter.
        state: its state, released.
        faces: triangles of the sheet, all of one orientation.
        height_sd: prior standard deviation of the height of what is seen over the middle of the sheet [m].
        parameters: names of the ratios to find; the others stay as declared. All of them if there are none.
        on_pass: called with the factors after each pass, for progress.

    Raises:
        OptionError: the sheet has no ratio of a name.
        ValueError: the state has no frames.
    """
    declared = filter.balance(state).energy
    names = chosen(declared, parameters)
    if next(filter.frames(state), None) is None:
        raise ValueError("no frame with closed jaws since the start, or the last cut or suture; lift the sheet first.")
    columns = jnp.asarray([ratios(declared).index(name) for name in names])
    nuisance_sd, k = prior_sd(declared, height_sd=height_sd), len(names)
    own = np.array(list(nuisance_sd.values()))
    with_prior, without = np.append(np.full(k, PRIOR_SD), own), np.append(np.full(k, np.inf), own)
    log_factors, passes, triangles = np.zeros(k), 0, jnp.asarray(faces)
    belief, b = filter.belief(state), state.summary.b
    while True:
        linearised, before, s = state, belief, belief.bounded(b)
        found = _collected(filter, linearised, s, triangles, columns, Noise()).marginal(belief, s)
        # nuisances are linearised at 0 in every pass, the factors where they are
        at = np.append(log_factors, np.zeros(len(own)))
        step = found.step(with_prior, at)[:k]
        sd = np.sqrt(np.diagonal(found.covariance(without))[:k])
        converged = bool((np.abs(step) < LAST_STEP * sd).all())
        log_factors = log_factors + np.clip(step, -MAX_LOG_STEP, MAX_LOG_STEP)
        on_pass(dict(zip(names, np.exp(log_factors).tolist(), strict=True)))
        state, summary = filter.refit(state, scaled(declared, jnp.asarray(log_factors), names))
        belief, b = filter.belief(state), state.summary.b
        passes += 1
        if converged or passes == MAX_PASSES:
            break
    shared = filter.shared_noise(linearised)
    found = _collected(filter, linearised, s, triangles, columns, shared).marginal(before, s)
    covariance = found.covariance(without)
    log_sd = np.sqrt(np.diagonal(covariance)[:k])
    return Identification(
        factors=dict(zip(names, np.exp(log_factors).tolist(), strict=True)),
        log_sd=dict(zip(names, log_sd.tolist(), strict=True)),
        trades_with=_confounded(names, tuple(nuisance_sd), found, covariance),
        state=state,
        summary=summary,
        converged=converged,
    )


def _collected(
    filter: ForceBalanceFilter,
    state: FilterState,
    s: Float[Array, " n"],
    triangles: Int[Array, "f 3"],
    columns: Int[Array, " k"],
    noise: Noise,
) -> JointInformation:
    """Return the evidence of all frames, with further factors on the variances."""
    balance = filter.balance(state).inflated(noise.force)
    frames = (
        _information(balance, evidence.inflated(noise.position), x, s, triangles, columns)
        for evidence, x in filter.frames(state)
    )
    return reduce(JointInformation.__add__, frames)


def _confounded(
    names: tuple[str, ...], nuisances: tuple[str, ...], found: Remainder, covariance: Float[np.ndarray, "q q"]
) -> dict[str, tuple[str, float]]:
    """Return what each ratio is confounded with most, and the size of the correlation."""
    sd = np.sqrt(np.diagonal(covariance))
    correlation = np.abs(covariance / np.outer(sd, sd))
    others, with_attachments = (*names, *nuisances), found.correlation_with_s()
    most = {}
    for k, name in enumerate(names):
        candidates = {other: correlation[k, j] for j, other in enumerate(others) if j != k}
        candidates[ATTACHMENTS] = with_attachments[k]
        likeliest = max(candidates, key=lambda other: candidates[other])
        most[name] = likeliest, float(candidates[likeliest])
    return most


@eqx.filter_jit
def _information(
    balance: ForceBalance,
    evidence: Evidence,
    x: Float[Array, "n 3"],
    s: Float[Array, " n"],
    triangles: Int[Array, "f 3"],
    columns: Int[Array, " k"],
) -> JointInformation:
    """Return one frame's evidence, linearised at the equilibrium predicted from x.

    The parameters are the logarithms of the ratios with the numbers `columns`, and the nuisances.
    """
    frame = balance.linearise(balance.predict(x, s, evidence), s, evidence)
    fit = balance.fit(frame)
    information = balance.information(frame, fit)

    def residual_force(log_factor: Float[Array, " k"]) -> Float[Array, "n 3"]:
        return (1 - s)[:, None] * scaled(balance.energy, log_factor).internal_gradient(frame.x)

    G = jax.jacfwd(residual_force)(jnp.zeros(len(ratios(balance.energy))))[:, :, columns]
    G = jnp.concatenate([G, dr_dnuisance(balance, frame, triangles)], axis=2)
    whitened = jax.vmap(lambda column: balance.whitened(frame, column), in_axes=2, out_axes=2)(G)
    return JointInformation(
        precision=information.precision,
        cross=jnp.einsum("ni,nik->nk", balance.calibrated(frame, fit), whitened),
        parameter_precision=jnp.einsum("nik,nil->kl", G, whitened),
        score=information.score,
        parameter_score=-jnp.einsum("nik,ni->k", whitened, fit.residual),
    )
