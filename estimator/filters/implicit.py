"""Our filter: each frame's balance of forces is evidence about the bounded stiffness s of every attachment.

A frame is linearised at the belief of its time, and its evidence is added to the belief (`force_balance`,
`attachment_belief`). A stiff attachment shows only once its surroundings are believed stiff. So when the jaws open,
each grasp that was linearised far from the present belief is linearised again, and its new evidence replaces the old.
Nothing is counted twice.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jiggle_mj.actions import Cut, Suture
from jiggle_mj.options import FilterName

from ..belief.attachment_belief import AttachmentBelief
from ..belief.gaussian_information import Gaussian
from ..belief.topology import Change, after
from ..physics.energy import SheetEnergy
from .config import FilterConfig, SamplingConfig
from .evidence import Evidence
from .filter import FilterState, ForceBalanceFilter, Region
from .force_balance import ForceBalance
from .force_evidence import LogFactor
from .force_fit import ForceFit
from .frame import FrameInformation
from .grasp import GraspFrames
from .noise import ForceResiduals, Noise
from .posterior_summary import Convergence, PosteriorSummary, Update, prior_summary


class ImplicitState(FilterState):
    """The belief, and the frames that it may linearise again."""

    balance: ForceBalance
    """The balance of forces with the assumed noise, and with the sheet's parameters as identified so far."""
    noise: Noise
    """Factors on the assumed variances, as learned so far."""
    grasps: tuple[GraspFrames, ...]
    """The grasps since the last cut or suture."""
    earlier_precision: Float[Array, "n n"]
    """Precision of s by the frames before the last cut or suture, which are not linearised again."""
    earlier_shift: Float[Array, " n"]
    """Their information vector."""
    between_grasps: bool
    """Whether the jaws have opened since the last frame."""
    thorough_due: bool
    """Whether the last release was not thorough."""
    force: ForceFit | None
    """The tool's force since the last cut or suture that has one; None before a release with one."""

    @property
    def belief(self) -> AttachmentBelief:
        """The latest belief over the attachments."""
        belief = self.summary.belief
        assert isinstance(belief, AttachmentBelief)
        return belief

    @property
    def evidence(self) -> tuple[Float[Array, "n n"], Float[Array, " n"]] | None:
        """Precision and information vector of s by the frames since the last cut or suture; None if there are none."""
        if not self.grasps:
            return None
        precision, shift = self.grasps[0].precision, self.grasps[0].shift
        for grasp in self.grasps[1:]:
            precision, shift = precision + grasp.precision, shift + grasp.shift
        return precision, shift

    @property
    def uses_force(self) -> bool:
        """Whether the tool's force is part of the belief."""
        return self.force is not None and self.force.evidence is not None

    @property
    def residuals(self) -> list[ForceResiduals]:
        """Residuals of the grasps that were linearised again."""
        return [grasp.residuals for grasp in self.grasps if grasp.residuals is not None]

    @property
    def learned_noise(self) -> Noise:
        """The noise that the residuals of the grasps ask for; the same object where that is the present one."""
        return self.noise.learned(self.residuals) if self.residuals else self.noise


