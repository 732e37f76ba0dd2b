"""What is seen and reported of a simulation: images or points, and the tool's pose, each with what is wrong with it.

What is wrong is in `Faults`; a scene's sensing disturbances change it when their time has come. The calibration that
goes with the images never changes: it is what the user believes.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from jiggle_mj.errors import SceneError
from jiggle_mj.observation import MeasuredPoints, StereoPair, ToolReport
from jiggle_mj.options import Sensing

from ..scene.disturbance import SensingDisturbance
from ..tissue.cameras import place_cameras, stereo_camera
from ..tissue.history import DelayedState
from ..tissue.simulation import Simulation
from . import points as sense
from .stereo import StereoRenderer

Image = UInt8[np.ndarray, "height width 3"]
View = tuple[StereoPair | None, MeasuredPoints | None]
"""Images, measured points."""


@dataclass
class Faults:
    """What is wrong with the senses; nothing at first."""

    tool_offset: Float[np.ndarray, " 3"] = field(default_factory=lambda: np.zeros(3))
    """Reported minus true tip [m]."""
    tool_scale: float = 1.0
    """Reported over true way since the jaws closed."""
    tool_turn: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    """From the true to the reported way."""
    tool_delay: float = 0.0
    """Age of the reported tip [s]."""
    image_delay: float = 0.0
    """Age of what is seen [s]."""
    rig: list[Callable[[float], Float[np.ndarray, "4 4"]]] = field(default_factory=list)
    """Of a time [s]: true pose of the pair in the optical frame where it is believed to be."""
    depth_scale: float = 1.0
    """Measured over true distance from the camera, sideways ones alike: believed over true baseline."""
    slip: Float[np.ndarray, " 2"] = field(default_factory=lambda: np.zeros(2))
    """How fast tracked points slide over the sheet [m/s]."""
    lost: float = 0.0
    """Share of frames that never come."""
    repeated: float = 0.0
    """Share of frames that show what the one before showed."""
    images: list[Callable[[StereoPair, np.random.Generator], StereoPair]] = field(default_factory=list)
    """What happens to rendered images, one after the other."""


REPORTED = 0.04
"""From one of the tool's reports to the next [s]."""


