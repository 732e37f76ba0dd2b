"""Settings of the belief over the attachments and of its sampler.

Limits against rounding are constants of the files that need them.
"""

from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class SamplerConfig:
    """Settings of the Gibbs sampler."""

    candidates: int = 16
    """Particles whose next component is drawn together. More of them save sequential steps where few particles change,
    and cost more for each change. Affects the speed alone."""
    pending_updates: int = 32
    """Rank-one updates of the covariance that are applied as one product: each by itself would read and write all of
    it. Affects the speed alone."""
    sweeps_per_round: int = 10
    """Sweeps between two factorisations of the precision, which remove the rounding errors of the rank-one updates."""
    agreement: float = 0.02
    """Mean difference of P(attached) between the two halves of the sweeps below which they agree. Small against
    the 0.5 above which a particle is called attached."""

    def __post_init__(self) -> None:
        for name in ("candidates", "pending_updates", "sweeps_per_round"):
            if getattr(self, name) < 1:
                raise ValueError(f"SamplerConfig.{name} must be at least 1; got {getattr(self, name)}.")
        if not self.agreement > 0:
            raise ValueError(f"SamplerConfig.agreement must be positive; got {self.agreement:g}.")


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
    open_above: float = 0.9
    """Bounded stiffness above which the upper end of an interval is infinite: nine times b_ref and a weld
    differ by less than the mesh resolves."""
    tail: float = 0.05
    """Probability beyond either end of an interval; 0.05 gives 90 % intervals."""
    sampler: SamplerConfig = field(default_factory=SamplerConfig)
    """Settings of `AttachmentBelief.sampled` and `AttachmentBelief.mode`."""

    def __post_init__(self) -> None:
        for name in ("damping", "learning_rate"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"BeliefConfig.{name} must be in (0, 1]; got {getattr(self, name):g}.")
        if not self.mesh_transfer >= 0:
            raise ValueError(f"BeliefConfig.mesh_transfer must not be negative; got {self.mesh_transfer:g}.")
        if not 0 < self.open_above <= 1:
            raise ValueError(f"BeliefConfig.open_above must be in (0, 1]; got {self.open_above:g}.")
        if not 0 < self.tail < 0.5:
            raise ValueError(f"BeliefConfig.tail must be in (0, 0.5); got {self.tail:g}.")
