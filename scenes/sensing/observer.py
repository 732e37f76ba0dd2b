"""Observation of a simulation: images or points, and the tool's pose, each with its faults.

`Faults` holds what is wrong with the sensing; a scene's sensing disturbances change it when they begin. The calibration
that goes with the images never changes: it is what the user believes.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from jiggle_mj.errors import SceneError
from jiggle_mj.observation import MeasuredForce, MeasuredPoints, StereoPair, ToolReport
from jiggle_mj.options import Sensing

from ..scene.disturbance import SensingDisturbance
from ..tissue.cameras import place_cameras, stereo_camera
from ..tissue.delayed_state import DelayedState
from ..tissue.simulation import Simulation
from . import points as point_sensing
from .stereo import StereoRenderer

Image = UInt8[np.ndarray, "height width 3"]
"""RGB image."""
View = tuple[StereoPair | None, MeasuredPoints | None]
"""Images and measured points; None for what this kind of sensing does not have."""


REPORT_PERIOD = 0.04
"""Time between two of the tool's reports [s]."""


@dataclass
class Faults:
    """What is wrong with the sensing; nothing at first."""

    tool_offset: Float[np.ndarray, " 3"] = field(default_factory=lambda: np.zeros(3))
    """Reported minus true tip [m]."""
    tool_scale: float = 1.0
    """Reported over true displacement of the tip since the jaws closed."""
    tool_rotation: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    """Rotation from the true to the reported displacement since the jaws closed."""
    tool_delay: float = 0.0
    """Age of the reported tip [s]."""
    image_delay: float = 0.0
    """Age of images and points [s]."""
    camera_motions: list[Callable[[float], Float[np.ndarray, "4 4"]]] = field(default_factory=list)
    """Functions of time [s] that return the true pose of the camera pair in its believed optical frame."""
    depth_scale: float = 1.0
    """Measured over true distance from the camera in all directions, which is believed over true baseline."""
    track_velocity: Float[np.ndarray, " 2"] = field(default_factory=lambda: np.zeros(2))
    """Velocity of the tracked points relative to the sheet [m/s]."""
    drop_probability: float = 0.0
    """Share of frames that are lost."""
    repeat_probability: float = 0.0
    """Share of frames that show the frame before again."""
    image_effects: list[Callable[[StereoPair, np.random.Generator], StereoPair]] = field(default_factory=list)
    """Changes of the rendered images, applied in this order."""


