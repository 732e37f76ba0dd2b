"""Make docs/recordings/sample: a folder of measured points as a user has it, from our own simulation.

    python tools/make_sample_folder.py docs/recordings/sample

A 60 mm sheet, attached in the middle, is lifted at four corners; tracked points with noise in millimetres, times in
milliseconds, and the tool on a clock of its own that started 2.5 s earlier.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

import jiggle_mj as jm

SCENE = """
seed = 3
[tissue]
size = [0.06, 0.06]
spacing = 7e-3
mesh = "unstructured"
seed = 3
[[attachments]]
shape = "disc"
centre = [0.0, 0.0]
radius = 0.012
stiffness = 3.0
[tweezer]
radius = 8e-3
[programme]
still_frames = 2
height = 0.03
increments = 4
"""
TOOL_CLOCK_AHEAD_MS = 2500
"""What the tool's clock shows when the frames' clock shows 0 [ms]."""
NS_PER_MS = 1_000_000
"""Nanoseconds in a millisecond."""


def main() -> None:
    """Simulate the lifts and write the files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        scene_file = Path(place) / "sample.toml"
        scene_file.write_text(SCENE)
        scene = jm.load_scene(str(scene_file))
        with jm.Reference(scene, seed=0, sensing="particles") as reference:
            observations = [reference.step(action) for action in jm.programme(scene)]
            truth = reference.truth()
    grasps = [observation for observation in observations if observation.tool.closed]
    points = np.stack([1e3 * observation.points.positions for observation in grasps if observation.points is not None])
    # Tracks are numbered at random, not as the reference's vertices are: nearest at rest is the same point.
    at_rest = observations[0].points
    assert at_rest is not None
    attached = np.sort(KDTree(at_rest.positions).query(truth.rest[truth.attached])[1])
    times = np.array([round(observation.time / NS_PER_MS) for observation in grasps])
    times -= times[0]
    np.savez_compressed(
        folder / "tracks.npz",
        tracks_mm=points.astype(np.float32).round(3),
        time_ms=times,
        run=np.array([observation.tool.grasp for observation in grasps]),
        tool_mm=np.array([1e3 * observation.tool.position for observation in grasps]).round(3),
        tool_time_ms=times + TOOL_CLOCK_AHEAD_MS,
    )
    np.savetxt(folder / "attached.txt", attached, fmt="%d")
    print(f"{folder}: {points.shape[0]} frames of {points.shape[1]} points, {len(attached)} attached")


if __name__ == "__main__":
    main()
