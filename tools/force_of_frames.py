"""Write the force of each frame of danassutula/model_parameter_inference, examples/human_skin, as force.csv.

    python tools/force_of_frames.py FOLDER
    jiggle-mj import FOLDER --recording docs/recordings/human_skin.toml --out skin.mcap

The force was sampled over the displacement of the moving pad, and not at the frames. So it is interpolated at the pad's
displacement in each frame. It acts along the pull, the x axis; what it is across that was not measured and counts as 0.
"""

import argparse
from pathlib import Path

import numpy as np


def write_forces(folder: Path, out: Path) -> None:
    """Read healthy.npz in a folder, and write a row x, y, z [N] for each frame."""
    data = np.load(folder / "healthy.npz")
    order = np.argsort(data["force_pad_mm"], kind="stable")
    along = data["moving_pad_mm"][:, 0] - data["moving_pad_mm"][0, 0]
    force = np.interp(along, data["force_pad_mm"][order], data["force_n"][order])
    rows = np.column_stack([force, np.zeros((len(force), 2))])
    np.savetxt(out, rows, fmt="%.6f", delimiter=",", header="Fx [N],Fy [N],Fz [N]", comments="")


def main() -> None:
    """Write force.csv into the folder of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    write_forces(folder, folder / "force.csv")


if __name__ == "__main__":
    main()