class ImplicitFilter(ForceBalanceFilter[ImplicitState]):
    """The filter for one sheet."""

    declared_balance: ForceBalance
    """The balance of forces with the assumed noise and the declared parameters."""
    prior: AttachmentBelief
    """Belief before the first frame."""
    sampling: SamplingConfig = eqx.field(static=True, default=SamplingConfig())
    """Numbers of samples."""
    learns_noise: bool = eqx.field(static=True, default=True)
    """Whether residuals may inflate the assumed noise; False keeps it as it is."""

    @property
    def name(self) -> FilterName:
        """See `Filter.name`."""
        return "implicit"

    @property
    def config(self) -> FilterConfig:
        """Numbers of the linearisation."""
        return self.declared_balance.config

    def init(self, key: PRNGKeyArray) -> ImplicitState:
        """See `Filter.init`."""
        n = len(self.prior.shift)
        return ImplicitState(
            summary=prior_summary(self.prior, n),
            release_convergence=Convergence.CONVERGED.code,
            changes=(),
            key=key,
            balance=self.declared_balance,
            noise=Noise(),
            grasps=(),
            earlier_precision=jnp.zeros((n, n)),
            earlier_shift=jnp.zeros(n),
            between_grasps=True,
            thorough_due=False,
            force=None,
        )

    def update(
        self, state: ImplicitState, evidence: Evidence, start: Float[Array, "n 3"]
    ) -> tuple[ImplicitState, Update]:
        """See `Filter.update`: settle the sheet near what was seen, linearise there, add the evidence, sweep once."""
        noise = jnp.asarray(state.noise.force), jnp.asarray(state.noise.position)
        update, information = _updated(state.balance, state.belief, state.summary.b, evidence, start, noise)
        if not update.explains_the_frame:
            return state, update
        *before, last = (*state.grasps, GraspFrames.empty(len(start))) if state.between_grasps else state.grasps
        grasps = (*before, last.with_frame(evidence, update.x, information))
        return replace(state, summary=update, grasps=grasps, between_grasps=False), update

    def resample(self, state: ImplicitState) -> ImplicitState:
        """See `Filter.resample`: few samples find most of what propagation misses within a grasp."""
        return replace(state, summary=self._quick(state, state.belief))

    def release(self, state: ImplicitState, *, thorough: bool = True) -> tuple[ImplicitState, PosteriorSummary | None]:
        """See `Filter.release`: linearise each grasp again that needs it; the next frame begins another grasp.

        A release that is not thorough draws few samples and does not learn the noise.
        """
        if state.between_grasps and not (thorough and state.thorough_due):
            return state, None
        state = replace(state, between_grasps=True, thorough_due=not thorough)
        if thorough:
            return self._refined(state)
        summary = self._quick(state, state.belief)
        found = self._relinearised(state, summary, self.config.relinearise_beyond, 1, forced=state.uses_force)
        return _with_release(*self._forced(*found))

    def change(self, state: ImplicitState, event: Cut | Suture, *, region: Region, index: int) -> ImplicitState:
        """See `Filter.change`; the next frame begins another grasp, and no frame from before is linearised again."""
        changes = tuple(replace(change, evidence=state.evidence) for change in state.changes[-1:])
        changes = (*state.changes[:-1], *changes)
        belief = after(state.belief, event, region)
        return replace(
            state,
            summary=_swept(belief, self.config.change_sweeps),
            changes=(*changes, Change(event=event, index=index, region=region, before=state.belief)),
            grasps=(),
            earlier_precision=belief.precision,
            earlier_shift=belief.shift,
            between_grasps=True,
            force=None if state.force is None else state.force.changed(state.belief),
        )

    def log_bayes_factor(self, state: ImplicitState, change: Change) -> float | None:
        """See `ForceBalanceFilter.log_bayes_factor`."""
        is_latest = bool(state.changes) and change.before is state.changes[-1].before
        stored = next((stored for stored in state.changes if stored.before is change.before), change)
        evidence = state.evidence if is_latest else stored.evidence
        return None if evidence is None else change.log_bayes_factor(*evidence)

    def noise(self, state: ImplicitState) -> Noise:
        """See `Filter.noise`."""
        return state.noise

    def force(self, state: ImplicitState) -> ForceFit | None:
        """See `Filter.force`."""
        return state.force

    def balance(self, state: ImplicitState) -> ForceBalance:
        """See `ForceBalanceFilter.balance`."""
        return state.balance.inflated(state.noise.force)

    def belief(self, state: ImplicitState) -> AttachmentBelief:
        """See `ForceBalanceFilter.belief`."""
        return state.belief

    def shared_noise(self, state: ImplicitState) -> Noise:
        """See `ForceBalanceFilter.shared_noise`."""
        return Noise.shared(state.residuals) if state.residuals and self.learns_noise else Noise()

    def frames(self, state: ImplicitState) -> Iterator[tuple[Evidence, Float[Array, "n 3"]]]:
        """See `ForceBalanceFilter.frames`."""
        for grasp in state.grasps:
            for frame in grasp.frames:
                yield frame.evidence.inflated(state.noise.position), frame.x

    def refit(self, state: ImplicitState, energy: SheetEnergy) -> tuple[ImplicitState, PosteriorSummary]:
        """See `ForceBalanceFilter.refit`."""
        grasps = tuple(replace(grasp, noise=None) for grasp in state.grasps)
        return self._refined(replace(state, balance=state.balance.with_energy(energy), noise=Noise(), grasps=grasps))

    def linearised(self, state: ImplicitState, b: Float[Array, " n"]) -> ImplicitState:
        """Return the state with all grasps linearised at stiffnesses b [N/m], and the belief by a few samples."""
        at, beyond = replace(state.summary, b=b), self.config.relinearise_beyond
        state, summary = self._relinearised(state, at, beyond, 1, forced=False)
        return replace(state, summary=summary)

    def _refined(self, state: ImplicitState) -> tuple[ImplicitState, PosteriorSummary]:
        """Linearise stale grasps again, learn the noise from their residuals, repeat; then draw many samples."""
        config, forced = self.config, state.uses_force
        summary = self._quick(state, state.belief)
        again = partial(self._relinearised, forced=forced)
        state, summary = again(state, summary, config.relinearise_beyond, config.max_passes)
        for _ in range(config.max_passes):
            if not self.learns_noise or state.learned_noise is state.noise:
                break
            state, summary = again(state, summary, config.relinearise_for_noise_beyond, 1)
            state = replace(state, noise=state.learned_noise)
            state, summary = again(state, summary, config.relinearise_beyond, config.max_passes)
        state, summary = self._forced(state, summary)
        belief = summary.belief
        assert isinstance(belief, AttachmentBelief)
        return _with_release(state, sampled(belief, state.key, self.sampling.thorough, self.sampling))

    def _forced(self, state: ImplicitState, summary: PosteriorSummary) -> tuple[ImplicitState, PosteriorSummary]:
        """Add the tool's force where it is new, once the shape is explained as well as it can be without it.

        Before, a force of another sign or frame would not stand out, and the noise that is learned would cover it up.
        """
        if state.uses_force or not any(grasp.forces for grasp in state.grasps):
            return state, summary
        state, belief = self._with_force(state, self._total(state, summary))
        if not state.uses_force:
            return state, summary
        summary, config = self._quick(state, belief), self.config
        return self._relinearised(state, summary, config.relinearise_beyond, config.max_passes, forced=True)

    def _relinearised(
        self, state: ImplicitState, summary: PosteriorSummary, beyond: float, passes: int, *, forced: bool
    ) -> tuple[ImplicitState, PosteriorSummary]:
        """Linearise stale grasps again, and draw a few samples after each pass.

        A grasp is stale if some s has moved by more than `beyond`, or the noise has changed, since its linearisation.
        There are at most `passes` passes. Where `forced`, the tool's force is part of the evidence.
        """
        for _ in range(passes):
            belief = summary.belief
            assert isinstance(belief, AttachmentBelief)
            s = belief.bounded(summary.b)
            stale = [grasp.noise != state.noise or grasp.distance(s) > beyond for grasp in state.grasps]
            if not any(stale):
                break
            grasps = tuple(
                grasp.relinearised(state.balance, s, state.noise) if is_stale else grasp
                for grasp, is_stale in zip(state.grasps, stale, strict=True)
            )
            state = replace(state, grasps=grasps)
            belief = self._total(state, summary)
            if forced:
                state, belief = self._with_force(state, belief)
            summary = self._quick(state, belief)
        return state, summary

    def _total(self, state: ImplicitState, summary: PosteriorSummary) -> AttachmentBelief:
        """Return the belief with the evidence of all frames, the tool's force left out."""
        belief, evidence = summary.belief, state.evidence
        assert isinstance(belief, AttachmentBelief) and evidence is not None
        total = state.earlier_precision + evidence[0], state.earlier_shift + evidence[1]
        return eqx.tree_at(lambda belief: (belief.precision, belief.shift), belief, total)

    def _with_force(self, state: ImplicitState, belief: AttachmentBelief) -> tuple[ImplicitState, AttachmentBelief]:
        """Add the evidence of the tool's force, if it can be that of the sheet, to a belief by all else."""
        frames = [frame for grasp in state.grasps for frame in grasp.forces]
        if not frames:
            return state, belief
        before = LogFactor(sd=self.config.declared_stiffness_sd) if state.force is None else state.force.before
        fit = ForceFit.of(frames, belief, before=before)
        if fit.evidence is not None:
            marginal = fit.evidence.marginal
            belief = belief.add(jnp.asarray(marginal.precision), jnp.asarray(marginal.shift))
        return replace(state, force=fit), belief

    def _quick(self, state: ImplicitState, belief: AttachmentBelief) -> PosteriorSummary:
        """Return the posterior by a few samples."""
        return sampled(belief, state.key, self.sampling.quick, self.sampling)


