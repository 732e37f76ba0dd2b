"""The filter that the settings name, for one sheet."""

from typing import Any

from jiggle_mj.observation import Declaration

from .belief.gaussian_belief import GaussianBelief
from .belief.prior import prior_belief
from .config import EstimatorConfig
from .filters.adam import RATE, AdamShooting
from .filters.explicit import PRIOR_MEAN, MultipleShooting
from .filters.filter import Filter
from .filters.force_balance import ForceBalance
from .filters.implicit import ImplicitFilter
from .filters.nnls import NonNegativeLeastSquares
from .filters.unscented import ReducedUnscented
from .physics.energy import SheetEnergy
from .physics.mesh import SheetMesh
from .physics.simulator import simulator
from .physics.surrogate import surrogate

FORCE_LEVEL = 0.07
"""Sum of the forces that meet at a particle for which `EstimatorConfig.force_sd` is the model's force error
[k x spacing]; the default error is 0.064 of it."""
TOLERANCE = 1 / 4
"""Residual force at which the unscented filter's equilibria are found [standard deviation of the force error]."""


def build_filter(
    mesh: SheetMesh, declaration: Declaration, config: EstimatorConfig, *, energy: SheetEnergy | None = None
) -> Filter[Any]:
    """Return the filter that `config.filter` names, with its prior.

    Args:
        mesh: the sheet.
        declaration: stiffnesses in the settings are shares of its membrane stiffness k.
        config: the settings.
        energy: of the sheet, where it is not what is declared without effects.
    """
    k = declaration.membrane_stiffness
    energy = surrogate(mesh, declaration, membrane=config.membrane) if energy is None else energy
    if config.filter == "implicit":
        balance = force_balance(mesh, energy, declaration, config)
        prior = prior_belief(mesh, reference=float(balance.reference), config=config.prior, belief=config.belief)
        return ImplicitFilter(declared_balance=balance, prior=prior, sampling=config.sampling)
    prior_sd, grip_stiffness = config.prior_sd * k, config.grip_stiffness * k
    mean = PRIOR_MEAN if config.filter == "explicit" else 0.0
    prior = GaussianBelief.prior(mesh.n, mean=mean, sd=prior_sd)
    if config.filter == "explicit":
        return MultipleShooting(
            prior=prior,
            prior_sd=prior_sd,
            simulator=simulator(mesh, declaration),
            grip_stiffness=grip_stiffness,
            samples=config.samples,
        )
    if config.filter == "adam":
        return AdamShooting(
            prior=prior,
            prior_sd=prior_sd,
            simulator=simulator(mesh, declaration),
            grip_stiffness=grip_stiffness,
            samples=config.samples,
            rate=RATE * k,
        )
    force_sd = config.force_sd * k * mesh.spacing
    if config.filter == "nnls":
        return NonNegativeLeastSquares.build(energy, prior=prior, prior_sd=prior_sd, force_sd=force_sd)
    return ReducedUnscented.build(
        mesh,
        energy,
        prior=prior,
        prior_sd=prior_sd,
        grip_stiffness=grip_stiffness,
        force_tolerance=TOLERANCE * force_sd,
    )


def force_balance(
    mesh: SheetMesh, energy: SheetEnergy, declaration: Declaration, config: EstimatorConfig
) -> ForceBalance:
    """Return the balance of forces of a declared sheet, with an energy for its mesh."""
    k = declaration.membrane_stiffness
    return ForceBalance.build(
        mesh,
        energy,
        reference=config.reference * k,
        force_sd=config.force_sd * k * mesh.spacing,
        force_level=FORCE_LEVEL * k * mesh.spacing,
        anchor_sd=config.anchor_sd,
        grip_stiffness=config.grip_stiffness * k,
        config=config.linearisation,
    )
