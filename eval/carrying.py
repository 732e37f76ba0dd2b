"""Carries the truth from the reference's vertices to the estimator's particles, since the two meshes share none.

Attachment goes by the nearest rest vertex: a particle is truly attached iff its nearest reference vertex is. Stiffness
goes as a density: what is physical is the stiffness per area of tissue, and a vertex of either mesh stands for a third
of the triangles around it, so

    b*_particle = b*_vertex * area_particle / area_vertex.

Positions go by barycentric interpolation in the reference's rest triangle nearest to the particle's rest position.

Nothing here smooths: a line of attachments one vertex wide keeps its total stiffness on average over meshes, not on
each mesh.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from trimesh.triangles import closest_point, points_to_barycentric

from jiggle_mj.estimate import Sheet
from jiggle_mj.truth import Truth, TruthFrame

OBSERVABLE = 2.4e-3
"""Load from which an attachment can be told from the model's own error, four standard deviations of the force on a
particle that the estimator's model gets wrong in the shipped scenes [N]."""
PAIRS_AT_ONCE = 400_000
"""Point-triangle pairs handled together, which bounds the memory to some 100 MB."""


@dataclass(frozen=True, kw_only=True)
class CarriedTruth:
    """The truth on the estimator's particles at one moment."""

    attached: Bool[np.ndarray, " n"]
    stiffness: Float[np.ndarray, " n"]
    """b*, rescaled by area [N/m]; inf for a weld, NaN where attached by an unknown amount."""
    load: Float[np.ndarray, " n"] | None = None
    """Root of the sum over frames of the squared force that the attachment carried [N]; None where not recorded."""

    @property
    def observable(self) -> Bool[np.ndarray, " n"] | None:
        """Attached particles that were loaded enough to show: at least `OBSERVABLE`; None where not recorded."""
        return None if self.load is None else self.attached & (self.load >= OBSERVABLE)


def vertex_areas(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, " n"]:
    """A third of the area of the triangles around each vertex [m^2]."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    third = np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 6
    return np.bincount(faces.ravel(), weights=np.repeat(third, 3), minlength=len(vertices))


def frame_at(truth: Truth, index: int) -> TruthFrame | None:
    """The truth's last frame whose index is not after `index`; None if there is none."""
    earlier = [frame for frame in truth.frames if frame.index <= index]
    return max(earlier, key=lambda frame: frame.index) if earlier else None


def stiffness_at(truth: Truth, frame: TruthFrame | None) -> Float[np.ndarray, " n"]:
    """True stiffness of the reference's vertices [N/m]: 0 where free, inf welded, NaN attached by an unknown amount.

    Without a frame only `truth.attached` is known. Cuts and sutures are in the frame: a vertex of stiffness 0 is free
    there even if it was attached at the start.
    """
    if frame is None:
        return np.where(truth.attached, np.nan, 0.0)
    return np.where(np.isnan(frame.stiffness) & ~truth.attached, 0.0, frame.stiffness)


def carry(sheet: Sheet, truth: Truth, index: int) -> CarriedTruth:
    """The truth at observation `index` on the particles of `sheet`, and the loads up to it.

    A reference without triangles has no areas: its stiffness and loads are taken over unscaled.
    """
    nearest = np.asarray(KDTree(truth.rest).query(sheet.rest)[1])
    stiffness = stiffness_at(truth, frame_at(truth, index))[nearest]
    attached = np.isnan(stiffness) | (stiffness > 0)
    loads = [frame.load for frame in truth.frames if frame.load is not None and frame.index <= index]
    load = np.sqrt(np.sum(np.square(loads), axis=0))[nearest] if loads else None
    if len(truth.faces):
        mine, reference = vertex_areas(sheet.rest, sheet.faces), vertex_areas(truth.rest, truth.faces)[nearest]
        scalable = attached & (reference > 0)
        larger = mine[scalable] / reference[scalable]
        stiffness[scalable] *= larger
        if load is not None:
            load[scalable] *= larger
    return CarriedTruth(attached=attached, stiffness=stiffness, load=load)


def barycentric_weights(
    points: Float[np.ndarray, "m 3"], vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Int[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
    """Vertices and weights of the point of the mesh that is nearest to each of `points`.

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