class Observer:
    """The camera, the tracker and the tool's reports of one run.

    Raises:
        RenderError: `sensing="stereo"`, and this machine has no offscreen OpenGL.
        SceneError: a disturbance needs another kind of sensing.
    """

    def __init__(self, simulation: Simulation, *, sensing: Sensing, rng: np.random.Generator) -> None:
        self.simulation, self.sensing, self.faults = simulation, sensing, Faults()
        scene, sheet = simulation.scene, simulation.tissue.sheet
        self._rng = rng
        self.tracks = {
            "particles": lambda: point_sensing.vertex_tracks(sheet, rng=rng),
            "points": lambda: point_sensing.material_tracks(sheet, n_points=scene.sensing.n_points, rng=rng),
            "stereo": lambda: None,
            "cloud": lambda: None,
        }[sensing]()
        """Material points that are tracked; None with `stereo` and `cloud`."""
        settings = scene.sensing
        self._smooth = (
            point_sensing.smooth_factor(sheet, sd=settings.smooth_sd, length=settings.smooth_length)
            if settings.smooth_sd and sensing != "stereo"
            else None
        )
        self.camera = stereo_camera(scene.camera)
        """Calibration that the user believes."""
        self._renderer = None
        if sensing == "stereo":
            self._renderer = StereoRenderer(simulation.model, scene.camera, gloss=scene.lights.specular)
        self._history: DelayedState | None = None
        self._pending: list[SensingDisturbance] = []
        for index, disturbance in enumerate(scene.disturbances):
            if isinstance(disturbance, SensingDisturbance):
                if disturbance.needs and sensing not in disturbance.needs:
                    which = f"disturbances[{index}]" if scene.secret else f"the disturbance {disturbance.kind()}"
                    raise SceneError(
                        f"{which} needs sensing = {' or '.join(map(repr, disturbance.needs))}; this is {sensing!r}."
                    )
                self._pending.append(disturbance)
        self._pending.sort(key=lambda disturbance: disturbance.start)
        self._track_displacement = np.zeros(2)
        self._last_view_time = 0.0
        self._closed_at = simulation.jaws.tip
        self._last_view: View | None = None
        self._reports: list[ToolReport] = []
        self._last_report_time = simulation.data.time
        simulation.step_hooks.append(self._report)

    def keep_history(self, longest: float) -> None:
        """Keep past states for delays of up to `longest` [s]."""
        simulation = self.simulation
        self._history = DelayedState(simulation.model, simulation.data, longest=longest)
        simulation.step_hooks.insert(0, self._history.record)  # before the tool reports

    def redraw(self) -> None:
        """Load a changed texture into the graphics memory."""
        if self._renderer is not None:
            gloss = self._renderer.gloss
            self._renderer.close()
            self._renderer = StereoRenderer(self.simulation.model, self.simulation.scene.camera, gloss=gloss)

    def set_gloss(self, strength: float) -> None:
        """Set the strength of the lamp's highlights, from 0 (none) to 1."""
        if self._renderer is not None:
            self._renderer.gloss = strength

    def jaws_closed(self) -> None:
        """Take the tool's position as the start of its displacement; a delayed report also places it there already."""
        self._closed_at = self.simulation.jaws.tip
        if self._history is not None:
            self._history.set_tool_at_rest()

    def reported_tip(self) -> Float[np.ndarray, " 3"]:
        """Return the position of the tip as the robot reports it [m]."""
        faults = self.faults
        late = self._history is not None and faults.tool_delay > 0
        true = self._history.tip_before(faults.tool_delay) if late and self._history else self.simulation.jaws.tip
        displacement = faults.tool_scale * faults.tool_rotation @ (true - self._closed_at)
        return self._closed_at + displacement + faults.tool_offset

    def reports(self) -> tuple[ToolReport, ...]:
        """Return the tool's reports since the last call, except one of this instant, and forget them."""
        now = round(self.simulation.data.time * 1e9)
        reports, self._reports = tuple(report for report in self._reports if report.time < now), []
        return reports

    def force(self) -> MeasuredForce | None:
        """Return the force on the tool as its sensor measures it; None where the scene has no sensor."""
        sd = self.simulation.scene.sensing.force_sd
        if not sd:
            return None
        on_tool = -self.simulation.jaws.pull.sum(axis=0)
        return MeasuredForce(on_tool=on_tool + sd * self._rng.standard_normal(3), sd=sd)

    def _report(self) -> None:
        now = self.simulation.data.time
        if now > self._last_report_time + REPORT_PERIOD - self.simulation.model.opt.timestep / 2:
            self._reports.append(ToolReport(time=round(now * 1e9), position=self.reported_tip()))
            self._last_report_time = now

    def look(self) -> View | None:
        """Return what is observed now, after the disturbances that are due have begun; None if the frame is lost."""
        now = self.simulation.data.time
        while self._pending and self._pending[0].start <= now:
            self._pending.pop(0).begin(self)
        elapsed, self._last_view_time = now - self._last_view_time, now
        self._track_displacement = self._track_displacement + elapsed * self.faults.track_velocity
        if self.faults.drop_probability and self._rng.random() < self.faults.drop_probability:
            return None
        repeats = self.faults.repeat_probability and self._rng.random() < self.faults.repeat_probability
        if repeats and self._last_view is not None:
            return self._last_view
        late = self._history is not None and self.faults.image_delay > 0
        data = self._history.before(self.faults.image_delay) if late and self._history else self.simulation.data
        self._last_view = (self._images(data), self._points(data))
        return self._last_view

    def close(self) -> None:
        """Free the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _true_camera_pose(self) -> Float[np.ndarray, "4 4"]:
        """Return the true pose of the left camera in the world at the time of exposure."""
        T = self.camera.T_world_camera
        for motion in self.faults.camera_motions:
            T = T @ motion(self.simulation.data.time - self.faults.image_delay)
        return T

    def _images(self, data: mujoco.MjData) -> StereoPair | None:
        if self._renderer is None:
            return None
        faults, model = self.faults, self.simulation.model
        if faults.camera_motions or faults.depth_scale != 1:
            place_cameras(model, self._true_camera_pose(), baseline=self.camera.baseline / faults.depth_scale)
            mujoco.mj_camlight(model, data)
        pair = self._renderer.render(data)
        for effect in faults.image_effects:
            pair = effect(pair, self._rng)
        return point_sensing.add_image_noise(pair, sd=self.simulation.scene.sensing.image_sd, rng=self._rng)

    def _points(self, data: mujoco.MjData) -> MeasuredPoints | None:
        settings, sheet = self.simulation.scene.sensing, self.simulation.tissue.sheet
        tracks, cloud = self.tracks, self.sensing == "cloud"
        if cloud:
            tracks = point_sensing.surface_points(sheet, n_points=settings.cloud_points, rng=self._rng)
        if tracks is None:
            return None
        if self._track_displacement.any():
            tracks = point_sensing.slide(tracks, sheet, self._track_displacement)
        positions = self._misplaced(tracks.positions(self.simulation.surface(data)))
        smooth = None
        if self._smooth is not None:
            smooth = tracks.positions(self._smooth @ self._rng.standard_normal((len(self._smooth), 3)))
        return point_sensing.add_point_noise(
            positions,
            sd=settings.point_sd,
            rng=self._rng,
            tracked=not cloud,
            smooth=smooth,
            smooth_sd=settings.smooth_sd,
            smooth_length=settings.smooth_length,
        )

    def _misplaced(self, points: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
        """Return points as a camera pair with a wrong pose or baseline measures them [m]."""
        if not self.faults.camera_motions and self.faults.depth_scale == 1:
            return points
        believed, T = self.camera.T_world_camera, np.linalg.inv(self._true_camera_pose())
        seen = self.faults.depth_scale * (points @ T[:3, :3].T + T[:3, 3])
        return seen @ believed[:3, :3].T + believed[:3, 3]
