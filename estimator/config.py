"""The estimator's settings, and the ranges that they may have."""

from dataclasses import dataclass, field, replace
from typing import Literal, get_args

from jiggle_mj.argument_checks import as_choice, as_integer, as_number, store
from jiggle_mj.errors import OptionError
from jiggle_mj.options import FilterName

from .belief.config import BeliefConfig
from .belief.prior import PriorConfig
from .filters.config import FilterConfig, SamplingConfig
from .perception.config import PerceptionConfig
from .physics.surrogate import Membrane
from .ranges import check_parts

Refinement = Literal["grasps", "frames", "end"]

POSITIVE = (
    "spacing",
    "reference",
    "prior_sd",
    "force_sd",
    "cloud_force_sd",
    "anchor_sd",
    "grip_sd",
    "grip_stiffness",
    "detect_above",
)
"""Settings that must be above 0."""
SHARES = ("reference", "prior_sd", "force_sd", "cloud_force_sd", "grip_stiffness", "detect_above")
"""Settings that are shares of the membrane stiffness."""
LARGEST_RATIO = 1e7
"""Largest ratio of such a setting to the membrane stiffness, and of the membrane stiffness to it: what float32 can add
to it."""


@dataclass(frozen=True, kw_only=True)
class EstimatorConfig:
    """Settings of the estimator; stiffnesses are shares of the declared membrane stiffness k.

    Raises:
        OptionError: a setting is of another type, or out of its range.
    """

    spacing: float = 4.4e-3
    """Distance between the particles of a mesh laid over images [m]."""
    filter: FilterName = "implicit"
    """How a frame updates the belief: 'implicit' by the balance of forces, 'explicit' by a simulated step, as in the
    paper. The others are baselines: 'adam' descends the gradient of that step, 'nnls' fits forces by least squares,
    'unscented' sends patches through equilibria."""
    seed: int = 0
    """Seed of all draws of the filter. The same frames and seed give the same estimate to the last bit."""
    samples: int = 1
    """Frames that each update of the filters 'explicit' and 'adam' simulates, the latest among them."""
    membrane: Membrane = "triangles"
    """Law of the sheet's plane where no step is simulated: St Venant-Kirchhoff triangles, or springs along edges."""
    reference: float = 1.0
    """Attachment stiffness b_ref of the bounded stiffness s = 1/2, for the filter 'implicit' [k]."""
    prior_sd: float = 1 / 75
    """Standard deviation of each attachment stiffness before anything is seen, for the other filters [k]."""
    force_sd: float = 4.5e-3
    """Standard deviation of the model's force error on a particle [k x spacing]. For the filter 'implicit' it holds
    where forces of 0.07 k x spacing meet, and grows in proportion to them."""
    cloud_force_sd: float = 1.35e-3
    """The same for the filter 'implicit' on clouds [k x spacing]. A cloud lets the state slide, which takes up most of
    the error that neighbours share; where what is left is larger, residuals raise it. With `force_sd` a cloud holds so
    little evidence that what is attached is called free."""
    anchor_sd: float = 1e-4
    """Standard deviation of a welded particle from its anchor, for the filter 'implicit' [m]."""
    grip_sd: float = 1.5e-3
    """Standard deviation of held particles from where the tip takes them [m]."""
    grip_stiffness: float = 3.0
    """Stiffness of the springs that move held particles with the tip while the state is searched [k]."""
    refinement: Refinement = "grasps"
    """When the filter 'implicit' learns the noise and refines the belief thoroughly: 'grasps', whenever the jaws open;
    'end', at the end alone; 'frames', for a policy that waits for the belief: thoroughly at the end alone, and by a few
    samples after each frame, which takes a tenth of a second or two instead of a sweep's milliseconds."""
    detect_above: float = 0.011
    """Mean stiffness above which filters without P(attached) report a particle as attached [k]."""
    perception: PerceptionConfig = field(default_factory=PerceptionConfig)
    """Numbers of the trackers of images, points and clouds."""
    linearisation: FilterConfig = field(default_factory=FilterConfig)
    """Numbers of the filter 'implicit'."""
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    """Numbers of samples of the filter 'implicit'."""
    prior: PriorConfig = field(default_factory=PriorConfig)
    """Numbers of the prior of the filter 'implicit'."""
    belief: BeliefConfig = field(default_factory=BeliefConfig)
    """Numbers of the belief of the filter 'implicit', and of its sampler."""

    def __post_init__(self) -> None:
        """Check types and ranges."""
        name = type(self).__name__
        for setting in POSITIVE:
            store(self, **{setting: as_number(getattr(self, setting), f"{name}.{setting}", above=0)})
        for setting in SHARES:
            share = getattr(self, setting)
            if not 1 / LARGEST_RATIO <= share <= LARGEST_RATIO:
                raise OptionError(
                    f"{name}.{setting} is a share of the membrane stiffness and must lie between "
                    f"{1 / LARGEST_RATIO:g} and {LARGEST_RATIO:g}, what float32 can add to it; got {share}."
                )
        for setting, among in (("filter", FilterName), ("refinement", Refinement), ("membrane", Membrane)):
            as_choice(getattr(self, setting), f"{name}.{setting}", get_args(among))
        store(
            self,
            samples=as_integer(self.samples, f"{name}.samples", at_least=1),
            seed=as_integer(self.seed, f"{name}.seed", at_least=0),
        )
        check_parts(self)


def for_clouds(config: EstimatorConfig) -> EstimatorConfig:
    """Return the settings with those of the filter 'implicit' for clouds without identities in place of the others."""
    if config.filter != "implicit":
        return config
    belief = replace(config.belief, edge_transfer=config.belief.cloud_edge_transfer)
    return replace(config, force_sd=config.cloud_force_sd, belief=belief)
