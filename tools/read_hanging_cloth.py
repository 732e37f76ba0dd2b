"""The runs of Alados5/tfm_matlab (hanging cloth, a robot arm, a depth camera), as rostopic printed them, in one .npz.

    python tools/read_hanging_cloth.py FOLDER hanging_cloth.npz --grid n7
    jiggle-mj import . --recording docs/recordings/hanging_cloth.toml --out cloth.mcap

In the robot's base frame, metres and seconds by the messages' own stamps. The camera's place is the calibration's last
line. A grid's rows and columns are turned so that x rises along a row and y falls, which is how the authors read it.
The camera lays the grid on the cloth anew in each run, with its rows up to 30 mm further along the bar: what is written
is how far each point has gone since the run's still frames, from where the first run's still frames have it.
"""

import argparse
import csv
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

STAMP, SIZE, FIRST, POSE = 2, 4, 5, slice(4, 11)
"""Columns: time of the message, points along a side, first of all x; position and quaternion, w last."""
STILL = 1.8
"""How long the arm stands at the start of every run [s]."""


def table(path: Path) -> list[list[str]]:
    """All lines but the heading."""
    with path.open() as lines:
        return list(csv.reader(lines))[1:]


def main() -> None:
    """Read, turn and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--grid", default="n7", help="n7 or n13: points along a side")
    said = parser.parse_args()
    camera = np.array(table(said.folder / f"{said.grid}_calibration_campose.csv")[-1][1:], dtype=float)
    seen_by = Rotation.from_quat(camera[3:])
    points, times, runs, tool, tool_times, turns = [], [], [], [], [], []
    paths = sorted(said.folder.glob(f"{said.grid}_traj*_mesh.csv"), key=lambda path: int(table(path)[0][STAMP]))
    origin = rest = None
    for run, path in enumerate(paths):
        frames, poses = table(path), table(path.with_name(path.name.replace("mesh", "tcp")))
        stamps = np.array([int(row[STAMP]) for row in frames])
        origin = stamps[0] if origin is None else origin
        n = int(frames[0][SIZE])
        given = np.array([[float(one) if one else np.nan for one in row[FIRST : FIRST + 3 * n * n]] for row in frames])
        grid = given.reshape(len(frames), 3, n, n).transpose(0, 3, 2, 1)
        seen = seen_by.apply(grid.reshape(-1, 3)).reshape(len(frames), n * n, 3) + camera[:3]
        began = np.nanmean(seen[stamps - stamps[0] < STILL * 1e9], axis=0)
        rest = began if run == 0 else rest
        points.append(rest + seen - began)
        times.append((stamps - origin) / 1e9)
        runs.append(np.full(len(frames), run))
        at, first = np.unique([int(row[STAMP]) for row in poses], return_index=True)
        pose = np.array([poses[k][POSE] for k in first], dtype=float)
        tool.append(pose[:, :3])
        turns.append(np.roll(pose[:, 3:], 1, axis=1))
        tool_times.append((at - origin) / 1e9)
    np.savez(
        said.out,
        points=np.concatenate(points),
        time=np.concatenate(times),
        run=np.concatenate(runs),
        tool=np.concatenate(tool),
        tool_time=np.concatenate(tool_times),
        tool_turn=np.concatenate(turns),
    )
    print(f"{said.out}: {', '.join(path.name for path in paths)}")


if __name__ == "__main__":
    main()
