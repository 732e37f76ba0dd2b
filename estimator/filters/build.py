"""The filter that the settings name, for one sheet, and what it believes beforehand."""

from jiggle_mj.observation import Declaration

from ..belief.attachment_belief import AttachmentBelief
from ..belief.boundary_belief import BoundaryBelief
from ..config import EstimatorConfig
from ..physics.energy import SheetEnergy
from ..physics.mesh import SheetMesh
from ..physics.surrogate import surrogate
from .adam import AdamShooting
from .evidence import Filter
from .explicit import PRIOR_MEAN, MultipleShooting
from .force_balance import ForceBalance
from .implicit import ImplicitFilter, prior_belief
from .nnls import NonNegativeLeastSquares
from .unscented import ReducedUnscented

FORCE_LEVEL = 0.07
"""Forces meeting at a particle, summed, of which the model gets `EstimatorConfig.force_sd` wrong [k x spacing]; its
default is 0.064 of them."""


def build_filter(
    mesh: SheetMesh, declaration: Declaration, config: EstimatorConfig
) -> tuple[Filter, BoundaryBelief | AttachmentBelief]:
    """A filter and its prior; shares in the settings become stiffnesses of the declared membrane."""
    k = declaration.membrane_stiffness
    energy = surrogate(mesh, declaration, membrane=config.membrane)
    if config.filter == "implicit":
        balance = force_balance(mesh, energy, declaration, config)
        return ImplicitFilter(balance), prior_belief(mesh, reference=float(balance.reference))
    mean = PRIOR_MEAN if config.filter == "explicit" else 0.0
    gaussian = BoundaryBelief.prior(mesh.n, mean=mean, sd=config.prior_sd * k)
    if config.filter in ("explicit", "adam"):
        shooting = MultipleShooting if config.filter == "explicit" else AdamShooting
        return shooting(mesh, declaration, grip_stiffness=config.grip_stiffness * k, samples=config.samples), gaussian
    grip_stiffness, force_sd = config.grip_stiffness * k, config.force_sd * k * mesh.spacing
    if config.filter == "nnls":
        return NonNegativeLeastSquares.build(energy, force_sd=force_sd), gaussian
    tolerance = force_sd / 4
    return ReducedUnscented(mesh, energy, grip_stiffness=grip_stiffness, force_tolerance=tolerance), gaussian


def force_balance(
    mesh: SheetMesh, energy: SheetEnergy, declaration: Declaration, config: EstimatorConfig
) -> ForceBalance:
    """The balance of forces of a declared sheet, with an energy for its mesh."""
    k = declaration.membrane_stiffness
    return ForceBalance.build(
        mesh,
        energy,
        reference=config.reference * k,
        force_sd=config.force_sd * k * mesh.spacing,
        force_level=FORCE_LEVEL * k * mesh.spacing,
        anchor_sd=config.anchor_sd,
        grip_stiffness=config.grip_stiffness * k,
    )
