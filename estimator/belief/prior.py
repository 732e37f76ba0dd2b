"""The implicit filter's prior over the attachments of one sheet, with the numbers that define it."""

from dataclasses import dataclass

from ..physics.mesh import SheetMesh
from ..ranges import check_ranges
from .attachment_belief import AttachmentBelief
from .attachment_prior import AttachmentPrior
from .config import BeliefConfig
from .spike_and_slab import SpikeAndSlab


@dataclass(frozen=True, kw_only=True)
class PriorConfig:
    """Numbers of the prior; s = b / (b + b_ref) in [0, 1] is the bounded stiffness of an attachment."""

    spike: float = 3e-4
    """Standard deviation of s where a particle is free [1]: a tenth of the softest component."""
    components: tuple[float, ...] = tuple(0.003 * 10 ** (i / 4) for i in range(11))
    """Centres of s where a particle is attached [1], four in each decade, from hardly felt to rigid."""
    spread: float = 0.3
    """Standard deviation of each component as a share of its centre [1]."""
    dirichlet_strength: float = 3.0
    """Number of attached particles that the equal weights of the components are worth when the weights are learned
    [particles]; see `SpikeAndSlab.dirichlet_strength`."""
    sheet_strength: float = 1.0
    """Number of attached neighbours that the component weights of the whole sheet are worth beside the neighbours' own
    [particles]: inside a patch six in seven attachments are like their neighbours. See `AttachmentPrior.share`."""
    partial: float = 0.4
    """Share of attached particles that have only a part of an attachment, as at a border [1]. It is measured where two
    meshes represent the attachments of the shipped scenes."""
    probability: float = 0.047
    """P(attached) of a particle without attached neighbours [1]. With this value and `coupling`, three attached
    neighbours of an inner particle's six make it as likely attached as free, so that a free and an attached stretch
    are equally likely. With a little more of either, samples find everything or nothing attached where little is
    known."""
    coupling: float = 1.0
    """What each attached neighbour adds to the log odds of being attached [nat]; see `probability`."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_ranges(self, positive=("spike", "spread", "dirichlet_strength", "sheet_strength"))
        for name in ("partial", "probability"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f"PriorConfig.{name} must lie between 0 and 1; got {getattr(self, name)}.")
        if not self.components or not all(0 < s <= 1 for s in self.components):
            raise ValueError(f"PriorConfig.components must be one or more s in (0, 1]; got {self.components}.")
        softest = self.spread * min(self.components)
        if self.spike >= softest:
            raise ValueError(
                f"PriorConfig.spike must be below {softest:g}, the standard deviation of the softest component (spread "
                f"times its s), or a free particle is as stiff as an attached one; got {self.spike}."
            )


def stiffness_prior(config: PriorConfig) -> SpikeAndSlab:
    """Return one particle's prior over s."""
    return SpikeAndSlab.build(
        spike=config.spike,
        components=config.components,
        spread=config.spread,
        dirichlet_strength=config.dirichlet_strength,
        partial=config.partial,
    )


def prior_belief(
    mesh: SheetMesh, *, reference: float, config: PriorConfig | None = None, belief: BeliefConfig | None = None
) -> AttachmentBelief:
    """Return the belief over a sheet's attachments before anything is seen.

    Args:
        mesh: the sheet.
        reference: b_ref, the stiffness of s = 1/2 [N/m].
        config: numbers of the prior; the defaults if None.
        belief: numbers of the belief; the defaults if None.
    """
    config = config or PriorConfig()
    prior = AttachmentPrior.build(
        mesh.n,
        mesh.edges,
        stiffness=stiffness_prior(config),
        probability=config.probability,
        coupling=config.coupling,
        sheet_strength=config.sheet_strength,
    )
    return AttachmentBelief.before(prior, reference=reference, config=belief)
