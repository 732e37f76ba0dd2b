"""jiggle-mj: where a thin tissue is attached, how strongly and how surely, from pulls seen by a stereo camera.

The public names. Each is fetched from its home when it is first used (PEP 562), so `import jiggle_mj` loads neither
JAX, MuJoCo nor OpenCV. Truth is not among them: only `jiggle_mj.eval` reads it.
"""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jiggle_mj.camera import CameraCalibration as CameraCalibration
    from jiggle_mj.camera import StereoCamera as StereoCamera
    from jiggle_mj.errors import ActionError as ActionError
    from jiggle_mj.errors import ClusterError as ClusterError
    from jiggle_mj.errors import JiggleError as JiggleError
    from jiggle_mj.errors import MeshError as MeshError
    from jiggle_mj.errors import OptionError as OptionError
    from jiggle_mj.errors import OutputError as OutputError
    from jiggle_mj.errors import PerceptionError as PerceptionError
    from jiggle_mj.errors import RecordingError as RecordingError
    from jiggle_mj.errors import RenderError as RenderError
    from jiggle_mj.errors import SceneError as SceneError
    from jiggle_mj.errors import SimulationError as SimulationError
    from jiggle_mj.estimate import Belief as Belief
    from jiggle_mj.estimate import Detection as Detection
    from jiggle_mj.estimate import Estimate as Estimate
    from jiggle_mj.estimate import Sheet as Sheet
    from jiggle_mj.estimator import Estimator as Estimator
    from jiggle_mj.estimator import EstimatorConfig as EstimatorConfig
    from jiggle_mj.eval.closing_the_loop import close_loop as close_loop
    from jiggle_mj.eval.experiment import run_estimator as run_estimator
    from jiggle_mj.eval.experiment import run_scene as run_scene
    from jiggle_mj.eval.score import score as score
    from jiggle_mj.importing import import_folder as import_folder
    from jiggle_mj.material import Material as Material
    from jiggle_mj.observation import Action as Action
    from jiggle_mj.observation import Cut as Cut
    from jiggle_mj.observation import Declaration as Declaration
    from jiggle_mj.observation import DeclaredMesh as DeclaredMesh
    from jiggle_mj.observation import Grasp as Grasp
    from jiggle_mj.observation import MeasuredPoints as MeasuredPoints
    from jiggle_mj.observation import Move as Move
    from jiggle_mj.observation import Observation as Observation
    from jiggle_mj.observation import Release as Release
    from jiggle_mj.observation import StereoPair as StereoPair
    from jiggle_mj.observation import Suture as Suture
    from jiggle_mj.observation import ToolState as ToolState
    from jiggle_mj.observation import Wait as Wait
    from jiggle_mj.recording import Recording as Recording
    from jiggle_mj.recording import RecordingWriter as RecordingWriter
    from jiggle_mj.recording_series import RecordingSeries as RecordingSeries
    from jiggle_mj.recording_series import record_series as record_series
    from jiggle_mj.scenes import Reference as Reference
    from jiggle_mj.scenes import Scene as Scene
    from jiggle_mj.scenes import load_scene as load_scene
    from jiggle_mj.scenes import programme as programme
    from jiggle_mj.scenes import shipped_scenes as shipped_scenes
    from jiggle_mj.worker_processes import WorkerProcesses as WorkerProcesses

    __version__: str

__all__ = [
    "Action",
    "ActionError",
    "Belief",
    "CameraCalibration",
    "ClusterError",
    "Cut",
    "Declaration",
    "DeclaredMesh",
    "Detection",
    "Estimate",
    "Estimator",
    "EstimatorConfig",
    "Grasp",
    "JiggleError",
    "Material",
    "MeasuredPoints",
    "MeshError",
    "Move",
    "Observation",
    "OptionError",
    "OutputError",
    "PerceptionError",
    "Recording",
    "RecordingError",
    "RecordingSeries",
    "RecordingWriter",
    "Reference",
    "Release",
    "RenderError",
    "Scene",
    "SceneError",
    "Sheet",
    "SimulationError",
    "StereoCamera",
    "StereoPair",
    "Suture",
    "ToolState",
    "Wait",
    "WorkerProcesses",
    "__version__",
    "close_loop",
    "import_folder",
    "load_scene",
    "programme",
    "record_series",
    "run_estimator",
    "run_scene",
    "score",
    "shipped_scenes",
]

_NAMES_OF = {
    "camera": ("CameraCalibration", "StereoCamera"),
    "errors": (
        "ActionError",
        "ClusterError",
        "JiggleError",
        "MeshError",
        "OptionError",
        "OutputError",
        "PerceptionError",
        "RecordingError",
        "RenderError",
        "SceneError",
        "SimulationError",
    ),
    "estimate": ("Belief", "Detection", "Estimate", "Sheet"),
    "estimator": ("Estimator", "EstimatorConfig"),
    "eval.closing_the_loop": ("close_loop",),
    "eval.experiment": ("run_estimator", "run_scene"),
    "eval.score": ("score",),
    "importing": ("import_folder",),
    "material": ("Material",),
    "observation": (
        "Action",
        "Cut",
        "Declaration",
        "DeclaredMesh",
        "Grasp",
        "MeasuredPoints",
        "Move",
        "Observation",
        "Release",
        "StereoPair",
        "Suture",
        "ToolState",
        "Wait",
    ),
    "recording": ("Recording", "RecordingWriter"),
    "recording_series": ("RecordingSeries", "record_series"),
    "scenes": ("Reference", "Scene", "load_scene", "programme", "shipped_scenes"),
    "worker_processes": ("WorkerProcesses",),
}
_HOME = {name: f"{__name__}.{module}" for module, names in _NAMES_OF.items() for name in names}


def __getattr__(name: str) -> object:
    """Fetch a public name from its home, once.

    Raises:
        AttributeError: no such name.
    """
    if name == "__version__":
        found: object = version("jiggle-mj")
    elif name in _HOME:
        found = getattr(import_module(_HOME[name]), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """Also what has not been fetched yet."""
    return sorted({*globals(), *__all__})
