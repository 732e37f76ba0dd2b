"""Settings of the belief over the attachments and of its sampler.

Limits against rounding are constants of the files that need them.
"""

from dataclasses import dataclass, field

from jiggle_mj.argument_checks import as_integer, as_number

from ..ranges import check_parts, check_ranges


@dataclass(frozen=True, kw_only=True)
class SamplerConfig:
    """Settings of the Gibbs sampler."""

    chains: int = 8
    """Chains that run side by side. More of them start from more places and use more cores; fewer forget where they
    started in fewer sweeps altogether."""
    candidates: int = 32
    """Particles whose next component is drawn together. More of them save sequential steps where few particles change,
    and cost more for each change. Affects the speed alone."""
    agreement: float = 0.02
    """Mean difference of P(attached) between the two halves of the chains below which they agree. Small against
    the 0.5 above which a particle is called attached."""

    def __post_init__(self) -> None:
        """Check types and ranges."""
        as_integer(self.chains, "SamplerConfig.chains", at_least=2)
        as_integer(self.candidates, "SamplerConfig.candidates", at_least=1)
        check_ranges(self, positive=("agreement",))


@dataclass(frozen=True, kw_only=True)
class BeliefConfig:
    """Settings of the belief over the bounded stiffnesses s."""

    damping: float = 0.7
    """Share of the result of a sweep that replaces the old sites and messages. Below 1, as undamped messages between
    neighbours may oscillate."""
    learning_rate: float = 0.2
    """Share of a step of expectation maximisation that the component weights take in a sweep. With a rate of 1 a
    particle that is attached with a probability of about one half changes the weights, and they change it back."""
    mesh_transfer: float = 0.08
    """Standard deviation of the share of an attachment that a mesh assigns to the neighbour along each edge instead,
    from images of the shipped scenes. It is scaled by s (1 - s): a free particle has nothing to assign and a weld does
    not become softer."""
    cloud_mesh_transfer: float = 0.3
    """The same for clouds without identities: they show where the sheet bends, and not which of two neighbours bends
    it. Chosen on one recording each of `arc` and `line`."""
    rim_transfer: float = 12**-0.5
    """The same share where a rigid attachment ends between two neighbours: that of a rim of which only is known that it
    lies between them. It is scaled by the difference of their s and by their sum, as a soft attachment acts on both."""
    open_above: float = 0.9
    """Bounded stiffness above which the upper end of an interval is infinite: nine times b_ref and a weld
    differ by less than the mesh resolves."""
    tail: float = 0.05
    """Probability beyond either end of an interval; 0.05 gives 90 % intervals."""
    sampler: SamplerConfig = field(default_factory=SamplerConfig)
    """Settings of `AttachmentBelief.sampled` and `AttachmentBelief.mode`."""

    def __post_init__(self) -> None:
        """Check types and ranges."""
        shares = ("damping", "learning_rate", "open_above")
        check_ranges(self, positive=shares, shares=shares)
        for name in ("mesh_transfer", "cloud_mesh_transfer", "rim_transfer"):
            as_number(getattr(self, name), f"BeliefConfig.{name}", at_least=0)
        as_number(self.tail, "BeliefConfig.tail", above=0, below=0.5)
        check_parts(self)
