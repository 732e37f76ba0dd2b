"""Transfers the truth from the reference's vertices to the estimator's particles, since the two meshes share none.

Attachment follows the nearest rest vertex: a particle is truly attached iff its nearest reference vertex is. Stiffness
follows virtual work: a vertex's spring pulls at a point of one of the estimator's triangles, whose corners share it,

    b*_particle = sum over vertices of (barycentric weight of the particle at the vertex) b*_vertex,

as consistent nodal loads do in finite elements. So total and centre are kept on any mesh. A particle at the border of a
patch has a part of the stiffness of one inside, and its free neighbour may have the rest.

Positions follow barycentric interpolation in the reference's rest triangle nearest to the particle's rest position.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from trimesh.triangles import closest_point, points_to_barycentric

from jiggle_mj.estimate import Sheet
from jiggle_mj.truth import Truth, TruthFrame

from .detection_metrics import edges

OBSERVABLE_LOAD = 2.4e-3
"""Load from which an attachment is distinguishable from the model's own error [N].

It is four times `EstimatorConfig.force_sd` in the shipped scenes.
"""
PAIRS_AT_ONCE = 400_000
"""Point-triangle pairs handled together; bounds the memory to about 100 MB."""


@dataclass(frozen=True, kw_only=True)
class TransferredTruth:
    """The truth on the estimator's particles at one moment."""

    attached: Bool[np.ndarray, " n"]
    stiffness: Float[np.ndarray, " n"]
    """b* [N/m]; inf for a weld, NaN where attached by an unknown amount."""
    load: Float[np.ndarray, " n"] | None = None
    """Root of the sum over frames of the squared force on the attachment [N]; None where not recorded."""

    @property
    def observable(self) -> Bool[np.ndarray, " n"] | None:
        """Attached particles with a load of at least `OBSERVABLE_LOAD`; None where not recorded."""
        return None if self.load is None else self.attached & (self.load >= OBSERVABLE_LOAD)


def frame_at(truth: Truth, index: int) -> TruthFrame | None:
    """Return the truth's last frame whose index is not after `index`; None if there is none."""
    earlier = [frame for frame in truth.frames if frame.index <= index]
    return max(earlier, key=lambda frame: frame.index) if earlier else None


def stiffness_at(truth: Truth, frame: TruthFrame | None) -> Float[np.ndarray, " n"]:
    """Return the true stiffness of the reference's vertices [N/m].

    It is 0 where free, inf where welded, and NaN where attached by an unknown amount.

    Without a frame only `truth.attached` is known. Cuts and sutures are in the frame: a vertex of stiffness 0 is free
    there even if it was attached at the start.
    """
    if frame is None:
        return np.where(truth.attached, np.nan, 0.0)
    return np.where(np.isnan(frame.stiffness) & ~truth.attached, 0.0, frame.stiffness)


def transfer(sheet: Sheet, truth: Truth, index: int) -> TransferredTruth:
    """Return the truth at observation `index` on the particles of `sheet`, and the loads up to it.

    Vertices further from the sheet than its longest edge belong to tissue that it does not have, and do not count.
    """
    at_vertices = stiffness_at(truth, frame_at(truth, index))
    loads = [frame.load for frame in truth.frames if frame.load is not None and frame.index <= index]
    corners, weights = barycentric_weights(truth.rest, sheet.rest, sheet.faces)
    nearest_points = np.einsum("vk,vki->vi", weights, sheet.rest[corners])
    weights[np.linalg.norm(nearest_points - truth.rest, axis=1) > _longest_edge(sheet)] = 0

    def shared(values: Float[np.ndarray, " v"]) -> Float[np.ndarray, " n"]:
        return np.bincount(corners.ravel(), (weights * values[:, None]).ravel(), minlength=len(sheet.rest))

    nearest = at_vertices[np.asarray(KDTree(truth.rest).query(sheet.rest)[1])]
    finite = np.isfinite(nearest)
    return TransferredTruth(
        attached=np.isnan(nearest) | (nearest > 0),
        stiffness=np.where(finite, shared(np.where(np.isfinite(at_vertices), at_vertices, 0.0)), nearest),
        load=shared(np.sqrt(np.sum(np.square(loads), axis=0))) if loads else None,
    )


def _longest_edge(sheet: Sheet) -> float:
    """Return the longest edge at rest [m]; infinite without triangles."""
    first, second = sheet.rest[edges(sheet.faces)].swapaxes(0, 1)
    return float(np.linalg.norm(first - second, axis=1).max(initial=0)) or np.inf


def material_points(
    rest: Float[np.ndarray, "m 3"], truth: Truth
) -> Callable[[Float[np.ndarray, "v 3"]], Float[np.ndarray, "m 3"]]:
    """Return the function that takes vectors at the reference's vertices to the material points nearest to `rest`."""
    corners, weights = barycentric_weights(rest, truth.rest, truth.faces)
    return lambda vectors: np.einsum("mk,mkd->md", weights, vectors[corners])


def barycentric_weights(
    points: Float[np.ndarray, "m 3"], vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Int[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
    """Return vertices and weights of the point of the mesh that is nearest to each of `points`.

    Weights are in [0, 1] and sum to 1. A mesh without triangles gives the nearest vertex.
    """
    if not len(faces):
        nearest = np.asarray(KDTree(vertices).query(points)[1])
        return np.repeat(nearest[:, None], 3, axis=1), np.tile([1.0, 0.0, 0.0], (len(points), 1))
    triangles = vertices[faces]
    chosen, weights = np.empty(len(points), dtype=int), np.empty((len(points), 3))
    step = max(1, PAIRS_AT_ONCE // len(faces))
    for start in range(0, len(points), step):
        block = points[start : start + step]
        every = closest_point(np.tile(triangles, (len(block), 1, 1)), np.repeat(block, len(faces), axis=0))
        distance = np.linalg.norm(every.reshape(len(block), len(faces), 3) - block[:, None], axis=-1)
        best = distance.argmin(axis=1)
        near = every.reshape(len(block), len(faces), 3)[np.arange(len(block)), best]
        chosen[start : start + step] = best
        weights[start : start + step] = points_to_barycentric(triangles[best], near)
    weights = np.clip(weights, 0, 1)
    return faces[chosen], weights / weights.sum(axis=1, keepdims=True)