def sampled(
    belief: AttachmentBelief, key: PRNGKeyArray, sweeps: tuple[int, int], config: SamplingConfig
) -> PosteriorSummary:
    """Return the posterior by samples.

    Drawn on a CPU where JAX has one: samples follow one another, and a GPU takes ten times as long.

    Args:
        belief: what to draw from.
        key: of the draws.
        sweeps: sweeps of each chain, and how often they may be doubled.
        config: how many are drawn first and not averaged.
    """
    first, doublings = sweeps
    with jax.default_device(_cpus()[0]):
        after_samples, agree = belief.sampled(
            key, burn_in=config.burn_in, first_burn_in=config.first_burn_in, sweeps=first, doublings=doublings
        )
        return _summarised(after_samples, Convergence.SAMPLES_DISAGREE.unless(jnp.asarray(agree)))


def quick_summary(belief: AttachmentBelief, *, seed: int = 0, config: SamplingConfig | None = None) -> PosteriorSummary:
    """Return the posterior by a few samples."""
    config = config or SamplingConfig()
    return sampled(belief, jax.random.key(seed), config.quick, config)


@eqx.filter_jit
def likeliest(belief: AttachmentBelief, *, seed: int = 0) -> Float[Array, " n"]:
    """Return the s of the attachments that are likeliest together."""
    return belief.mode(jax.random.key(seed))


