"""The estimator's settings, and the ranges that they may have."""

from dataclasses import dataclass
from typing import Literal, get_args

from jiggle_mj.options import FilterName

from .physics.surrogate import Membrane

Refinement = Literal["grasps", "frames", "end"]


@dataclass(frozen=True, kw_only=True)
class EstimatorConfig:
    """Settings of the estimator; stiffnesses are shares of the declared membrane stiffness k."""

    spacing: float = 4.4e-3
    """Between the particles of a mesh laid over images [m]."""
    filter: FilterName = "implicit"
    """How a frame enters the belief: through the balance of forces, or, as in the paper, through a simulated step; the
    others are baselines: gradient descent on that step, least squares on the forces, and patches through equilibria."""
    samples: int = 1
    """Frames that each update of the explicit filter or of adam simulates, the latest among them."""
    membrane: Membrane = "triangles"
    """Law of the sheet's plane where no step is simulated: St Venant-Kirchhoff triangles, or springs along edges."""
    reference: float = 1.0
    """Attachment stiffness in the middle of the implicit filter's scale from free to rigid [k]."""
    prior_sd: float = 1 / 75
    """Standard deviation of each attachment stiffness before anything is seen, for the other filters [k]."""
    force_sd: float = 4.5e-3
    """Standard deviation of the force that the model gets wrong on a particle [k x spacing]; of the implicit filter,
    where forces of 0.07 k x spacing meet: it is larger in proportion where more do."""
    anchor_sd: float = 1e-4
    """How far a welded particle may be from its anchor, for the implicit filter [m]."""
    grip_sd: float = 1.5e-3
    """How well held particles follow the tip [m]."""
    grip_stiffness: float = 3.0
    """Of the springs that carry held particles with the tip while the state is searched [k]."""
    refinement: Refinement = "grasps"
    """When the implicit filter judges noise and belief thoroughly: 'grasps', whenever the jaws open; 'end', at the end
    alone; 'frames', for a policy, which waits for the belief: at the end alone, and by a few samples after each frame,
    which takes a second or two instead of a sweep's milliseconds."""
    detect_above: float = 0.011
    """Filters that state no probability report a particle attached when its mean stiffness exceeds this [k]."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in POSITIVE:
            if not getattr(self, name) > 0:
                raise ValueError(f"EstimatorConfig.{name} must be above 0; got {getattr(self, name)}.")
        for name in SHARES:
            share = getattr(self, name)
            if not 1 / LARGEST_RATIO <= share <= LARGEST_RATIO:
                raise ValueError(
                    f"EstimatorConfig.{name} is a share of the membrane stiffness and must lie between "
                    f"{1 / LARGEST_RATIO:g} and {LARGEST_RATIO:g}, what float32 can add to it; got {share}."
                )
        if self.filter not in get_args(FilterName):
            raise ValueError(f"EstimatorConfig.filter must be one of {get_args(FilterName)}; got {self.filter!r}.")
        if self.refinement not in get_args(Refinement):
            raise ValueError(
                f"EstimatorConfig.refinement must be one of {get_args(Refinement)}; got {self.refinement!r}."
            )
        if not (isinstance(self.samples, int) and self.samples >= 1):
            raise ValueError(f"EstimatorConfig.samples must be an integer of at least 1; got {self.samples}.")
        if self.membrane not in ("triangles", "edges"):
            raise ValueError(f"EstimatorConfig.membrane must be 'triangles' or 'edges'; got {self.membrane!r}.")


POSITIVE = (
    "spacing",
    "reference",
    "prior_sd",
    "force_sd",
    "anchor_sd",
    "grip_sd",
    "grip_stiffness",
    "detect_above",
)
"""Settings that must be above 0."""

SHARES, LARGEST_RATIO = ("reference", "prior_sd", "force_sd", "grip_stiffness", "detect_above"), 1e7
"""Settings that are shares of the membrane stiffness, and how far from it they may be either way."""