class Observer:
    """The senses of one run.

    Raises:
        RenderError: `sensing="stereo"` and no offscreen OpenGL.
        SceneError: a disturbance of a kind of sensing that there is not.
    """

    def __init__(self, simulation: Simulation, *, sensing: Sensing, rng: np.random.Generator) -> None:
        self.simulation, self.sensing, self.faults = simulation, sensing, Faults()
        scene, sheet = simulation.scene, simulation.tissue.sheet
        self._rng = rng
        self._tracks = {
            "particles": lambda: sense.vertex_tracks(sheet, rng=rng),
            "points": lambda: sense.material_tracks(sheet, n_points=scene.sensing.n_points, rng=rng),
            "stereo": lambda: None,
            "cloud": lambda: None,
        }[sensing]()
        settings = scene.sensing
        self._smooth = (
            sense.smooth_factor(sheet, sd=settings.smooth_sd, length=settings.smooth_length)
            if settings.smooth_sd and sensing != "stereo"
            else None
        )
        self.camera = stereo_camera(scene.camera)
        """As it is believed to be."""
        self._renderer = None
        if sensing == "stereo":
            self._renderer = StereoRenderer(simulation.model, scene.camera, gloss=scene.lights.specular)
        self._history: DelayedState | None = None
        self._coming: list[SensingDisturbance] = []
        for place, one in enumerate(scene.disturbances):
            if isinstance(one, SensingDisturbance):
                if one.needs and sensing not in one.needs:
                    which = f"disturbances[{place}]" if scene.secret else f"the disturbance {one.kind()}"
                    raise SceneError(
                        f"{which} needs sensing = {' or '.join(map(repr, one.needs))}; this is {sensing!r}."
                    )
                self._coming.append(one)
        self._coming.sort(key=lambda one: one.start)
        self._slid = np.zeros(2)
        self._seen_at = 0.0
        self._closed_at = simulation.jaws.tip
        self._last: View | None = None
        self._reports: list[ToolReport] = []
        self._reported_at = simulation.data.time
        simulation.rules.append(self._report)

    def remember(self, longest: float) -> None:
        """Keep the past, as far back as `longest` [s]."""
        simulation = self.simulation
        self._history = DelayedState(simulation.model, simulation.data, longest=longest)
        simulation.rules.insert(0, self._history.record)  # before the tool reports

    def redraw(self) -> None:
        """Show a changed texture: it lies in the graphics memory."""
        if self._renderer is not None:
            gloss = self._renderer.gloss
            self._renderer.close()
            self._renderer = StereoRenderer(self.simulation.model, self.simulation.scene.camera, gloss=gloss)

    def gloss(self, strength: float) -> None:
        """Let the lamp be reflected, from 0 (not at all) to 1."""
        if self._renderer is not None:
            self._renderer.gloss = strength

    def jaws_closed(self) -> None:
        """Note where the tool is, from where its way is counted; it came there some time before it closed."""
        self._closed_at = self.simulation.jaws.tip
        if self._history is not None:
            self._history.tool_stood()

    def tip(self) -> Float[np.ndarray, " 3"]:
        """Where the robot says that the tip is [m]."""
        faults = self.faults
        late = self._history is not None and faults.tool_delay > 0
        true = self._history.tip_before(faults.tool_delay) if late and self._history else self.simulation.jaws.tip
        way = faults.tool_scale * faults.tool_turn @ (true - self._closed_at)
        return self._closed_at + way + faults.tool_offset

    def reports(self) -> tuple[ToolReport, ...]:
        """What the tool has said since this was last asked, now left out."""
        now = round(self.simulation.data.time * 1e9)
        told, self._reports = tuple(one for one in self._reports if one.time < now), []
        return told

    def _report(self) -> None:
        now = self.simulation.data.time
        if now > self._reported_at + REPORTED - self.simulation.model.opt.timestep / 2:
            self._reports.append(ToolReport(time=round(now * 1e9), position=self.tip()))
            self._reported_at = now

    def look(self) -> View | None:
        """What is seen now; None where the frame was lost."""
        now = self.simulation.data.time
        while self._coming and self._coming[0].start <= now:
            self._coming.pop(0).begin(self)
        self._slid = self._slid + (now - self._seen_at) * self.faults.slip
        self._seen_at = now
        if self.faults.lost and self._rng.random() < self.faults.lost:
            return None
        if self.faults.repeated and self._rng.random() < self.faults.repeated and self._last is not None:
            return self._last
        late = self._history is not None and self.faults.image_delay > 0
        data = self._history.before(self.faults.image_delay) if late and self._history else self.simulation.data
        self._last = (self._images(data), self._points(data))
        return self._last

    def close(self) -> None:
        """Free the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _rig(self) -> Float[np.ndarray, "4 4"]:
        """True pose of the left camera in the world when it saw what is shown."""
        T = self.camera.T_world_camera
        for moved in self.faults.rig:
            T = T @ moved(self.simulation.data.time - self.faults.image_delay)
        return T

    def _images(self, data: mujoco.MjData) -> StereoPair | None:
        if self._renderer is None:
            return None
        faults, model = self.faults, self.simulation.model
        if faults.rig or faults.depth_scale != 1:
            place_cameras(model, self._rig(), baseline=self.camera.baseline / faults.depth_scale)
            mujoco.mj_camlight(model, data)
        pair = self._renderer.render(data)
        for change in faults.images:
            pair = change(pair, self._rng)
        return sense.add_image_noise(pair, sd=self.simulation.scene.sensing.image_sd, rng=self._rng)

    def _points(self, data: mujoco.MjData) -> MeasuredPoints | None:
        settings, sheet = self.simulation.scene.sensing, self.simulation.tissue.sheet
        tracks, cloud = self._tracks, self.sensing == "cloud"
        if cloud:
            tracks = sense.surface_points(sheet, n_points=settings.cloud_points, rng=self._rng)
        if tracks is None:
            return None
        if self._slid.any():
            tracks = sense.slid(tracks, sheet, self._slid)
        positions = self._misplaced(tracks.positions(self.simulation.surface(data)))
        smooth = None
        if self._smooth is not None:
            smooth = tracks.positions(self._smooth @ self._rng.standard_normal((len(self._smooth), 3)))
        return sense.measure(
            positions,
            sd=settings.point_sd,
            rng=self._rng,
            tracked=not cloud,
            smooth=smooth,
            smooth_sd=settings.smooth_sd,
        )

    def _misplaced(self, points: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
        """Where the wrongly placed pair finds points [m]."""
        if not self.faults.rig and self.faults.depth_scale == 1:
            return points
        believed, T = self.camera.T_world_camera, np.linalg.inv(self._rig())
        seen = self.faults.depth_scale * (points @ T[:3, :3].T + T[:3, 3])
        return seen @ believed[:3, :3].T + believed[:3, 3]