def _with_release(state: ImplicitState, summary: PosteriorSummary) -> tuple[ImplicitState, PosteriorSummary]:
    """Take a posterior into the state if it is finite."""
    if summary.is_finite:
        state = replace(state, summary=summary, release_convergence=summary.convergence)
    return state, summary


@eqx.filter_jit
def _updated(
    balance: ForceBalance,
    belief: AttachmentBelief,
    b: Float[Array, " n"],
    evidence: Evidence,
    start: Float[Array, "n 3"],
    noise: tuple[Float[Array, ""], Float[Array, ""]],
) -> tuple[Update, FrameInformation]:
    """Return the belief after a frame, with the state for it, and the frame's evidence, as one program.

    `balance` and `evidence` have the assumed noise; `noise` has the factors on the variances of forces and positions.
    """
    s, (balance, evidence) = belief.bounded(b), balance.inflated(noise[0]).in_frame(evidence.inflated(noise[1]))
    frame, _, information = balance.evidence_near(balance.settle(start, s, evidence), s, evidence)
    belief, gaussian = belief.updated(information.precision, information.shift)
    nis = _normalised_innovation(information, gaussian, frame.evidence)
    summary = _summary(belief, Convergence.SEARCH_CUT_OFF.unless(frame.converged))
    x = balance.polish(frame, belief.bounded(summary.b))
    return Update(**vars(summary), x=x, nis=nis), information


@eqx.filter_jit
def _swept(belief: AttachmentBelief, sweeps: int) -> PosteriorSummary:
    """Return the posterior after sweeps of expectation propagation."""
    return _summary(belief.swept(sweeps), Convergence.CONVERGED.code)


def _cpus() -> list[Any]:
    try:
        return jax.devices("cpu")
    except RuntimeError:  # JAX_PLATFORMS leaves it out
        return jax.devices()


def _summary(belief: AttachmentBelief, convergence: Int[Array, ""]) -> PosteriorSummary:
    """Return a belief with each particle's own numbers."""
    posterior = belief.posterior()
    return PosteriorSummary(
        belief=belief,
        convergence=convergence,
        b=posterior.stiffness,
        sd=posterior.stiffness_sd,
        probability=posterior.attached,
        entropy=posterior.entropy,
    )


_summarised = eqx.filter_jit(_summary)


def _normalised_innovation(information: FrameInformation, gaussian: Gaussian, evidence: Evidence) -> Float[Array, ""]:
    """Return e^T (N + D Sigma D^T)^-1 e per degree of freedom, Sigma before the frame and e at the s of then.

    By Woodbury's identity it is e^T N^-1 e - p^T (Sigma^-1 + D^T N^-1 D)^-1 p with p = D^T N^-1 e; `gaussian` has
    the middle matrix as its covariance.
    """
    explained = information.score @ gaussian.solve(information.score)
    degrees = jnp.maximum(jnp.sum(evidence.directions) - 3 * jnp.sum(evidence.force_unknown), 1)
    return (information.chi2 - explained) / degrees.astype(explained.dtype)
