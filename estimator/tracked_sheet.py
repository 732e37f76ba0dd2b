"""What the estimator builds once the sheet's rest shape is known, and keeps from frame to frame."""

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jiggle_mj.estimate import Sheet
from jiggle_mj.mesh_checks import check_unfolded
from jiggle_mj.observation import Declaration
from jiggle_mj.sheet_triangulation import SheetPlane

from .belief.gaussian_belief import GaussianBelief
from .config import EstimatorConfig, for_clouds
from .filter_builder import build_filter
from .filters.filter import Filter, FilterState
from .filters.force_fit import StiffnessScale
from .filters.posterior_summary import PosteriorSummary
from .perception.mesh_field import MeshField
from .physics.mesh import SheetMesh
from .summaries import refuse_not_finite


@dataclass(kw_only=True)
class TrackedSheet:
    """One sheet with its filter, the filter's state, and the latest positions."""

    sheet: Sheet
    """Rest shape and faces."""
    filter: Filter[Any]
    """The rule of update."""
    field: MeshField
    """Fills unseen particles from their surroundings."""
    prior_entropy: float
    """Entropy of the belief before the first frame [nat]."""
    state: FilterState
    """The filter's state after the latest frame."""
    x: Float[np.ndarray, "n 3"]
    """Positions after the latest frame with closed jaws, at first at rest [m]."""
    open_x: Float[np.ndarray, "n 3"]
    """Positions with open jaws when they were last asked for, at first at rest [m]."""

    @classmethod
    def build(
        cls, sheet: Sheet, declaration: Declaration, config: EstimatorConfig, *, identified: bool
    ) -> "TrackedSheet":
        """Build the filter for a sheet at rest, whose particles measurements identify or not.

        Raises:
            MeshError: the sheet is folded, or not one sheet.
        """
        mesh, plane = unfolded(sheet)
        filter = build_filter(mesh, declaration, config if identified else for_clouds(config))
        state = filter.init(jax.random.key(config.seed))
        return cls(
            sheet=sheet,
            filter=filter,
            field=MeshField(plane.flatten(mesh.rest), mesh.faces),
            prior_entropy=float(state.summary.entropy),
            state=state,
            x=mesh.rest,
            open_x=mesh.rest,
        )

    @property
    def position_variance(self) -> float:
        """The learned factor on the variance of positions [1]."""
        noise = self.filter.noise(self.state)
        return 1.0 if noise is None else noise.position

    @property
    def stiffness_scale(self) -> StiffnessScale | None:
        """The factor that the tool's force puts on all stiffnesses of the present belief; None for 1.

        It is not kept from a refinement on: what later frames show of the attachments shows it as well.
        """
        fit, belief = self.filter.force(self.state), self.state.summary.belief
        if fit is None or isinstance(belief, GaussianBelief):
            return None
        with jax.enable_x64(True):
            return fit.scale(belief)

    def take(self, state: FilterState, summary: PosteriorSummary | None) -> None:
        """Take the state after a refinement.

        Raises:
            PerceptionError: the posterior of the refinement is not finite; the state keeps the belief of before.
        """
        self.state = state
        refuse_not_finite(summary)


def unfolded(sheet: Sheet) -> tuple[SheetMesh, SheetPlane]:
    """Return the mesh of a sheet at rest, and its plane.

    Raises:
        MeshError: the sheet is folded, or not one sheet.
    """
    mesh, plane = SheetMesh(sheet.rest, sheet.faces), SheetPlane.through(sheet.rest)
    check_unfolded(mesh.rest, mesh.faces, above=plane.axes[2])
    return mesh, plane
