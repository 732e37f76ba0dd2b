"""Our filter: each frame's balance of forces is evidence about the bounded stiffness s of every attachment.

A frame is linearised at the belief of its time and added to it (`force_balance`, `attachment_belief`). A stiff
attachment shows only once its surroundings are believed stiff: when the jaws open, grasps that were linearised far from
what is believed now are linearised again, and replace what they said before. Nothing is counted twice.
"""

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Bool, Float, Int

from ..belief.attachment_belief import AttachmentBelief
from ..belief.attachment_prior import AttachmentPrior
from ..belief.spike_and_slab import SpikeAndSlab
from ..parallel_map import parallel_map
from ..physics.energy import SheetEnergy
from ..physics.mesh import SheetMesh
from .evidence import Evidence, Filter, PosteriorSummary, Update
from .force_balance import Fit, ForceBalance, Frame, FrameInformation
from .noise import ForceResiduals, Noise

SPIKE = 3e-4
"""Width of s where free."""
COMPONENTS, SPREAD, DIRICHLET_STRENGTH = tuple(0.003 * 10 ** (i / 4) for i in range(11)), 0.3, 3.0
"""Of s where attached, from hardly felt to rigid; their relative widths; see `SpikeAndSlab.dirichlet_strength`."""
PARTIAL = 0.4
"""Share of attached particles that have a part of an attachment, as at a border: what two meshes make of the shipped
scenes."""
PROBABILITY, COUPLING = 0.047, 1.0
"""Of being attached without attached neighbours, and what each adds to the log odds: three of an inner particle's six
make it even, so that a free and an attached stretch are equally likely beforehand. A little more of either, and samples
find everything attached where little is known, or nothing."""
BURN_IN, PASSING, SAMPLES = 3, (3, 1), (20, 3)
"""Rounds of samples when the jaws open: left out, and see `Sampler.run`, how many and how often as many again as all so
far at most, in passing and at the end."""
STALE = 0.1
"""A grasp is linearised again when some s has moved further than this from where it was."""
FELT = 3e-3
"""The same, before the noise is judged by what a grasp leaves unexplained: the softest attachment's s."""
SWEEPS = 10
"""Over a belief after something was cut or sewn."""
PASSES = 3
"""Over stale grasps, and over noises, at most, when the jaws open."""


