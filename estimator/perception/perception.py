"""What sees the sheet, whichever a recording has: stereo images, tracked points, or clouds without identities.

Finds the sheet at rest in the frames before the first grasp, and its particles in every frame after that.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from jiggle_mj.camera import StereoCamera
from jiggle_mj.errors import PerceptionError
from jiggle_mj.estimate import Sheet
from jiggle_mj.observation import Declaration, MeasuredPoints, Observation, StereoPair, ToolState

from ..physics.environment import Grip
from .cloud_tracker import CloudTracker, lay_mesh
from .disparity import Disparity
from .point_tracker import PointTracker
from .stereo_tracker import StereoTracker
from .tissue_mask import TissueMask
from .track import Track

Believed = tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"], Grip]
"""What meets a cloud: the positions before, b, and the tip's move."""


class Perception:
    """Sees one sheet."""

    def __init__(
        self,
        declaration: Declaration,
        camera: StereoCamera | None,
        *,
        spacing: float,
        mask: TissueMask | None,
        disparity: Disparity | None,
    ) -> None:
        """Say what is known beforehand; see `Estimator`. `spacing` is that of a mesh laid over what is seen [m]."""
        self._declaration, self._spacing = declaration, spacing
        self._stereo = (
            None if camera is None else StereoTracker(camera, spacing=spacing, mask=mask, disparity=disparity)
        )
        self._points = PointTracker(declaration.mesh)
        self._clouds: CloudTracker | None = None
        self._still: list[MeasuredPoints] = []
        self._still_times: list[int] = []
        self._sheet: Sheet | None = None

    @property
    def ready(self) -> bool:
        """Whether a frame has shown the sheet."""
        return self._sheet is not None or bool(self._still)

    @property
    def identifies(self) -> bool:
        """Whether what is seen says which particle is where."""
        return self._clouds is None

    @property
    def track_ids(self) -> Int[np.ndarray, " n"] | None:
        """Which tracked point each particle is; None where they have no names."""
        return self._points.ids if len(self._points.ids) else None

    def look_at_rest(self, observation: Observation) -> str | None:
        """Use a frame before the first grasp: the first image, every frame of points; or say why it is passed over.

        Raises:
            PerceptionError: it shows nothing, or shows no sheet and the jaws are closed.
        """
        if observation.images is not None and self._stereo is not None:
            if self._sheet is not None:
                return None
            passed_over = self._lay_over(observation.images, observation.tool)
            if passed_over is None:
                self._still_times = [observation.time]
            return passed_over
        points = _points(observation)
        if not (observation.tool.closed and self._still):
            self._still.append(points)
            self._still_times.append(observation.time)
        return None

    @property
    def rest_time(self) -> int:
        """When the sheet lay as `sheet` has it [ns]: in the mean of the frames that it is the mean of, or the first.

        A declared mesh is taken to be that of the first frame.
        """
        times = self._still_times
        return times[0] if self._declaration.mesh is not None else sum(times) // len(times)

    def sheet(self) -> Sheet:
        """The sheet at rest by the frames so far, fixed from then on.

        Raises:
            PerceptionError: the points show none.
            MeshError: they show two.
        """
        if self._sheet is None:
            self._sheet = self._sheet_of_points()
        return self._sheet

    def track(
        self, observation: Observation, *, predicted: Float[np.ndarray, "n 3"], believed: Callable[[], Believed]
    ) -> Track:
        """The particles in one frame.

        Args:
            observation: the frame.
            predicted: where they may be [m].
            believed: asked where a cloud has to be met.

        Raises:
            PerceptionError: it shows nothing that can be used.
        """
        if observation.images is not None and self._stereo is not None:
            return self._stereo.track(observation.images, observation.tool, predicted=predicted)
        points = _points(observation)
        return self._points.track(points) if self._clouds is None else self._clouds.track(points, *believed())

    def _lay_over(self, images: StereoPair, tool: ToolState) -> str | None:
        """Lay the mesh over an image; one that cannot be used is passed over while another may come."""
        assert self._stereo is not None
        try:
            self._sheet = self._stereo.start(images, tool)
        except PerceptionError as failure:
            if tool.closed:
                raise
            return str(failure)
        return None

    def _sheet_of_points(self) -> Sheet:
        if all(points.track_id is not None for points in self._still):
            return self._points.start(self._still)
        declared = self._declaration.mesh
        sheet = (
            lay_mesh(self._still, spacing=self._spacing)
            if declared is None
            else Sheet(rest=declared.vertices, faces=declared.faces)
        )
        self._clouds = CloudTracker(sheet, self._declaration)
        return sheet


def _points(observation: Observation) -> MeasuredPoints:
    if observation.points is None:
        raise PerceptionError(
            f"observation {observation.index} has neither points nor images with a calibrated camera; one is needed."
        )
    return observation.points
