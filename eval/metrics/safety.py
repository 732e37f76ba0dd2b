"""What the attachments truly bore, frame by frame, against what was allowed."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jiggle_mj.truth import Truth

from .truth_transfer import stiffness_at


@dataclass(frozen=True, kw_only=True)
class Borne:
    """One row a frame of the truth; NaN where the truth does not say."""

    energy: Float[np.ndarray, " t"]
    """Mean over the vertices of the energy in their attachments [J]."""
    force: Float[np.ndarray, " t"]
    """Largest on one attachment [N]."""

    @property
    def most(self) -> tuple[float | None, float | None]:
        """Largest energy and force over the frames; None where no frame has one."""
        energy, force = (
            float(np.nanmax(part)) if np.isfinite(part).any() else None for part in (self.energy, self.force)
        )
        return energy, force

    def passed(self, *, energy: float | None = None, force: float | None = None) -> Bool[np.ndarray, " t"]:
        """Frames in which one of the limits that are given is passed."""
        passed = np.zeros(len(self.energy), dtype=bool)
        if energy is not None:
            passed |= self.energy > energy
        if force is not None:
            passed |= self.force > force
        return passed

    def violations(self, *, energy: float | None = None, force: float | None = None) -> int:
        """How many frames those are."""
        return int(self.passed(energy=energy, force=force).sum())


def borne(truth: Truth) -> Borne:
    """Energy at the true stiffness and positions; welds, which store none, and what is not known are left out of it."""
    energies, forces = [], []
    for frame in truth.frames:
        stiffness = stiffness_at(truth, frame)
        known = np.isfinite(stiffness) & np.isfinite(frame.positions).all(axis=1)
        says = (known & (stiffness > 0)).any() or not (stiffness != 0).any()
        stretched = np.sum((frame.positions - truth.rest)[known] ** 2, axis=1)
        energies.append(0.5 * stiffness[known] @ stretched / len(stiffness) if says else np.nan)
        forces.append(np.nan if frame.load is None else np.max(np.abs(frame.load), initial=0.0))
    return Borne(energy=np.array(energies, dtype=float), force=np.array(forces, dtype=float))
