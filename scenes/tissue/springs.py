"""Springs between vertices of the sheet and points of the world, and what a load does to them.

A spring pulls its vertex towards its anchor with F = k e (1 + c e^2), where e is how much farther than its slack it is
stretched. It may break, yield or creep; then it is another spring from there on.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float


def _none() -> Float[np.ndarray, ""]:
    return np.zeros(())


def _unlimited() -> Float[np.ndarray, ""]:
    return np.full((), np.inf)


@dataclass(kw_only=True)
class Springs:
    """One spring for each of n vertices; a law is a number for all of them or one each."""

    stiffness: Float[np.ndarray, " n"]
    """k [N/m]; 0 where there is none."""
    anchor: Float[np.ndarray, "n 3"]
    """How far from the vertex's place at rest [m]."""
    slack: Float[np.ndarray, "*n"] = field(default_factory=_none)
    """Length below which it is loose [m]."""
    hardening: Float[np.ndarray, "*n"] = field(default_factory=_none)
    """c [1/m^2]."""
    yields_at: Float[np.ndarray, "*n"] = field(default_factory=_unlimited)
    """Largest e; beyond it the anchor comes after [m]."""
    creep: Float[np.ndarray, "*n"] = field(default_factory=_none)
    """Share of e by which the anchor comes after in a second [1/s]."""
    breaks_at: Float[np.ndarray, "*n"] = field(default_factory=_unlimited)
    """Largest force [N]."""

    def force(self, moved: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """How hard each pulls once the vertices have moved from rest [N]."""
        _, e = self._stretch(moved)
        return self.stiffness * e * (1 + self.hardening * e**2)

    def direction(self, moved: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """From each anchor to its vertex, a unit vector."""
        return self._stretch(moved)[0]

    def linearised(self, moved: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
        """A linear spring that pulls the same here: its stiffness, and that times its anchor.

        It is as stiff as the spring is along itself, which is the most in any direction: so steps with it converge.
        """
        if self.linear:
            return self.stiffness, self.stiffness[:, None] * self.anchor
        direction, e = self._stretch(moved)
        tangent = np.where(e > 0, self.stiffness * (1 + 3 * self.hardening * e**2), 0.0)
        return tangent, tangent[:, None] * moved - self.force(moved)[:, None] * direction

    def follow(self, moved: Float[np.ndarray, "n 3"], duration: float) -> bool:
        """Break, yield and creep for a time [s]; whether anything changed."""
        if np.isinf(self.breaks_at).all() and np.isinf(self.yields_at).all() and not self.creep.any():
            return False
        broken = (self.stiffness > 0) & (self.force(moved) > self.breaks_at)
        self.stiffness = np.where(broken, 0.0, self.stiffness)
        direction, e = self._stretch(moved)
        after = np.maximum(e - self.yields_at, -np.expm1(-self.creep * duration) * e)
        after = np.where(self.stiffness > 0, np.maximum(after, 0.0), 0.0)
        self.anchor = self.anchor + after[:, None] * direction
        return bool(broken.any() or after.any())

    @property
    def linear(self) -> bool:
        """Whether its pull is proportional to its length."""
        return not (self.slack.any() or self.hardening.any())

    def _stretch(self, moved: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
        away = moved - self.anchor
        length = np.linalg.norm(away, axis=1)
        return away / np.maximum(length, 1e-12)[:, None], np.maximum(length - self.slack, 0.0)