class ImplicitFilter(Filter):
    """The filter for one sheet, with the grasps so far."""

    def __init__(self, balance: ForceBalance) -> None:
        """Take the sheet's balance of forces."""
        self._balance = balance
        self._grasps: list[_Grasp] = []
        self._between, self._due = True, False
        self._noise = Noise()
        self._kept: tuple[Any, Any] = 0.0, 0.0

    @property
    def noise(self) -> Noise:
        """See `Filter.noise`."""
        return self._noise

    def update(
        self, belief: AttachmentBelief, b: Float[Array, " n"], evidence: Evidence, start: Float[Array, "n 3"]
    ) -> Update:
        """See `Filter.update`."""
        s = belief.bounded(b)
        noisy = evidence.widened(self._noise.position)
        frame, _, found = _seen(self.balance, _settled(self.balance, start, s, noisy), s, noisy)
        update = _believed(self.balance, belief, frame, found, noisy)
        if np.isfinite(update.x).all() and np.isfinite(update.b).all():
            if self._between:
                self._grasps.append(_Grasp())
            self._grasps[-1].take(evidence, update.x, found)
            self._between = False
        return update

    def reconsider(self, belief: AttachmentBelief) -> PosteriorSummary:
        """See `Filter.reconsider`: as few samples give it, which find most of what propagation misses in a grasp."""
        return reconsidered(belief)

    def release(self, belief: AttachmentBelief, *, thorough: bool = True) -> PosteriorSummary | None:
        """The belief with all grasps linearised again that need it; the next frame begins another grasp.

        In passing the noise is not judged, and few samples have to do.
        """
        if self._between and not (thorough and self._due):
            return None
        self._between, self._due = True, not thorough
        return self._refined(belief) if thorough else self._settled(_sampled(belief, PASSING), STALE, 1)

    def restart(self, belief: AttachmentBelief) -> PosteriorSummary:
        """Keep a belief as it is: no frame from before is judged again. The next one begins another grasp."""
        self._between, self._grasps, self._kept = True, [], (belief.precision, belief.shift)
        return _swept(belief)

    def evidence(self) -> tuple[Float[Array, "n n"], Float[Array, " n"]] | None:
        """What the frames since `restart`, or all frames, say of s, in information form; None before the first."""
        return self._total() if self._grasps else None

    def of(self, belief: AttachmentBelief, energy: SheetEnergy) -> PosteriorSummary:
        """All grasps so far judged again by another energy of the same sheet, the noise learned anew."""
        self._balance, self._noise = self._balance.of(energy), Noise()
        for grasp in self._grasps:
            grasp.noise = None
        return self._refined(belief)

    @property
    def energy(self) -> SheetEnergy:
        """Of the sheet without attachments."""
        return self._balance.energy

    @property
    def balance(self) -> ForceBalance:
        """Of forces, with the noise that was learned."""
        return self._balance.widened(self._noise.force)

    def frames(self) -> Iterator[tuple[ForceBalance, Evidence, Float[Array, "n 3"]]]:
        """What was seen so far, with the noise that was learned, and the states found; by which balance."""
        for grasp in self._grasps:
            for evidence, x, _ in grasp.frames:
                yield self.balance, evidence.widened(self._noise.position), x

    def _refined(self, belief: AttachmentBelief) -> PosteriorSummary:
        summary = self._settled(_sampled(belief, PASSING), STALE, PASSES)
        for _ in range(PASSES):
            if self._learned() == self._noise:
                break
            summary = self._settled(summary, FELT, 1)
            self._noise = self._learned()
            summary = self._settled(summary, STALE, PASSES)
        return _sampled(summary.belief, SAMPLES)

    def _settled(self, summary: PosteriorSummary, far: float, passes: int) -> PosteriorSummary:
        """After grasps that were linearised further than `far` from what is believed were linearised again."""
        for _ in range(passes):
            belief = summary.belief
            assert isinstance(belief, AttachmentBelief)
            s = belief.bounded(summary.b)
            stale = [grasp.noise != self._noise or grasp.distance(s) > far for grasp in self._grasps]
            if not any(stale):
                break
            self._grasps = [
                grasp.again(self._balance, s, self._noise) if old else grasp
                for grasp, old in zip(self._grasps, stale, strict=True)
            ]
            total = tuple(kept + new for kept, new in zip(self._kept, self._total(), strict=True))
            belief = eqx.tree_at(lambda one: (one.precision, one.shift), belief, total)
            summary = _sampled(belief, PASSING)
        return summary

    def _total(self) -> tuple[Any, Any]:
        """What all grasps say together."""
        return sum(grasp.precision for grasp in self._grasps), sum(grasp.shift for grasp in self._grasps)

    def _learned(self) -> Noise:
        return self._noise.learned([grasp.misfit for grasp in self._grasps if grasp.misfit is not None])


def prior_belief(mesh: SheetMesh, *, reference: float) -> AttachmentBelief:
    """The prior of a sheet, with b_ref = reference [N/m]."""
    stiffness = SpikeAndSlab.build(
        spike=SPIKE, components=COMPONENTS, spread=SPREAD, dirichlet_strength=DIRICHLET_STRENGTH, partial=PARTIAL
    )
    prior = AttachmentPrior.build(mesh.n, mesh.edges, stiffness=stiffness, probability=PROBABILITY, coupling=COUPLING)
    return AttachmentBelief.before(prior, reference=reference)


def reconsidered(belief: AttachmentBelief) -> PosteriorSummary:
    """The belief as a few samples give it."""
    return _sampled(belief, PASSING)


@eqx.filter_jit
def likeliest(belief: AttachmentBelief) -> Float[Array, " n"]:
    """S of the attachments that are likeliest together."""
    return belief.mode(jax.random.key(0))


