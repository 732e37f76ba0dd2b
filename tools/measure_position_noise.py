"""Compare the errors of observed positions with the noise that the estimator takes them to have.

    python tools/measure_position_noise.py ESTIMATE TRUTH

ESTIMATE is the folder of `jiggle-mj run` or `estimate`. Errors count from the same material point at rest.
"""

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np

from jiggle_mj.eval.metrics.result_file import read_scorable
from jiggle_mj.eval.metrics.truth_transfer import material_points

DISTANCES = (1e-6, 6e-3, 1e-2, 1.5e-2, 2e-2)
"""Ends of the ranges of distance over which the correlation is averaged [m]."""


def main() -> None:
    """Print the size, the correlation and the lasting part of the errors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("estimate", type=Path)
    parser.add_argument("truth", type=Path)
    given = parser.parse_args()
    _, found, truth = read_scorable(given.estimate, given.truth, allow_truncated=False)
    frames, rest = found.frames, found.sheet.rest
    if frames is None:
        raise SystemExit("The estimate keeps no frames.")
    at_material_points, positions = material_points(rest, truth), {each.index: each.positions for each in truth.frames}
    moved = np.array([at_material_points(positions[each.index] - truth.rest) for each in found.estimates])
    seen = np.trace(frames.precision, axis1=2, axis2=3) > 0
    error = np.where(seen[..., None], frames.y - rest - moved, np.nan)
    stated = np.where(seen[..., None, None], np.linalg.inv(frames.precision + np.eye(3)), np.nan)
    print("error, rms [mm]        ", np.round(1e3 * np.sqrt(np.nanmean(error**2, axis=(0, 1))), 3))
    print("taken for, rms [mm]    ", np.round(1e3 * np.sqrt(np.nanmean(stated, axis=(0, 1)).diagonal()), 3))
    lasting = np.nanmean(error, axis=0)
    count = seen.sum(axis=0)[:, None]
    by_chance = np.nanmean(np.nanvar(error, axis=0) / np.maximum(count - 1, 1), axis=0)
    share = (np.nanmean(lasting**2, axis=0) - by_chance) / np.nanmean(error**2, axis=(0, 1))
    print("of the variance, alike in all frames", np.round(share, 3))
    known = np.nan_to_num(error)
    products = np.einsum("tic,tjc->ij", known, known) / np.maximum(3 * seen.T.astype(float) @ seen, 1)
    distance = np.linalg.norm(rest[:, None] - rest[None], axis=2)
    for near, far in pairwise(DISTANCES):
        between = (distance >= near) & (distance < far)
        correlation = products[between].mean() / products.diagonal().mean()
        print(f"correlation at {1e3 * near:4.0f} to {1e3 * far:2.0f} mm: {correlation:+.2f}")


if __name__ == "__main__":
    main()
