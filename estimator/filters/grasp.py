"""The frames of one grasp, and their evidence about s together."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..parallel_map import parallel_map
from .evidence import Evidence
from .force_balance import ForceBalance
from .frame import FrameInformation
from .noise import ForceResiduals, Noise
from .tool_force import FrameForce, frame_force


class GraspFrame(eqx.Module):
    """One frame as it was linearised."""

    evidence: Evidence
    """What was measured, with the assumed noise."""
    x: Float[Array, "n 3"]
    """The state that was found [m]."""
    s: Float[Array, " n"]
    """Bounded stiffnesses of the linearisation [1]."""


class GraspFrames(eqx.Module):
    """The frames between closing and opening the jaws, and their evidence about s in information form."""

    frames: tuple[GraspFrame, ...]
    """In order of time."""
    precision: Float[Array, "n n"]
    """Sum of the frames' precisions of s."""
    shift: Float[Array, " n"]
    """Sum of the frames' information vectors."""
    noise: Noise | None
    """The noise that all frames were linearised with; None while frames arrive, each linearised at the belief of its
    time, and after the sheet's energy has changed."""
    residuals: ForceResiduals | None
    """Sum of the frames' residuals; None where they were not linearised again."""
    forces: tuple[FrameForce, ...]
    """What the tool's force says in the frames that have one, once they were linearised again."""

    @classmethod
    def empty(cls, n: int, noise: Noise | None = None) -> "GraspFrames":
        """Return a grasp of n particles without frames."""
        return cls(frames=(), precision=jnp.zeros((n, n)), shift=jnp.zeros(n), noise=noise, residuals=None, forces=())

    def with_frame(
        self,
        evidence: Evidence,
        x: Float[Array, "n 3"],
        information: FrameInformation,
        residuals: ForceResiduals | None = None,
        force: FrameForce | None = None,
    ) -> "GraspFrames":
        """Return the grasp with one frame more."""
        before = self.residuals
        return GraspFrames(
            frames=(*self.frames, GraspFrame(evidence=evidence, x=x, s=information.at)),
            precision=self.precision + information.precision,
            shift=self.shift + information.shift,
            noise=self.noise,
            residuals=residuals if before is None or residuals is None else before + residuals,
            forces=self.forces if force is None else (*self.forces, force),
        )

    def distance(self, s: Float[Array, " n"]) -> float:
        """Return the largest change of any s since a frame was linearised [1]."""
        return max(float(jnp.max(jnp.abs(s - frame.s))) for frame in self.frames)

    def relinearised(self, balance: ForceBalance, s: Float[Array, " n"], noise: Noise) -> "GraspFrames":
        """Return the same frames linearised at s with the given noise, each searched from the state found before."""
        grasp, balance = GraspFrames.empty(len(s), noise), balance.inflated(noise.force)

        def relinearise(k: int) -> tuple[Float[Array, "n 3"], FrameInformation, ForceResiduals, FrameForce | None]:
            own_balance, evidence = balance.in_frame(self.frames[k].evidence.inflated(noise.position))
            frame, fit, information = own_balance.evidence_near(self.frames[k].x, s, evidence)
            force = None if evidence.force is None else frame_force(own_balance, frame, fit)
            return frame.x, information, _residuals(own_balance, frame, fit), force

        for k, (x, information, residuals, force) in parallel_map(relinearise, range(len(self.frames))).items():
            grasp = grasp.with_frame(self.frames[k].evidence, x, information, residuals, force)
        return grasp


_residuals = eqx.filter_jit(ForceBalance.residuals)
