"""Limits of a plan: on the load of the attachments, and on where the tip may go."""

from dataclasses import dataclass, fields


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits that the person responsible for the tissue sets; a plan keeps to them as far as its belief predicts.

    Raises:
        ValueError: a number that is not above 0, or a chance of 1/2 or more.
    """

    energy: float = 1e-7
    """Largest mean over all particles of the energy in their attachments [J]; the paper's 1e-8 has no unit."""
    force: float = 1e-2
    """Largest force on any one attachment [N]."""
    chance: float = 0.01
    """Largest probability that a planned step exceeds the limit on energy or force."""
    unknown: float = 1.0
    """Stiffness that a plan assumes for attachments that are not found yet [N/m]."""
    ceiling: float = 0.06
    """Greatest height of the tip above the bed [m]."""
    beside: float = 0.01
    """How far beyond the resting sheet's extent the tip may go sideways [m]."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        for field in fields(self):
            value = getattr(self, field.name)
            if not value > 0:
                raise ValueError(f"Limits.{field.name} must be above 0, as no pull is possible otherwise; got {value}.")
        if not self.chance < 0.5:
            raise ValueError(f"Limits.chance must be below 0.5; got {self.chance}.")
