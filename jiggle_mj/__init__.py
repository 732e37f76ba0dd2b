"""jiggle-mj: where a thin tissue is attached, how strongly and how surely, from pulls seen by a stereo camera.

Defines the public names. Each is imported from its module when it is first used (PEP 562), so `import jiggle_mj` loads
neither JAX, MuJoCo nor OpenCV. Truth is not among them: only `jiggle_mj.eval` reads it.
"""

from importlib import import_module

TYPE_CHECKING = False  # as in typing, whose import takes longer than all else of this file

if TYPE_CHECKING:
    from jiggle_mj.estimator import Estimator as Estimator
    from jiggle_mj.estimator import EstimatorConfig as EstimatorConfig
    from jiggle_mj.eval.metrics.result import score as score
    from jiggle_mj.eval.runs.closing_many import close_loops as close_loops
    from jiggle_mj.eval.runs.closing_the_loop import close_loop as close_loop
    from jiggle_mj.eval.runs.experiment import run_estimator as run_estimator
    from jiggle_mj.eval.runs.experiment import run_scene as run_scene
    from jiggle_mj.scenes import Reference as Reference
    from jiggle_mj.scenes import Scene as Scene
    from jiggle_mj.scenes import load_scene as load_scene
    from jiggle_mj.scenes import programme as programme
    from jiggle_mj.scenes import shipped_scenes as shipped_scenes

    from .actions import Action as Action
    from .actions import Cut as Cut
    from .actions import Grasp as Grasp
    from .actions import Move as Move
    from .actions import Release as Release
    from .actions import Suture as Suture
    from .actions import Wait as Wait
    from .camera import CameraCalibration as CameraCalibration
    from .camera import StereoCamera as StereoCamera
    from .errors import ActionError as ActionError
    from .errors import ClusterError as ClusterError
    from .errors import JiggleError as JiggleError
    from .errors import MeshError as MeshError
    from .errors import ObservationError as ObservationError
    from .errors import OptionError as OptionError
    from .errors import OutputError as OutputError
    from .errors import PerceptionError as PerceptionError
    from .errors import RecordingError as RecordingError
    from .errors import RenderError as RenderError
    from .errors import SceneError as SceneError
    from .errors import SimulationError as SimulationError
    from .estimate import Belief as Belief
    from .estimate import Detection as Detection
    from .estimate import Estimate as Estimate
    from .estimate import Sheet as Sheet
    from .importing.folder import import_folder as import_folder
    from .material import Material as Material
    from .observation import Declaration as Declaration
    from .observation import DeclaredMesh as DeclaredMesh
    from .observation import MeasuredForce as MeasuredForce
    from .observation import MeasuredPoints as MeasuredPoints
    from .observation import Observation as Observation
    from .observation import StereoPair as StereoPair
    from .observation import ToolState as ToolState
    from .plausibility.problem import RecordingProblem as RecordingProblem
    from .plausibility.problems import problems as problems
    from .plausibility.survey import Survey as Survey
    from .plausibility.survey import survey as survey
    from .recording.declaration_file import read_declaration as read_declaration
    from .recording.reader import Recording as Recording
    from .recording.writer import RecordingWriter as RecordingWriter
    from .series import RecordingSeries as RecordingSeries
    from .series import record_series as record_series
    from .worker_processes import WorkerProcesses as WorkerProcesses

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
    "MeasuredForce",
    "MeasuredPoints",
    "MeshError",
    "Move",
    "Observation",
    "ObservationError",
    "OptionError",
    "OutputError",
    "PerceptionError",
    "Recording",
    "RecordingError",
    "RecordingProblem",
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
    "Survey",
    "Suture",
    "ToolState",
    "Wait",
    "WorkerProcesses",
    "__version__",
    "close_loop",
    "close_loops",
    "import_folder",
    "load_scene",
    "problems",
    "programme",
    "read_declaration",
    "record_series",
    "run_estimator",
    "run_scene",
    "score",
    "shipped_scenes",
    "survey",
]

_NAMES_OF_MODULE = {
    "actions": ("Action", "Cut", "Grasp", "Move", "Release", "Suture", "Wait"),
    "camera": ("CameraCalibration", "StereoCamera"),
    "errors": (
        "ActionError",
        "ClusterError",
        "JiggleError",
        "MeshError",
        "ObservationError",
        "OptionError",
        "OutputError",
        "PerceptionError",
        "RecordingError",
        "RecordingProblem",
        "RenderError",
        "SceneError",
        "SimulationError",
    ),
    "estimate": ("Belief", "Detection", "Estimate", "Sheet"),
    "estimator": ("Estimator", "EstimatorConfig"),
    "eval.runs.closing_many": ("close_loops",),
    "eval.runs.closing_the_loop": ("close_loop",),
    "eval.runs.experiment": ("run_estimator", "run_scene"),
    "eval.metrics.result": ("score",),
    "importing.folder": ("import_folder",),
    "material": ("Material",),
    "observation": (
        "Declaration",
        "DeclaredMesh",
        "MeasuredForce",
        "MeasuredPoints",
        "Observation",
        "StereoPair",
        "ToolState",
    ),
    "plausibility.problem": ("RecordingProblem",),
    "plausibility.problems": ("problems",),
    "plausibility.survey": ("Survey", "survey"),
    "recording.declaration_file": ("read_declaration",),
    "recording.reader": ("Recording",),
    "recording.writer": ("RecordingWriter",),
    "series": ("RecordingSeries", "record_series"),
    "scenes": ("Reference", "Scene", "load_scene", "programme", "shipped_scenes"),
    "worker_processes": ("WorkerProcesses",),
}
_MODULE_OF_NAME = {name: f"{__name__}.{module}" for module, names in _NAMES_OF_MODULE.items() for name in names}


def __getattr__(name: str) -> object:
    """Import a public name from its module, once.

    Raises:
        AttributeError: no such name.
    """
    if name == "__version__":
        from importlib.metadata import version  # here, as it takes longer to import than all else of this file

        value: object = version("jiggle-mj")
    elif name in _MODULE_OF_NAME:
        value = getattr(import_module(_MODULE_OF_NAME[name]), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return all names, those that are not imported yet included."""
    return sorted({*globals(), *__all__})