class _Grasp:
    """The frames between closing and opening the jaws, and what they say together."""

    def __init__(self, noise: Noise | None = None) -> None:
        """Of no frames yet; `noise` is None while frames come in, each linearised for the belief of its time."""
        self.noise = noise
        self.precision: Float[Array, "n n"] | float = 0.0
        self.shift: Float[Array, " n"] | float = 0.0
        self.misfit: ForceResiduals | None = None
        """What they leave unexplained, if they were linearised again."""
        self.frames: list[tuple[Evidence, Float[Array, "n 3"], Float[Array, " n"]]] = []
        """What was seen, the state, and the s of the linearisation."""

    def take(self, evidence: Evidence, x: Float[Array, "n 3"], found: FrameInformation) -> None:
        self.frames.append((evidence, x, found.at))
        self.precision, self.shift = self.precision + found.precision, self.shift + found.shift

    def distance(self, s: Float[Array, " n"]) -> float:
        """How far s is from where a frame was linearised."""
        return max(float(jnp.max(jnp.abs(s - at))) for _, _, at in self.frames)

    def again(self, balance: ForceBalance, s: Float[Array, " n"], noise: Noise) -> "_Grasp":
        """The same frames, linearised at s for a noise."""
        grasp, balance = _Grasp(noise), balance.widened(noise.force)

        def one(k: int) -> tuple[Float[Array, "n 3"], FrameInformation, ForceResiduals]:
            evidence, x, _ = self.frames[k]
            noisy = evidence.widened(noise.position)
            frame, fit, found = _seen(balance, x, s, noisy)
            return frame.x, found, _misfit(balance, frame, fit, noisy)

        for k, (x, found, misfit) in parallel_map(one, range(len(self.frames))).items():
            grasp.take(self.frames[k][0], x, found)
            grasp.misfit = misfit if grasp.misfit is None else grasp.misfit + misfit
        return grasp


_settled, _misfit = eqx.filter_jit(ForceBalance.settle), eqx.filter_jit(ForceBalance.misfit)


@eqx.filter_jit
def _seen(
    balance: ForceBalance, x: Float[Array, "n 3"], s: Float[Array, " n"], evidence: Evidence
) -> tuple[Frame, Fit, FrameInformation]:
    """What a frame says, from a state nearby."""
    frame = balance.approach(x, s, evidence)
    fit = balance.fit(frame)
    return frame, fit, balance.information(frame, fit)


@eqx.filter_jit
def _believed(
    balance: ForceBalance, belief: AttachmentBelief, frame: Frame, found: FrameInformation, evidence: Evidence
) -> Update:
    """The belief with what a frame says, and the state by it."""
    belief = belief.add(found.precision, found.shift)
    gaussian = belief.gaussian()
    nis = _normalised_innovation(found, gaussian.factor, evidence)
    belief = belief.sweep(gaussian)
    summary = _summary(belief, frame.converged)
    x = balance.polish(frame, belief.bounded(summary.b), evidence)
    return Update(**vars(summary), x=x, nis=nis)


@eqx.filter_jit
def _swept(belief: AttachmentBelief) -> PosteriorSummary:
    return _summary(belief.swept(SWEEPS), jnp.asarray(True))


def _sampled(belief: Any, rounds: tuple[int, int]) -> PosteriorSummary:
    """On a CPU where JAX has one: samples follow one another, and a GPU takes ten times as long."""
    with jax.default_device(_cpus()[0]):
        return _state_sampled(belief, *map(jnp.asarray, rounds))


def _cpus() -> list[Any]:
    try:
        return jax.devices("cpu")
    except RuntimeError:  # JAX_PLATFORMS leaves it out
        return jax.devices()


@eqx.filter_jit
def _state_sampled(belief: AttachmentBelief, rounds: Int[Array, ""], doublings: Int[Array, ""]) -> PosteriorSummary:
    return _summary(*belief.sampled(jax.random.key(0), burn_in=BURN_IN, rounds=rounds, doublings=doublings))


def _summary(belief: AttachmentBelief, converged: Bool[Array, ""]) -> PosteriorSummary:
    posterior = belief.posterior()
    return PosteriorSummary(
        belief=belief,
        converged=converged,
        b=posterior.stiffness,
        sd=posterior.stiffness_sd,
        probability=posterior.attached,
        entropy=posterior.entropy,
    )


def _normalised_innovation(
    found: FrameInformation, factor: Float[Array, "n n"], evidence: Evidence
) -> Float[Array, ""]:
    """e^T (N + D Sigma D^T)^-1 e per degree of freedom, with Sigma from before the frame and e at the s of then.

    By Woodbury's identity e^T N^-1 e - p^T (Sigma^-1 + D^T N^-1 D)^-1 p with p = D^T N^-1 e; `factor` is
    that of the middle matrix.
    """
    explained = found.pulled @ cho_solve((factor, True), found.pulled)
    observed = 3 * jnp.sum(evidence.seen)
    degrees = jnp.maximum(observed - 3 * jnp.sum(evidence.force_unknown), 1)
    return (found.squared - explained) / degrees.astype(explained.dtype)
