"""Perception of one sheet from whatever a recording has: stereo images, tracked points, or clouds without identities.

It finds the sheet at rest in the frames before the first grasp, and its particles in every later frame.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jiggle_mj.argument_checks import as_function, as_instance
from jiggle_mj.camera import StereoCamera
from jiggle_mj.errors import MaskError, PerceptionError
from jiggle_mj.estimate import PointNoise, Sheet
from jiggle_mj.observation import Declaration, MeasuredPoints, Observation, StereoPair, ToolState

from ..physics.environment import Grip
from ..ranges import refuse_many_particles
from .cloud_mesh import lay_mesh
from .cloud_tracker import CloudTracker
from .config import PerceptionConfig
from .disparity import Disparity
from .point_noise import CombinedNoise
from .point_tracker import MESH_CAUSE, PointTracker
from .stereo_tracker import StereoTracker
from .tissue_mask import FrameMask, TissueMask
from .track import Track

SimulatorInput = tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"], Grip]
"""Arguments of the simulator that matches a cloud: the positions before [m], b [N/m], and the grip after the move."""


class Perception:
    """Perception of one sheet."""

    def __init__(
        self,
        declaration: Declaration,
        camera: StereoCamera | None,
        *,
        spacing: float,
        mask: TissueMask | FrameMask | None,
        disparity: Disparity | None,
        config: PerceptionConfig | None = None,
    ) -> None:
        """Choose the trackers; see `Estimator` for the arguments.

        Args:
            declaration: what the user says of the tissue.
            camera: needed for observations with images.
            spacing: distance between the particles of a mesh laid over images or clouds [m].
            mask: segmentation of tissue; by colour if None.
            disparity: dense stereo; semi-global matching if None.
            config: settings of the trackers; the defaults if None.

        Raises:
            OptionError: an argument is of another type.
        """
        if camera is not None:
            as_instance(camera, "camera", StereoCamera, hint="Recording.camera and Reference.camera are such.")
        if mask is not None and not isinstance(mask, FrameMask):
            as_function(mask, "mask")
        if disparity is not None:
            as_function(disparity, "disparity")
        self._declaration, self._spacing, self._config = declaration, spacing, config or PerceptionConfig()
        self._stereo = (
            None
            if camera is None
            else StereoTracker(camera, spacing=spacing, mask=mask, disparity=disparity, config=self._config.stereo)
        )
        self._points = PointTracker(declaration.mesh, self._config.points)
        self._clouds: CloudTracker | None = None
        self._still: list[MeasuredPoints] = []
        self._still_times: list[int] = []
        self._sheet: Sheet | None = None

    @property
    def ready(self) -> bool:
        """Return whether a frame has shown the sheet."""
        return self._sheet is not None or bool(self._still)

    @property
    def identifies(self) -> bool:
        """Return whether measurements identify the particles; clouds do not."""
        return self._clouds is None

    @property
    def track_ids(self) -> Int[np.ndarray, " n"] | None:
        """Return the track id of each particle; None if points have no identities."""
        return self._points.ids if len(self._points.ids) else None

    def named_held(self, tool: ToolState) -> Bool[np.ndarray, " n"] | None:
        """Return the particles that recording or declaration name as held; only tracked points have names."""
        if (ids := self.track_ids) is None:
            return None
        if tool.held_tracks:
            return np.isin(ids, tool.held_tracks)
        return None if self._declaration.mesh is None else self._declaration.mesh.held

    @property
    def fields(self) -> Float[Array, "n modes"] | None:
        """Return the noise that neighbours share, as `Track.fields` has it; None where none is known."""
        return self._points.fields

    @property
    def noise(self) -> PointNoise | None:
        """Return the noise of measured points, once there is a sheet; None for images."""
        if self._sheet is None or not self._still:
            return None
        combined = self._points.noise
        return (CombinedNoise.of(self._still[0], None) if combined is None else combined).published

    def look_at_rest(self, observation: Observation) -> str | None:
        """Use a frame before the first grasp, and return None, or why it is skipped.

        Of images the first usable pair is used, of points every frame.

        Raises:
            PerceptionError: the frame has no measurement, or shows no sheet while the jaws are closed.
        """
        if observation.images is not None and self._stereo is not None:
            if self._sheet is not None:
                return None
            reason = self._start_stereo(observation.images, observation)
            if reason is None:
                self._still_times = [observation.time]
            return reason
        points = _points(observation)
        if not (observation.tool.closed and self._still):
            self._still.append(points)
            self._still_times.append(observation.time)
        return None

    @property
    def rest_time(self) -> int:
        """Return the time of the rest shape [ns]: the mean over the frames that it is the mean of.

        The time of a declared mesh is that of the first frame.

        Raises:
            PerceptionError: no frame has shown the sheet.
        """
        times = self._still_times
        if not times:
            raise PerceptionError("no frame has shown the sheet yet; call update with one.")
        return times[0] if self._declaration.mesh is not None else sum(times) // len(times)

    def sheet(self) -> Sheet:
        """Return the sheet at rest from the frames so far; from then on it is fixed.

        Raises:
            PerceptionError: the points show no sheet.
            MeshError: the points show two sheets.
        """
        if self._sheet is None:
            self._sheet = self._sheet_of_points()
        return self._sheet

    def track(
        self,
        observation: Observation,
        *,
        predicted: Float[np.ndarray, "n 3"],
        simulator_input: Callable[[], SimulatorInput] | None,
    ) -> Track:
        """Return the measurement of the particles in one frame.

        Args:
            observation: the frame.
            predicted: predicted positions of the particles [m].
            simulator_input: returns the arguments of the simulator that matches clouds, and is called for these alone;
                None where the filter matches them itself.

        Raises:
            PerceptionError: the frame has no usable measurement.
        """
        if observation.images is not None and self._stereo is not None:
            return self._stereo.track(
                observation.images, observation.tool, predicted=predicted, index=observation.index
            )
        points = _points(observation)
        if self._clouds is None:
            return self._points.track(points)
        if simulator_input is None:
            return self._clouds.unmatched(points)
        return self._clouds.simulated(points, *simulator_input())

    def _start_stereo(self, images: StereoPair, observation: Observation) -> str | None:
        """Lay the mesh over a pair, and return None, or why it is skipped.

        With closed jaws no other pair will come, and no other pair removes a doubt about the mask.
        """
        assert self._stereo is not None
        try:
            self._sheet = self._stereo.start(images, observation.tool, index=observation.index)
        except MaskError:
            raise
        except PerceptionError as failure:
            if observation.tool.closed:
                raise
            return str(failure)
        return None

    def _sheet_of_points(self) -> Sheet:
        """Return the sheet at rest of points or clouds, and choose their tracker."""
        if all(points.track_id is not None for points in self._still):
            return self._points.start(self._still)
        declared = self._declaration.mesh
        if declared is None:
            sheet = lay_mesh(self._still, spacing=self._spacing, config=self._config.clouds)
            cause = f"a mesh over the clouds at a spacing of {self._spacing * 1e3:g} mm"
        else:
            sheet, cause = Sheet(rest=declared.vertices, faces=declared.faces), MESH_CAUSE
        refuse_many_particles(len(sheet.rest), cause)
        self._clouds = CloudTracker(sheet, self._declaration, self._still, self._config.clouds)
        return sheet


def _points(observation: Observation) -> MeasuredPoints:
    """Return the points of an observation that must have them."""
    if observation.points is None:
        raise PerceptionError(
            f"observation {observation.index} has neither points nor images with a calibrated camera; one is needed."
        )
    return observation.points
