"""The force law of springs between the sheet's vertices and points of the world, and how loads change the springs.

A spring pulls its vertex towards its anchor with F = k e (1 + c e^2), where e is its elongation beyond its slack. It
may break, yield or creep. `anchors.py` makes the springs from a scene and merges them into MuJoCo's.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

MIN_LENGTH = 1e-12
"""Length below which a spring has no direction [m]; it avoids a division by 0."""


def _zero() -> Float[np.ndarray, ""]:
    return np.zeros(())


def _unlimited() -> Float[np.ndarray, ""]:
    return np.full((), np.inf)


@dataclass(kw_only=True)
class Springs:
    """One spring for each of n vertices; a parameter is one number for all of them or one for each."""

    stiffness: Float[np.ndarray, " n"]
    """k [N/m]; 0 where there is no spring."""
    anchor: Float[np.ndarray, "n 3"]
    """Anchor minus the vertex's rest position [m]."""
    slack: Float[np.ndarray, "*n"] = field(default_factory=_zero)
    """Length up to which a spring is loose [m]."""
    hardening: Float[np.ndarray, "*n"] = field(default_factory=_zero)
    """c of the force law [1/m^2]."""
    yields_at: Float[np.ndarray, "*n"] = field(default_factory=_unlimited)
    """Largest e [m]; beyond it the anchor follows the vertex."""
    creep: Float[np.ndarray, "*n"] = field(default_factory=_zero)
    """Rate at which the anchor follows the vertex, as a share of e per second [1/s]."""
    breaks_at: Float[np.ndarray, "*n"] = field(default_factory=_unlimited)
    """Force above which a spring breaks [N]."""

    def force(self, displacement: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Return the force of each spring [N] at these displacements of the vertices from rest [m]."""
        _, e = self._elongation(displacement)
        return self.stiffness * e * (1 + self.hardening * e**2)

    def direction(self, displacement: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the unit vector from each anchor to its vertex."""
        return self._elongation(displacement)[0]

    def linearised(
        self, displacement: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
        """Return a linear spring with the same force here: its stiffness k [N/m], and k times its anchor [N].

        k is the spring's stiffness along itself, which is its largest in any direction, so that steps with it converge.
        """
        if self.linear:
            return self.stiffness, self.stiffness[:, None] * self.anchor
        direction, e = self._elongation(displacement)
        tangent = np.where(e > 0, self.stiffness * (1 + 3 * self.hardening * e**2), 0.0)
        return tangent, tangent[:, None] * displacement - self.force(displacement)[:, None] * direction

    def follow(self, displacement: Float[np.ndarray, "n 3"], duration: float) -> bool:
        """Let springs break, yield and creep for a time [s]; return whether any changed."""
        if np.isinf(self.breaks_at).all() and np.isinf(self.yields_at).all() and not self.creep.any():
            return False
        broken = (self.stiffness > 0) & (self.force(displacement) > self.breaks_at)
        self.stiffness = np.where(broken, 0.0, self.stiffness)
        direction, e = self._elongation(displacement)
        shift = np.maximum(e - self.yields_at, -np.expm1(-self.creep * duration) * e)
        shift = np.where(self.stiffness > 0, np.maximum(shift, 0.0), 0.0)
        self.anchor = self.anchor + shift[:, None] * direction
        return bool(broken.any() or shift.any())

    @property
    def linear(self) -> bool:
        """Return whether every force is proportional to the spring's length."""
        return not (self.slack.any() or self.hardening.any())

    def _elongation(
        self, displacement: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
        """Return each spring's direction and its elongation beyond the slack [m]."""
        from_anchor = displacement - self.anchor
        length = np.linalg.norm(from_anchor, axis=1)
        return from_anchor / np.maximum(length, MIN_LENGTH)[:, None], np.maximum(length - self.slack, 0.0)
