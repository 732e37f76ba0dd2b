"""What the estimator builds once the sheet's rest shape is known, and keeps from frame to frame."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jiggle_mj.estimate import Sheet
from jiggle_mj.mesh_checks import check_unfolded
from jiggle_mj.observation import Declaration, Observation, ToolState
from jiggle_mj.sheet_triangulation import SheetPlane

from .belief.gaussian_belief import GaussianBelief
from .config import EstimatorConfig, for_clouds
from .corrected_frames import CorrectedFrames
from .effects.corrected_model import CorrectedModel
from .filter_builder import build_filter
from .filters.evidence import MeasuredPull
from .filters.filter import Filter, FilterState
from .filters.force_fit import StiffnessScale
from .filters.posterior_summary import PosteriorSummary, Update
from .fusion import FusedFrame, fill_unseen, fuse
from .grip import GripHold, GripTracker
from .perception import Perception
from .perception.mesh_field import MeshField
from .perception.track import Track
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
    grip_sd: float
    """Standard deviation of held particles from where the tip takes them [m]."""
    prior_entropy: float
    """Entropy of the belief before the first frame [nat]."""
    state: FilterState
    """The filter's state after the latest frame."""
    x: Float[np.ndarray, "n 3"]
    """Positions after the latest frame with closed jaws, at first at rest [m]."""
    open_x: Float[np.ndarray, "n 3"]
    """Positions with open jaws when they were last asked for, at first at rest [m]."""
    corrected: CorrectedFrames | None
    """The frames under the declared effects; None where none is declared."""
    declared_scale: StiffnessScale | None = None
    """The factor on all stiffnesses of a declared `force_scale`; None where none is declared."""

    @classmethod
    def seen_by(cls, perception: Perception, declaration: Declaration, config: EstimatorConfig) -> "TrackedSheet":
        """Build the filter for the sheet that perception has found at rest; see `build`."""
        sheet, seen = perception.sheet(), perception
        return cls.build(sheet, declaration, config, identified=seen.identifies, rest_time=seen.rest_time)

    @classmethod
    def build(
        cls, sheet: Sheet, declaration: Declaration, config: EstimatorConfig, *, identified: bool, rest_time: int = 0
    ) -> "TrackedSheet":
        """Build the filter for a sheet at rest, whose particles measurements identify or not.

        Args:
            sheet: at rest.
            declaration: of the tissue.
            config: the settings.
            identified: whether measurements identify particles.
            rest_time: when the sheet was at rest [ns]; declared effects count time from there.

        Raises:
            MeshError: the sheet is folded, or not one sheet.
            OptionError: a declared effect has nothing to act on in this sheet.
        """
        mesh, plane = unfolded(sheet)
        model = CorrectedModel.build(mesh, declaration) if declaration.effects else None
        energy = None if model is None else model.at_rest
        filter = build_filter(mesh, declaration, config if identified else for_clouds(config), energy=energy)
        state = filter.init(jax.random.key(config.seed))
        return cls(
            sheet=sheet,
            filter=filter,
            field=MeshField(plane.flatten(mesh.rest), mesh.faces),
            grip_sd=config.grip_sd,
            prior_entropy=float(state.summary.entropy),
            state=state,
            x=mesh.rest,
            open_x=mesh.rest,
            corrected=None if model is None else CorrectedFrames(model=model, rest_time=rest_time),
            declared_scale=None if model is None else _declared_scale(model),
        )

    def update(
        self,
        observation: Observation,
        track: Track,
        hold: GripHold,
        before: Float[np.ndarray, "n 3"],
        *,
        force: MeasuredPull | None,
    ) -> tuple[FusedFrame, FilterState, Update]:
        """Return a frame as it was fused, the filter's state after it, and the outcome; see `Filter.update`."""

        def fused(track: Track, hold: GripHold, tool: ToolState) -> FusedFrame:
            return fuse(track, hold, tool, before, grip_sd=self.grip_sd, field=self.field, force=force)

        if self.corrected is not None:
            return self.corrected.update(
                self.filter, self.state, observation=observation, track=track, hold=hold, before=before, fuse=fused
            )
        frame = fused(track, hold, observation.tool)
        return frame, *self.filter.update(self.state, frame.evidence, jnp.asarray(frame.start))

    def grasp(
        self, grip: GripTracker, tool: ToolState, track: Track, *, time: int, named: Bool[np.ndarray, " n"] | None
    ) -> tuple[GripHold, Float[np.ndarray, "n 3"]]:
        """Return the grasp of a frame at a time [ns], and the state to start from; see `GripTracker.grasp`."""
        corrected = None if self.corrected is None or grip.hold is not None else self.without_grip(track, time)
        return grip.grasp(tool, state=self.x, rest=self.sheet.rest, track=track, named=named, corrected=corrected)

    def without_grip(self, track: Track, time: int) -> Float[np.ndarray, "n 3"]:
        """Return where the sheet lies [m] that is seen with open or just closed jaws at a time [ns]."""
        seen = fill_unseen(track, self.sheet.rest, self.field)
        return seen if self.corrected is None else self.corrected.without_view(seen, time)

    @property
    def position_variance(self) -> float:
        """The learned factor on the variance of positions [1]."""
        noise = self.filter.noise(self.state)
        return 1.0 if noise is None else noise.position

    @property
    def stiffness_scale(self) -> StiffnessScale | None:
        """The factor on all stiffnesses of the present belief by the tool's force, else as declared; None for 1.

        That of the force is not kept from a refinement on: what later frames show of the attachments shows it as well.
        """
        fit, belief = self.filter.force(self.state), self.state.summary.belief
        if fit is None or isinstance(belief, GaussianBelief):
            return self.declared_scale
        with jax.enable_x64(True):
            return fit.scale(belief) or self.declared_scale

    def take(self, state: FilterState, summary: PosteriorSummary | None) -> None:
        """Take the state after a refinement.

        Raises:
            PerceptionError: the posterior of the refinement is not finite; the state keeps the belief of before.
        """
        self.state = state
        refuse_not_finite(summary)


def _declared_scale(model: CorrectedModel) -> StiffnessScale | None:
    if not model.that_change("force_factor"):
        return None
    return StiffnessScale(factor=model.force_factor, log_sd=0.0, log_with_s=np.zeros(len(model.energy.rest)))


def unfolded(sheet: Sheet) -> tuple[SheetMesh, SheetPlane]:
    """Return the mesh of a sheet at rest, and its plane.

    Raises:
        MeshError: the sheet is folded, or not one sheet.
    """
    mesh, plane = SheetMesh(sheet.rest, sheet.faces), SheetPlane.through(sheet.rest)
    check_unfolded(mesh.rest, mesh.faces, above=plane.axes[2])
    return mesh, plane
