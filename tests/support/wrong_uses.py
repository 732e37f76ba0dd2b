"""Wrong uses of the public names, run as users run them: without the shape checks of the tests.

`python -m tests.support.wrong_uses` prints a line for each: the class of the error, whether it is one of the project's,
and its message. It has an interpreter of its own, because the tests' import hook would refuse first.
"""

import json
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np

import jiggle_mj as jm
from jiggle_mj.cluster import cluster
from jiggle_mj.estimator.belief.config import BeliefConfig, SamplerConfig
from jiggle_mj.estimator.perception.config import PerceptionConfig, StereoTrackerConfig
from jiggle_mj.scenes import disturbed

POSE = np.eye(4)
RGB = np.zeros((24, 32, 3), np.uint8)
NAN, INF = float("nan"), float("inf")
K, P = np.diag([40.0, 40.0, 1.0]), np.hstack([np.diag([40.0, 40.0, 1.0]), np.zeros((3, 1))])
TOOL = {"position": np.zeros(3), "quat_wxyz": np.eye(4)[0], "closed": True, "grasp": 1, "radius": 5e-3}
TRIANGLE = {"vertices": np.eye(3), "faces": np.array([[0, 1, 2]]), "track_id": np.arange(3)}
CAMERA = {"width": 32, "height": 24, "focal": 40.0, "baseline": 5e-3, "T_world_camera": POSE}
CALIBRATION = {"width": 32, "height": 24, "K": K, "P": P}
POINTS = np.random.default_rng(0).normal(size=(5, 3))
SMALL = jm.Scene(name="small")

ABOVE_ZERO = (0, -1e-3, NAN, INF, "5 mm", 10**400, None, [5e-3])
"""Values that are no number above 0."""
Use = tuple[str, Callable[[], object]]
"""What is tried, and the call."""


def tool(**changes: object) -> jm.ToolState:
    return jm.ToolState(**(TOOL | changes))


def observation(**changes: object) -> jm.Observation:
    seen = {"index": 0, "time": 0, "tool": tool(), "points": jm.MeasuredPoints(positions=POINTS)}
    return jm.Observation(**(seen | changes))


def changed(name: str, make: Callable[..., object], good: dict, wrong: dict[str, tuple]) -> Iterator[Use]:
    """Yield a call for each wrong value of each argument; all other arguments are right."""
    for key, values in wrong.items():
        for value in values:
            text = " ".join(repr(value).split())[:40]
            yield f"{name}({key}={text})", lambda key=key, value=value: make(**(good | {key: value}))


def constructors() -> Iterator[Use]:
    """Yield wrong arguments of actions, observations, meshes, declarations and cameras."""
    three = ([0, 0], np.zeros((1, 3)), "origin", None, [0, 0, NAN], [0, 0, "1 mm"])
    yield from changed(
        "Grasp", jm.Grasp, {"point": np.zeros(3), "radius": 5e-3}, {"point": three, "radius": ABOVE_ZERO}
    )
    yield from changed("Move", jm.Move, {}, {"to": three})
    path = ([], [[0, 0, 0]], [0, 0], [[0, NAN]], "line", None)
    yield from changed("Cut", jm.Cut, {"path": [[0, 0]], "width": 0.01}, {"path": path, "width": ABOVE_ZERO})
    sewn = {"path": [[0, 0]], "width": 0.01, "stiffness": 1.0}
    yield from changed("Suture", jm.Suture, sewn, {"path": path[:2], "stiffness": ABOVE_ZERO})
    image = (None, RGB.astype(float), RGB.astype(np.uint16), RGB[..., 0], RGB[:, :10], RGB[:0], "left.png")
    yield from changed("StereoPair", jm.StereoPair, {"left": RGB, "right": RGB}, {"left": image, "right": image[:2]})
    positions = (None, POINTS[:, :2], POINTS.ravel(), [["a", "b", "c"]], [[0, 0], [0, 0, 0]], POINTS.astype(complex))
    ids = ([0, 1], [0, 1, 2, 3, 3], np.arange(5.0), "01234", [[0, 1, 2, 3, 4]])
    wrong = {"positions": positions, "track_id": ids, "sd": ABOVE_ZERO}
    yield from changed("MeasuredPoints", jm.MeasuredPoints, {"positions": POINTS}, wrong)
    wrong = {
        "position": three,
        "quat_wxyz": ([0, 0, 0, 0], [1, 0, 0], [NAN, 0, 0, 0], None),
        "closed": ("yes", 1, None),
        "grasp": (-1, 1.5, "first", None, True),
        "radius": ABOVE_ZERO,
        "held_tracks": ("12", 3, [1.5], None),
        "by_points": ("no", None),
    }
    yield from changed("ToolState", jm.ToolState, TOOL, wrong)
    wrong = {
        "index": (-1, 0.5, "0", None),
        "time": (0.1, "now", None),
        "tool": (None, TOOL, np.zeros(3)),
        "images": (RGB, (RGB, RGB)),
        "points": (POINTS, "points"),
        "reports": (None, [np.zeros(3)]),
        "events": ("cut", [None], [jm.Wait()]),
    }
    yield from changed("Observation", observation, {}, wrong)
    wrong = {
        "vertices": (None, np.eye(3)[:, :2], np.eye(3) * NAN),
        "faces": ([[0, 1]], [[0, 1, 3]], [[0, 1, -1]], np.array([[0.0, 1, 2]]), None),
        "track_id": ([0, 1], [0, 0, 1], None, "abc"),
        "held": ([True], [0, 1, 0], "none"),
    }
    yield from changed("DeclaredMesh", jm.DeclaredMesh, TRIANGLE, wrong)
    wrong = {
        "membrane_stiffness": (*ABOVE_ZERO, 1e300),
        "thickness": (*ABOVE_ZERO[:6], 1.0),
        "areal_density": (0, 1e9),
        "poisson": (0.5, -0.1, NAN, "0.4", None),
        "gravity": (-9.81, (0, 0, -9810), (0, 0), (0, 0, NAN), "down", None),
        "bed": ("yes", None),
        "mesh": (TRIANGLE, "mesh.obj"),
    }
    yield from changed("Declaration", jm.Declaration, {}, wrong)
    mirrored, skewed = np.diag([1.0, 1, -1, 1]), POSE + np.eye(4, k=1)
    pose = (None, np.eye(3), POSE * NAN, mirrored, skewed, "world")
    wrong = {"width": (0, 32.0, None), "focal": ABOVE_ZERO, "baseline": ABOVE_ZERO, "T_world_camera": pose}
    yield from changed("StereoCamera.rectified", jm.StereoCamera.rectified, CAMERA, wrong)
    wrong = {
        "height": (-1, "24", True),
        "K": (None, np.zeros((3, 3)), np.eye(4), K * NAN),
        "P": (K, np.zeros((3, 4)), None),
        "D": (None, [[0.0]], [NAN] * 5, "plumb_bob"),
        "R": (np.zeros((3, 3)), 2 * np.eye(3), None),
    }
    yield from changed("CameraCalibration", jm.CameraCalibration, CALIBRATION, wrong)
    one = jm.CameraCalibration(**CALIBRATION)
    sides = {"left": one, "right": one, "T_world_camera": POSE}
    yield from changed("StereoCamera", jm.StereoCamera, sides, {"left": (None, K), "right": (one, CALIBRATION)})


