"""Convert the runs of Alados5/tfm_matlab (hanging cloth, robot arm, depth camera), as rostopic printed them, to .npz.

    python tools/read_hanging_cloth.py FOLDER hanging_cloth.npz --grid n7
    jiggle-mj import . --recording docs/recordings/hanging_cloth.toml --out cloth.mcap

Coordinates are in the robot's base frame, in metres. Times are the messages' own stamps, in seconds. The camera's pose
is the last line of the calibration. A grid is reordered so that x rises along a row and y falls, as the authors read
it. The camera lays a new grid on the cloth in each run, with its rows up to 30 mm further along the bar. So each point
is written as its displacement since the run's still frames, added to its place in the first run's still frames.
"""

import argparse
import csv
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

STAMP, GRID_SIZE, FIRST_X, POSE = 2, 4, 5, slice(4, 11)
"""Columns: time of the message [ns], points along a side, first x; position and quaternion, w last."""
STILL_S = 1.8
"""Time that the arm stands still at the start of every run [s]."""


def table(path: Path) -> list[list[str]]:
    """Return all lines but the heading."""
    with path.open() as lines:
        return list(csv.reader(lines))[1:]


def main() -> None:
    """Read the files, transform to the base frame, and write the .npz."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--grid", default="n7", help="n7 or n13: points along a side")
    arguments = parser.parse_args()
    camera = np.array(table(arguments.folder / f"{arguments.grid}_calibration_campose.csv")[-1][1:], dtype=float)
    camera_rotation = Rotation.from_quat(camera[3:])
    points, times, runs, tool, tool_times, rotations = [], [], [], [], [], []
    paths = sorted(
        arguments.folder.glob(f"{arguments.grid}_traj*_mesh.csv"), key=lambda path: int(table(path)[0][STAMP])
    )
    origin = rest = None
    for run, path in enumerate(paths):
        frames, poses = table(path), table(path.with_name(path.name.replace("mesh", "tcp")))
        stamps = np.array([int(row[STAMP]) for row in frames])
        origin = stamps[0] if origin is None else origin
        n = int(frames[0][GRID_SIZE])
        columns = slice(FIRST_X, FIRST_X + 3 * n * n)
        numbers = np.array([[float(text) if text else np.nan for text in row[columns]] for row in frames])
        grid = numbers.reshape(len(frames), 3, n, n).transpose(0, 3, 2, 1)
        seen = camera_rotation.apply(grid.reshape(-1, 3)).reshape(len(frames), n * n, 3) + camera[:3]
        still = np.nanmean(seen[stamps - stamps[0] < STILL_S * 1e9], axis=0)
        rest = still if run == 0 else rest
        points.append(rest + seen - still)
        times.append((stamps - origin) / 1e9)
        runs.append(np.full(len(frames), run))
        at, first = np.unique([int(row[STAMP]) for row in poses], return_index=True)
        pose = np.array([poses[k][POSE] for k in first], dtype=float)
        tool.append(pose[:, :3])
        rotations.append(np.roll(pose[:, 3:], 1, axis=1))
        tool_times.append((at - origin) / 1e9)
    np.savez(
        arguments.out,
        points=np.concatenate(points),
        time=np.concatenate(times),
        run=np.concatenate(runs),
        tool=np.concatenate(tool),
        tool_time=np.concatenate(tool_times),
        tool_turn=np.concatenate(rotations),
    )
    print(f"{arguments.out}: {', '.join(path.name for path in paths)}")


if __name__ == "__main__":
    main()
