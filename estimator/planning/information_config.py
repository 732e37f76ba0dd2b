"""Numbers and directions of the information policy.

`InformationPolicyConfig` holds every number that a study may vary. The defaults are those of all results.
"""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float

from .policy import STEP

UP = np.array([[0.0, 0.0, 1.0]])
"""Unit vector away from the bed, as a row."""
ALONG = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], dtype=float)
"""Unit vectors along the sheet."""
SLANTED = 0.5**0.5 * (ALONG + UP)
"""Unit vectors between `ALONG` and `UP`."""
DIRECTIONS = np.concatenate([UP, ALONG, SLANTED])
"""Directions of all candidate pulls, `UP` first."""


@dataclass(frozen=True, kw_only=True)
class InformationPolicyConfig:
    """How far the information policy looks ahead, how many scenarios it draws, and how safe a pull must be.

    Raises:
        ValueError: a number is negative, a share is above 1, or there are fewer than two gain scenarios.
    """

    step: float = STEP
    """Longest displacement of the tip in one action [m]. The same as for all policies, so that steps compare."""
    pull_lengths: tuple[float, ...] = (0.5, 1, 3)
    """Lengths of the candidate pulls from the current grasp [steps]. A direction counts with its best length, so that a
    pull that shows something only after three steps is not missed. Below one step the gain still counts as one
    step's."""
    lift_heights: tuple[float, ...] = (1, 3, 6)
    """Heights of the candidate lifts from other places [steps]. They are higher than `pull_lengths`, because a new
    grasp has to make up for `regrasp_steps`."""
    regrasp_steps: float = 3
    """Cost of lowering the tissue, letting go and grasping again [steps]."""
    n_places: int = 12
    """Candidate grasps, spread over the sheet."""
    n_gain_scenarios: int = 2
    """Scenarios whose mean is the expected gain of a pull, at least 2. The first one ranks all pulls."""
    n_safety_scenarios: int = 16
    """Scenarios whose mean and standard deviation decide whether a pull is safe."""
    n_refined_pulls: int = 9
    """Pulls, best in the first scenario, that are predicted in all gain scenarios. The others count as 0."""
    n_safety_checks: int = 3
    """Pulls, best first, that are checked for safety before a shorter step is tried."""
    step_shares: tuple[float, ...] = (1.0, 0.5)
    """Shares of a step that are tried in turn, as long as no pull is safe."""
    min_gain: float = 0.004
    """Gain below which no step is worth taking [nat per particle and step]."""
    limit_share: float = 0.75
    """Share of the limits that a plan keeps to, because the size of the model's error is not known. Measured: a step
    that all scenarios put below the limit has exceeded it by a share of 0.3."""
    min_checked_energy: float = 0.1
    """Share of the energy limit. A predicted energy below it is not compared with the observed one, because the ratio
    of two small energies says nothing."""
    decided_probability: float = 0.05
    """A particle is decided if P(attached) or P(free) is below this. No new grasp is planned once all are decided."""
    graspable_inside: float = 0.02
    """Largest P(attached) of the particles near a grasp inside the sheet. No force on them can be observed, so that an
    attachment there would stay unnoticed."""
    graspable_border: float = 0.2
    """The same for a grasp on the sheet's border, where the first grasp closes before anything is known."""
    max_slip: float = 5e-3
    """Slip beyond which the tissue counts as lost from the jaws [m]."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        for setting in fields(self):
            value = getattr(self, setting.name)
            if np.any(np.less(value, 0)):
                raise ValueError(f"InformationPolicyConfig.{setting.name} must not be negative; got {value}.")
        if self.n_gain_scenarios < 2:
            raise ValueError(
                f"InformationPolicyConfig.n_gain_scenarios must be at least 2, to rank pulls and to refine them; "
                f"got {self.n_gain_scenarios}."
            )
        for name in ("limit_share", "decided_probability", "graspable_inside", "graspable_border"):
            if not (value := getattr(self, name)) <= 1:
                raise ValueError(f"InformationPolicyConfig.{name} is a share and must be in [0, 1]; got {value}.")

    @property
    def pulls(self) -> Float[np.ndarray, "k 3"]:
        """Return the displacements of all candidate pulls [m]: all lengths for each of `DIRECTIONS` in turn."""
        return np.kron(DIRECTIONS, self.step * np.array(self.pull_lengths)[:, None])
