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
    edge_transfer: float = 0.12
    """Standard deviation of the part of the difference between two neighbours that belongs to the softer one, where
    both are soft: with it NEES from images of `line` is 1."""
    cloud_edge_transfer: float = 0.25
    """The same for clouds without identities: they show where the sheet bends, and not which of two neighbours bends
    it. Chosen on one recording each of `arc` and `line`."""
    rim_transfer: float = 0.5
    """The same where the stiffer one is rigid: that of all or nothing, equally likely."""
    common_error: float = 0.06
    """Standard deviation of the logarithm of the factor that all attachments of a sheet have in common, as one mesh's
    forces are not another's [nat]. From images of `arc` and `line` sums of b are 0.94 of the truth."""
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
        for name in ("edge_transfer", "cloud_edge_transfer", "rim_transfer", "common_error"):
            as_number(getattr(self, name), f"BeliefConfig.{name}", at_least=0)
        as_number(self.tail, "BeliefConfig.tail", above=0, below=0.5)
        check_parts(self)
