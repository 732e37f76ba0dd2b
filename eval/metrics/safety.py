"""True loads of the attachments, frame by frame, against the limits that were set.

The mean boundary energy is over all vertices of the reference, attached or not, with anchors at rest:

    U = 1/n sum_i 1/2 b*_i |x_i - a_i|^2.

Welds store no energy that a camera could see, and are left out.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jiggle_mj.truth import Truth

from .truth_transfer import stiffness_at


@dataclass(frozen=True, kw_only=True)
class AttachmentLoads:
    """True loads, one row a frame of the truth; NaN where the truth does not say."""

    energy: Float[np.ndarray, " t"]
    """Mean over the vertices of the energy in their attachments [J]."""
    force: Float[np.ndarray, " t"]
    """Largest force on one attachment [N]."""

    @property
    def most(self) -> tuple[float | None, float | None]:
        """Largest energy [J] and force [N] over the frames; None where no frame has one."""
        energy, force = (
            float(np.nanmax(part)) if np.isfinite(part).any() else None for part in (self.energy, self.force)
        )
        return energy, force

    def over_limit(self, *, energy: float | None = None, force: float | None = None) -> Bool[np.ndarray, " t"]:
        """Return the frames in which one of the limits that are given is exceeded."""
        over = np.zeros(len(self.energy), dtype=bool)
        if energy is not None:
            over |= self.energy > energy
        if force is not None:
            over |= self.force > force
        return over

    def violations(self, *, energy: float | None = None, force: float | None = None) -> int:
        """Return the number of frames over one of the limits."""
        return int(self.over_limit(energy=energy, force=force).sum())


def attachment_loads(truth: Truth) -> AttachmentLoads:
    """Return the loads at the true stiffness and positions.

    The energy leaves out welds, which store none, and attachments of unknown stiffness.
    """
    energies, forces = [], []
    for frame in truth.frames:
        stiffness = stiffness_at(truth, frame)
        known = np.isfinite(stiffness) & np.isfinite(frame.positions).all(axis=1)
        defined = (known & (stiffness > 0)).any() or not (stiffness != 0).any()
        squared_length = np.sum((frame.positions - truth.rest)[known] ** 2, axis=1)
        energies.append(0.5 * stiffness[known] @ squared_length / len(stiffness) if defined else np.nan)
        forces.append(np.nan if frame.load is None else np.max(np.abs(frame.load), initial=0.0))
    return AttachmentLoads(energy=np.array(energies, dtype=float), force=np.array(forces, dtype=float))