def engines(folder: Path) -> Iterator[Use]:
    """Yield wrong arguments of reference, scenes, estimator, recordings and runs."""
    made = {"scene": SMALL, "seed": 0, "sensing": "points"}

    def reference(**changes: object) -> jm.Reference:
        given = made | changes
        return jm.Reference(given.pop("scene"), **given)

    wrong = {
        "scene": ("arc", None, {"name": "arc"}),
        "seed": (-1, 0.5, "0", None, True),
        "sensing": ("smell", None, 3, ["stereo"]),
        "dump_dir": (3, ["a"]),
    }
    yield from changed("Reference", reference, {}, wrong)
    for name in (3, None, "ark", ["arc"]):
        yield f"load_scene({name!r})", lambda name=name: jm.load_scene(name)
    yield "programme('arc')", lambda: list(jm.programme("arc"))
    for text in ("gravity=a", "gravty", 3, ["gravity", 0.5]):
        yield f"disturbed({text!r})", lambda text=text: disturbed(SMALL, [text])
    yield "disturbed(None)", lambda: disturbed(SMALL, None)
    for key, value in (("tissue", {"size": [1, 1]}), ("seed", "0"), ("attachments", [1]), ("name", 3), ("secret", 1)):
        yield f"Scene({key}={value!r})", lambda key=key, value=value: jm.Scene(**({"name": "x"} | {key: value}))
    still = jm.Reference(SMALL, seed=0, sensing="particles")
    for action in (None, "grasp", jm.Wait, [jm.Wait()], jm.Grasp(point=[5.0, 0, 0], radius=1e-3)):
        yield f"step({str(action)[:30]})", lambda action=action: still.step(action)
    yield "step(Move out of reach)", lambda: still.step(jm.Move(to=[30, 0, 0]))
    yield "step(Grasp of 6 m)", lambda: still.step(jm.Grasp(point=[0, 0, 0], radius=6.0))
    wrong = {
        "declaration": (None, {"poisson": 0.4}, 30.0),
        "camera": ("left", K, POSE),
        "config": ({"seed": 1}, {}, "implicit"),
        "mask": (RGB, "grabcut"),
        "disparity": (16, "sgbm"),
    }
    yield from changed("Estimator", jm.Estimator, {"declaration": jm.Declaration()}, wrong)
    wrong = {
        "spacing": (0, -1, NAN, INF, "4 mm", None),
        "samples": (0, 1.5, None, True),
        "seed": (-1, 0.5, "0", None),
        "filter": ("kalman", None, 3),
        "refinement": ("never", None),
        "membrane": ("cloth", 1),
        "perception": ({}, None),
        "prior": (1,),
    }
    yield from changed("EstimatorConfig", jm.EstimatorConfig, {}, wrong)
    for config, wrong in (
        (PerceptionConfig, {"stereo": ({}, 3)}),
        (StereoTrackerConfig, {"min_depth": ABOVE_ZERO, "min_found": (-1, 2, "most"), "mesh": (None,)}),
        (BeliefConfig, {"damping": (0, 1.5, "much"), "tail": (0.5, None), "sampler": ({},)}),
        (SamplerConfig, {"chains": (1, 2.5), "candidates": (0, 1.5, "16"), "agreement": (0, "0.1")}),
    ):
        yield from changed(config.__name__, config, {}, wrong)
    for given in (None, "run.mcap", [observation()], POINTS, SimpleNamespace(index=0, tool=None)):
        yield f"update({str(given)[:30]})", lambda given=given: jm.Estimator(jm.Declaration()).update(given)
    yield (
        "update(images, no camera)",
        lambda: jm.Estimator(jm.Declaration()).update(
            observation(points=None, images=jm.StereoPair(left=RGB, right=RGB))
        ),
    )
    yield (
        "update(other image size)",
        lambda: jm.Estimator(jm.Declaration(), jm.StereoCamera.rectified(**(CAMERA | {"width": 64}))).update(
            observation(images=jm.StereoPair(left=RGB, right=RGB))
        ),
    )
    for name in ("belief", "detection", "sheet", "positions", "rest_time"):
        yield f"Estimator.{name} too early", lambda name=name: getattr(jm.Estimator(jm.Declaration()), name)
    yield "identify too early", lambda: jm.Estimator(jm.Declaration()).identify()
    yield "force_unknown too early", lambda: jm.Estimator(jm.Declaration()).force_unknown([True])
    yield "change_log_bayes_factor too early", lambda: jm.Estimator(jm.Declaration()).change_log_bayes_factor(None)
    for path in (3, None, "no.mcap", folder):
        yield f"Recording.open({str(path)[:9]})", lambda path=path: jm.Recording.open(path)
    good = {"path": folder / "w.mcap", "camera": None, "declaration": jm.Declaration(), "metadata": {}}
    wrong = {"path": (3, None), "camera": (K,), "declaration": (None, {}), "metadata": (None, {"seed": 3}, "seed")}
    yield from changed("RecordingWriter", lambda **given: jm.RecordingWriter(**given, overwrite=True), good, wrong)
    for given in (None, POINTS, [observation()]):
        yield f"write({str(given)[:20]})", lambda given=given: jm.RecordingWriter(**good, overwrite=True).write(given)
    for count in (0, 1.5, "2"):
        yield f"WorkerProcesses({count!r})", lambda count=count: jm.WorkerProcesses(count)
    for url in (3, None, "localhost", "dask://x:99999"):
        yield f"cluster({url!r})", lambda url=url: cluster(url).__enter__()
    yield "cluster(timeout)", lambda: cluster("dask://localhost:1", connect_timeout_s=-1).__enter__()
    series = {"scene": SMALL, "folder": folder / "s", "count": 1}
    wrong = {
        "scene": ("arc",),
        "folder": (3,),
        "count": (0, 1.5, "2", None),
        "seed": (-1, "0"),
        "executor": (4, "dask"),
    }
    yield from changed("record_series", jm.record_series, series, wrong)
    yield "run_scene('arc')", lambda: jm.run_scene("arc", folder / "r")
    yield "run_scene(directory=3)", lambda: jm.run_scene(SMALL, 3)
    yield "run_scene(policy)", lambda: jm.run_scene(SMALL, folder / "r", policy="pull", sensing="points")
    yield "run_estimator(3)", lambda: jm.run_estimator(3, folder / "r")
    yield "run_estimator(str)", lambda: jm.run_estimator("no.mcap", folder / "r")
    yield "close_loop(str)", lambda: jm.close_loop("no.mcap", folder / "r")
    many = {"recordings": [folder / "a.mcap"], "directory": folder / "many"}
    wrong = {"recordings": ("a.mcap", [], [3], None), "directory": (3,), "executor": (4, "dask")}
    yield from changed("close_loops", jm.close_loops, many, wrong)
    yield "score(str)", lambda: jm.score("no", "no.truth.mcap")
    yield "import_folder(3)", lambda: jm.import_folder(3, None, folder / "i.mcap")
    yield "import_folder(no)", lambda: jm.import_folder(folder / "no", None, folder / "i.mcap")


def main() -> None:
    """Try every use; print its name, its outcome and the message as JSON, one line each."""
    with tempfile.TemporaryDirectory() as folder:
        for name, use in (*constructors(), *engines(Path(folder))):
            try:
                use()
                outcome, message = "accepted", ""
            except jm.JiggleError as refused:
                outcome, message = "refused", str(refused)
            except Exception as failure:
                named = (type(failure) is ValueError and ":" in str(failure)) or "too early" in name
                outcome = "refused" if named and type(failure) is ValueError else "raw"
                message = f"{type(failure).__name__}: {failure}"
            print(json.dumps([name, outcome, message]), flush=True)


if __name__ == "__main__":
    main()
