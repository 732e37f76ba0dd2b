"""A small valid file for each reader."""

import io
import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from jiggle_mj.actions import Cut, Suture
from jiggle_mj.estimate import Belief, Detection, Estimate, Sheet
from jiggle_mj.eval.metrics.result_file import read_result
from jiggle_mj.observation import Declaration
from jiggle_mj.recording.estimate import EstimateWriter, read_estimate
from jiggle_mj.recording.npz_arrays import read_npz
from jiggle_mj.recording.reader import Recording
from jiggle_mj.recording.truth import read_truth, write_truth
from jiggle_mj.recording.writer import RecordingWriter
from jiggle_mj.scenes.scene_file import load_scene
from tests.support.recordings import camera, declared_mesh, observations, truth

SCENE = """seed = 3
secret = true
[tissue]
size = [0.05, 0.05]
spacing = 5e-3
[[attachments]]
shape = "disc"
centre = [0.005, 0.0]
radius = 0.006
stiffness = 1.0
[[attachments]]
shape = "disc"
centre = [0, 0]
radius = 0.01
stiffness = "weld"
[[disturbances]]
name = "gravity"
magnitude = 0.5
[tweezer]
radius = 6e-3
[programme]
still_frames = 4
points = [[-0.02, -0.02], [0.02, 0.02]]
height = 0.015
[camera]
width = 160
height = 120
[declared]
membrane_stiffness = 20
[limits]
force = 0.01
"""
"""A valid scene file."""


@dataclass(frozen=True, kw_only=True)
class Reader:
    """A reader, the file that it reads, and a valid content of it."""

    path: Path
    read: Callable[[], object]
    valid: bytes = field(repr=False)

    @property
    def is_mcap(self) -> bool:
        return self.path.suffix == ".mcap"


def recording_reader(folder: Path) -> Reader:
    """Return the reader of recordings: images, points, a declared mesh, a cut and a suture."""
    path = folder / "recording.mcap"
    region = {"path": np.array([[0.0, 0.01], [0.02, 0.01]]), "width": 0.004}
    seen = observations(3)
    seen[1] = replace(seen[1], events=(Cut(**region), Suture(**region, stiffness=2.0)))
    declaration = Declaration(membrane_stiffness=20.0, mesh=declared_mesh())
    with RecordingWriter(
        path, camera=camera(), declaration=declaration, metadata={"seed": "3"}, overwrite=True
    ) as writer:
        for observation in seen:
            writer.write(observation)

    def read() -> object:
        recording = Recording.open(path, allow_truncated=True)
        return list(recording), recording.seed

    return Reader(path=path, read=read, valid=path.read_bytes())


def points_reader(folder: Path) -> Reader:
    """Return the reader of recordings of points alone, in which no image is the larger part of the bytes."""
    path = folder / "points.mcap"
    with RecordingWriter(path, camera=None, declaration=Declaration(), metadata={}) as writer:
        for observation in observations(4):
            writer.write(replace(observation, images=None))
    return Reader(path=path, read=lambda: list(Recording.open(path)), valid=path.read_bytes())


def truth_reader(folder: Path) -> Reader:
    """Return the reader of truth files."""
    path = folder / "run.truth.mcap"
    write_truth(path, truth())
    return Reader(path=path, read=lambda: read_truth(path, allow_truncated=True), valid=path.read_bytes())


def estimate_reader(folder: Path) -> Reader:
    """Return the reader of estimates."""
    path = folder / "estimate.mcap"
    n = 4
    ones = np.ones(n)
    sheet = Sheet(rest=np.arange(3.0 * n).reshape(n, 3), faces=np.array([[0, 1, 2], [1, 3, 2]]))
    frame = Estimate(
        index=0, time=0, positions=sheet.rest, observed=sheet.rest, mean=ones, sd=ones, probability=ones / 2,
        held=ones > 0, entropy=1.0, nis=float("nan"), boundary_energy=0.0, update_s=0.0, perception_s=0.0,
    )  # fmt: skip
    belief = Belief(mean=ones, covariance=np.eye(n), reference=2.0, lower=0 * ones, upper=ones)
    detection = Detection(
        attached=ones > 0, score=ones, stiffness=ones, stiffness_sd=ones, probabilistic=True, rule="P > 1/2"
    )
    with EstimateWriter(path, sheet, {"recording": "x"}) as writer:
        for index in range(3):
            writer.write(replace(frame, index=index, time=100 * index))
        writer.finish(belief, detection, skipped=[(3, "no tool")])
    return Reader(path=path, read=lambda: read_estimate(path, allow_truncated=True), valid=path.read_bytes())


def result_reader(folder: Path) -> Reader:
    """Return the reader of result.json."""
    path = folder / "result.json"
    rings = {str(radius): {"pcd": 1.0, "pug": 0.5, "f1": None} for radius in range(3)}
    figures = {
        "scene": "arc", "seed": 0, "sensing": "points", "estimator": "implicit", "policy": "recorded",
        "disturbances": None, "n_particles": 4, "n_frames": 3, "noise": {"force_sd_ratio": None},
        "detection": {
            "rule": "P > 1/2", "n_detected": 1, "n_attached": None, "n_observable": None, "by_dilation": rings,
            "average_precision": None, "observable": {"by_dilation": rings}, "converged": True,
        },
        "calibration": {"ece": None}, "tracking": {"rms_m": None},
        "decisions": [{"does": "x", "why": "y", "plan_s": 0.1}],
        "safety": {"limit_j": None, "max_mean_boundary_energy_j": None, "violations": None, "limit_n": 0.01},
        "ended": None,
        "procedure": {"name": "detach", "acts": [{"kind": "cut", "frame": 1, "log_bayes_factor": None}]},
        "entropy": {"prior": 1.0, "final": None},
        "frames": {"used": 3, "skipped": [{"index": 0, "why": "x"}], "not_converged": [1]},
        "timing": {"update_s": {"median": 0.1, "p95": 0.2}, "perception_s": None, "plan_s": None, "simulation_s": None},
    }  # fmt: skip
    path.write_text(json.dumps(figures, indent=1))
    return Reader(path=path, read=lambda: read_result(path), valid=path.read_bytes())


def scene_reader(folder: Path) -> Reader:
    """Return the reader of scene files."""
    path = folder / "scene.toml"
    path.write_text(SCENE)
    return Reader(path=path, read=lambda: load_scene(path), valid=path.read_bytes())


def arrays_reader(folder: Path) -> Reader:
    """Return the reader of npz archives."""
    path = folder / "arrays.npz"
    path.write_bytes(packed({"a": np.arange(6.0).reshape(2, 3), "b": np.array([[0, 1, 2]]), "c": np.array([True])}))
    return Reader(path=path, read=lambda: read_npz(path.read_bytes()), valid=path.read_bytes())


def packed(arrays: dict[str, np.ndarray]) -> bytes:
    """Return arrays as an npz archive."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


READERS: dict[str, Callable[[Path], Reader]] = {
    "recording": recording_reader,
    "points": points_reader,
    "truth": truth_reader,
    "estimate": estimate_reader,
    "result": result_reader,
    "scene": scene_reader,
    "arrays": arrays_reader,
}
"""Each reader by its name."""
