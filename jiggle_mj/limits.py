"""What a plan may ask of the attachments, and where it may take the tip."""

from dataclasses import dataclass, fields


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Set by whoever answers for the tissue; a plan keeps to them as far as it knows.

    Raises:
        ValueError: a number that is not above 0, or a chance of 1/2 or more.
    """

    energy: float = 1e-7
    """Mean over all particles of the energy in their attachments [J]; the paper's 1e-8 has no unit."""
    force: float = 1e-2
    """On any one attachment [N]."""
    chance: float = 0.01
    """Largest probability with which a planned step may exceed one of the two."""
    unknown: float = 1.0
    """Stiffness of attachments that nobody knows of yet, as a plan reckons with them [N/m]."""
    ceiling: float = 0.06
    """Greatest height of the tip above the bed [m]."""
    beside: float = 0.01
    """How far beyond the resting sheet's extent the tip may go sideways [m]."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        for one in fields(self):
            value = getattr(self, one.name)
            if not value > 0:
                raise ValueError(f"Limits.{one.name} must be above 0, as no pull is possible otherwise; got {value}.")
        if not self.chance < 0.5:
            raise ValueError(f"Limits.chance must be below 0.5; got {self.chance}.")
