"""Compare springs at particles with attachments that are spread over triangles, on a recording whose truth is known.

    python tools/compare_attachment_springs.py RECORDING TRUTH ESTIMATE

ESTIMATE is the folder of `jiggle-mj estimate RECORDING`. Both kinds are fitted to the sheet's own forces: at the true
positions, and at the observed ones with the weights of the filter's evidence. What is compared with the truth is the
share by virtual work, which for a spread attachment is the sum of its row.
"""

import argparse
from itertools import product
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cho_factor, cho_solve

import jiggle_mj as jm
from jiggle_mj.estimator.filters.force_balance import ForceBalance
from jiggle_mj.estimator.filters.implicit import ImplicitFilter, ImplicitState
from jiggle_mj.estimator.tracked_sheet import TrackedSheet
from jiggle_mj.eval.metrics.result_file import read_scorable
from jiggle_mj.eval.metrics.truth_transfer import material_points, transfer

SHARES = {1: 1 / 10, 2: 1 / 30, 3: 1 / 60}
"""Integral of three linear shape functions over a triangle of unit area, by the number of different corners."""
RANK = 1e-9
"""Smallest eigenvalue of a fit's matrix that counts [largest]."""


def consistent(
    rest: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"], chosen: Int[np.ndarray, " m"]
) -> Float[np.ndarray, "m n n"]:
    """Return the stiffness matrix of an attachment of 1 N/m in all, spread by each chosen particle's shape function."""
    a, b, c = rest[faces].swapaxes(0, 1)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    around = np.bincount(faces.ravel(), np.repeat(area / 3, 3), minlength=len(rest))
    place = np.full(len(rest), -1)
    place[chosen] = np.arange(len(chosen))
    matrices = np.zeros((len(chosen), len(rest), len(rest)))
    for i, j, k in product(range(3), repeat=3):
        mine = place[faces[:, k]] >= 0
        of = faces[mine]
        shares = SHARES[len({i, j, k})] * area[mine] / around[of[:, k]]
        np.add.at(matrices, (place[of[:, k]], of[:, i], of[:, j]), shares)
    return matrices


def dense_dr_dx(balance: ForceBalance, x: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m m"]:
    """Return the Hessian of the sheet's own energy [N/m]."""
    rows, neighbours, n = np.asarray(balance._internal_dr_dx(jnp.asarray(x))), np.asarray(balance.neighbours), len(x)
    whole = np.zeros((n, 3, n + 1, 3))
    for place in range(neighbours.shape[1]):
        whole[np.arange(n), :, neighbours[:, place]] += rows[:, place]
    return whole[:, :, :n].reshape(3 * n, 3 * n)


def main() -> None:
    """Fit both kinds and print how far they are from the truth."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("recording", "truth", "estimate"):
        parser.add_argument(name, type=Path)
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    _, found, truth = read_scorable(given.estimate, given.truth, allow_truncated=False)
    declaration, frames = jm.Recording.open(given.recording).declaration, found.frames
    if declaration is None or frames is None:
        raise SystemExit("The recording has no declaration, or the estimate keeps no frames.")
    sheet = TrackedSheet.build(found.sheet, declaration, jm.EstimatorConfig(), identified=True)
    assert isinstance(sheet.filter, ImplicitFilter) and isinstance(sheet.state, ImplicitState)
    balance = sheet.filter.balance(sheet.state)
    rest, faces, n = found.sheet.rest, found.sheet.faces, len(found.sheet.rest)
    transferred = transfer(found.sheet, truth, truth.frames[0].index)
    b = np.where(np.isfinite(transferred.stiffness), transferred.stiffness, 0.0)
    near = np.zeros(n, bool)
    near[faces[(b[faces] > 0).any(axis=1)]] = True
    chosen = np.flatnonzero(near)
    kinds = {"at particles": np.zeros((len(chosen), n, n)), "over triangles": consistent(rest, faces, chosen)}
    kinds["at particles"][np.arange(len(chosen)), chosen, chosen] = 1
    at_material_points = material_points(rest, truth)
    moved = {frame.index: at_material_points(frame.positions - truth.rest) for frame in truth.frames}
    spread_b = np.linalg.lstsq(kinds["over triangles"].sum(axis=2).T, b, rcond=None)[0]
    at = {"at particles": b[chosen], "over triangles": spread_b}
    held = {kind: np.kron(np.einsum("k,kij->ij", at[kind], matrices), np.eye(3)) for kind, matrices in kinds.items()}
    fits = {(weighting, kind): [0.0, 0.0] for weighting in ("true positions", "as the filter") for kind in kinds}
    for t, estimate in enumerate(found.estimates):
        known = np.repeat(~frames.force_unknown[t], 3)
        seen = np.trace(frames.precision[t], axis1=1, axis2=2) > 0
        innovation = np.where(seen[:, None], frames.y[t] - frames.x[t], 0.0).ravel()
        noise, K = np.linalg.inv(frames.precision[t] + np.eye(3)), dense_dr_dx(balance, frames.x[t])
        for weighting, x in (("true positions", rest + moved[estimate.index]), ("as the filter", frames.x[t])):
            force = np.asarray(balance.energy.internal_gradient(jnp.asarray(x))).ravel()
            variance = np.repeat(np.asarray(balance.error(jnp.asarray(x))) ** 2, 3)
            for kind, matrices in kinds.items():
                spread, unbalanced = np.diag(variance), force
                if weighting == "as the filter":
                    H = K + held[kind]
                    moves = np.einsum("mni,nij->mnj", H.reshape(3 * n, n, 3), noise).reshape(3 * n, 3 * n)
                    spread, unbalanced = spread + moves @ H.T, force + H @ innovation
                D = np.einsum("kij,jc->ick", matrices, x - rest).reshape(3 * n, -1)[known]
                whitened = cho_solve(cho_factor(spread[np.ix_(known, known)], lower=True), D)
                fit = fits[weighting, kind]
                fit[0], fit[1] = fit[0] + D.T @ whitened, fit[1] - whitened.T @ unbalanced[known]
    for (weighting, kind), (precision, shift) in fits.items():
        share = kinds[kind].sum(axis=2).T @ np.linalg.lstsq(precision, shift, rcond=RANK)[0]
        attached = transferred.attached & (b > 0)
        error = np.sqrt(np.mean((share - b)[attached] ** 2)) / np.sqrt(np.mean(b[attached] ** 2))
        print(f"{weighting:>15}, springs {kind:<15} sum {share.sum() / b.sum():.2f}, rms error {error:.2f} of b")


if __name__ == "__main__":
    main()
