"""The measured forces of the tool beside those that the sheet's shape predicts, and what they make of stiffnesses."""

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ..belief.attachment_belief import AttachmentBelief
from .force_axes import doubt
from .force_evidence import ForceEvidence, LogFactor, StackedForces, fitted, innovations
from .tool_force import FrameForce

NO_NOISE = (
    "the noise of the force is not known, so that it is compared and not used: state its standard deviation, or record "
    "five or more frames before the jaws close."
)
"""Why a force is not used that has no covariance."""

MAX_LOG_SD = 0.35
"""Standard deviation of the factor's logarithm above which the frames do not determine it [nat]: a factor of two either
way, as for the ratios of `identify`."""


class StiffnessScale(eqx.Module):
    """How stiff the sheet and its attachments are, over what the declared membrane stiffness makes of them."""

    factor: float
    """True over declared stiffness [1]."""
    log_sd: float
    """Standard deviation of its logarithm [nat]."""
    log_with_s: Float[np.ndarray, " n"]
    """Covariance of its logarithm with each s [nat]."""

    def added_covariance(self, s: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n n"]:
        """Return what the error of the factor adds to the covariance of s, b_ref multiplied by the factor.

        By d logit(s) = d log(b) it is k h^T + h k^T + sd^2 h h^T with h = s (1 - s) and k the covariance with s.
        """
        h = s * (1 - s)
        cross = np.outer(self.log_with_s, h)
        return cross + cross.T + self.log_sd**2 * np.outer(h, h)


class ForceFit(eqx.Module):
    """Measured and predicted forces of some frames, and the evidence that they give."""

    index: Int[np.ndarray, " t"]
    """Index of each observation."""
    measured: Float[np.ndarray, "t 3"]
    """Force on the tool [N]."""
    predicted: Float[np.ndarray, "t 3"]
    """The same by the shape and the declared stiffness, without any force [N]."""
    predicted_covariance: Float[np.ndarray, "t 3 3"]
    """Covariance of their difference [N^2]."""
    nis: float
    """Normalised innovation squared per degree of freedom, at the declared stiffness [1]."""
    scaled_nis: float
    """The same at the factor that fits best [1]."""
    doubt: str | None
    """Why the force is not used; None where it is."""
    before: LogFactor
    """Logarithm of the factor before these forces."""
    evidence: ForceEvidence | None
    """Evidence about s and the factor; None where the force is not used."""

    @classmethod
    def of(cls, frames: Sequence[FrameForce], belief: AttachmentBelief, *, before: LogFactor) -> "ForceFit":
        """Compare the forces of frames with a belief that does not hold them.

        Args:
            frames: at least one.
            belief: by the shape alone.
            before: logarithm of the factor on all stiffnesses before these forces.
        """
        forces = StackedForces.of(frames)
        known = bool(np.isfinite(forces.load_covariance).all())
        if not known:
            given = {name: np.nan_to_num(getattr(forces, name)) for name in ("load_covariance", "offset_sd")}
            forces = replace(forces, **given)
        information = belief.information
        precision, shift = np.asarray(information.precision), np.asarray(information.shift)
        covariance = np.linalg.inv(precision)
        mean = covariance @ shift
        difference, spread = innovations(forces, mean, covariance, factor=1.0)
        sds, given = (np.sqrt(np.diagonal(part, axis1=1, axis2=2)) for part in (spread, forces.total_covariance(1.0)))
        why = doubt(forces.elastic(mean), forces.pull, forces.loads, sds, given) or (None if known else NO_NOISE)
        evidence, log_factor = fitted(forces, precision, shift, before=before)
        return cls(
            index=np.array([frame.index for frame in frames]),
            measured=-forces.pull,
            predicted=difference - forces.pull,
            predicted_covariance=spread,
            nis=_nis(difference, spread),
            scaled_nis=_nis(*innovations(forces, mean, covariance, factor=np.exp(log_factor))),
            doubt=why,
            before=before,
            evidence=evidence if why is None else None,
        )

    def changed(self, belief: AttachmentBelief) -> "ForceFit":
        """Return the fit after a cut or suture: the factor is known as before, whatever becomes of the attachments.

        Args:
            belief: before the cut or suture, with the evidence.
        """
        if self.evidence is None:
            return self
        mean, sd, _ = self.evidence.given(*(np.asarray(part) for part in belief.moments()))
        known = LogFactor(mean=mean, sd=sd)
        return replace(self, before=known, evidence=ForceEvidence.of_factor(known, len(belief.shift)))

    def scale(self, belief: AttachmentBelief) -> StiffnessScale | None:
        """Return the factor on all stiffnesses for a posterior that holds the evidence; None where it says nothing."""
        if self.evidence is None:
            return None
        mean, covariance = (np.asarray(part) for part in belief.moments())
        log_factor, sd, with_s = self.evidence.given(mean, covariance)
        return StiffnessScale(factor=np.exp(log_factor), log_sd=sd, log_with_s=with_s) if sd <= MAX_LOG_SD else None


def _nis(difference: Float[np.ndarray, "t 3"], covariance: Float[np.ndarray, "t 3 3"]) -> float:
    """Return the mean squared Mahalanobis norm per component."""
    whitened = np.linalg.solve(covariance, difference[..., None])[..., 0]
    return float(np.mean(np.sum(difference * whitened, axis=1)) / 3)
