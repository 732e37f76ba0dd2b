"""The chamfer distance between points sampled on the mesh and a cloud whose points have no identities.

    P(x, Q) = sum_p min_q |p - q|^2 + sum_q min_p |q - p|^2,  p on the mesh at x, q in the cloud Q,

as in the paper. A partial view has no points where the mesh is hidden, and the first sum would then pull the hidden
part to the visible one. So a p counts in the first sum only if the p nearest to its q lies within `reach`; otherwise q
shows another part of the mesh [reciprocal pairs: Pajdla & Van Gool, ICCV 1995].
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import KDTree

from ..physics.mesh import SheetMesh

SAMPLING_SEED = 0
"""Seed of the points on the mesh, which are the same ones every time."""


class Chamfer(eqx.Module):
    """Points sampled on one mesh."""

    corners: Int[np.ndarray, "p 3"] | Int[Array, "p 3"]
    """Particles of the triangle that each point lies in."""
    weights: Float[Array, "p 3"]
    """Barycentric weight of each corner."""
    reach: Float[Array, ""]
    """Largest distance of a reciprocal pair along the mesh [m]; infinite for the paper's form."""

    @classmethod
    def build(cls, mesh: SheetMesh, *, count: int, reach: float) -> "Chamfer":
        """Sample `count` points uniformly over the mesh."""
        surface = trimesh.Trimesh(mesh.rest, mesh.faces, process=False)
        points, triangle = trimesh.sample.sample_surface(surface, count, seed=SAMPLING_SEED)[:2]
        weights = trimesh.triangles.points_to_barycentric(mesh.rest[mesh.faces[triangle]], points)
        return cls(corners=mesh.faces[triangle], weights=jnp.asarray(weights), reach=jnp.asarray(reach, dtype=float))

    def sampled(self, x: Float[Array, "n 3"]) -> Float[Array, "p 3"]:
        """Return the positions of the sampled points [m]."""
        return jnp.einsum("pk,pki->pi", self.weights, x[self.corners])

    def distance(self, x: Float[Array, "n 3"], cloud: Float[Array, "q 3"]) -> Float[Array, ""]:
        """Return P [m^2], without rows of the cloud that are NaN; differentiable where no nearest point changes."""
        mesh = self.sampled(x)
        in_cloud, in_mesh = nearest(jax.lax.stop_gradient(mesh), cloud)
        shown = jnp.sum((mesh - mesh[in_mesh[in_cloud]]) ** 2, axis=1) <= self.reach**2
        known = jnp.isfinite(cloud).all(axis=1)
        return _sum_of_squares(mesh - cloud[in_cloud], shown) + _sum_of_squares(cloud - mesh[in_mesh], known)


def _sum_of_squares(difference: Float[Array, "m 3"], counts: Bool[Array, " m"]) -> Float[Array, ""]:
    """Return the sum of squares over the rows that count."""
    return jnp.sum(jnp.where(counts[:, None], difference, 0.0) ** 2)


def nearest(first: Float[Array, "p 3"], second: Float[Array, "q 3"]) -> tuple[Int[Array, " p"], Int[Array, " q"]]:
    """Return the index of the nearest point of the other cloud, for each point of either.

    A NaN is nearest to no point, and its own index is 0.
    """

    def search(first, second):
        first, second = np.asarray(first), np.asarray(second)
        return _nearest(first, second), _nearest(second, first)

    shapes = jax.ShapeDtypeStruct(first.shape[:1], np.int32), jax.ShapeDtypeStruct(second.shape[:1], np.int32)
    return jax.pure_callback(search, shapes, first, second)


def _nearest(queries: Float[np.ndarray, "p 3"], targets: Float[np.ndarray, "q 3"]) -> Int[np.ndarray, " p"]:
    """Return the index of the target nearest to each finite query, 0 for the others."""
    asked, known = (np.flatnonzero(np.isfinite(points).all(axis=1)) for points in (queries, targets))
    index = np.zeros(len(queries), np.int32)
    index[asked] = known[KDTree(targets[known]).query(queries[asked])[1]]
    return index
