"""The chamfer distance between points sampled on the mesh and a cloud whose points have no identities.

    P(x, Q) = sum_p min_q |p - q|^2 + sum_q min_p |q - p|^2,  p on the mesh at x, q in the cloud Q,

as in the paper. A partial view has no points where the mesh is hidden, and the first sum would then pull the hidden
part to the seen one: a p whose q has its own nearest p further away than `reach` does not count there, as it is not
what q shows [reciprocal pairs: Pajdla & Van Gool, ICCV 1995].
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import KDTree

from ..physics.mesh import SheetMesh


class Chamfer(eqx.Module):
    """Points sampled on one mesh."""

    corners: Int[np.ndarray, "p 3"] | Int[Array, "p 3"]
    """Particles of the triangle that each lies in."""
    weights: Float[Array, "p 3"]
    """Barycentric."""
    reach: Float[Array, ""]
    """Along the mesh [m]; infinite for the paper's form."""

    @classmethod
    def build(cls, mesh: SheetMesh, *, count: int, reach: float) -> "Chamfer":
        """Sample points evenly over the mesh; the same ones every time."""
        surface = trimesh.Trimesh(mesh.rest, mesh.faces, process=False)
        points, triangle = trimesh.sample.sample_surface(surface, count, seed=0)[:2]
        weights = trimesh.triangles.points_to_barycentric(mesh.rest[mesh.faces[triangle]], points)
        return cls(corners=mesh.faces[triangle], weights=jnp.asarray(weights), reach=jnp.asarray(reach, dtype=float))

    def sampled(self, x: Float[Array, "n 3"]) -> Float[Array, "p 3"]:
        """Where the points are [m]."""
        return jnp.einsum("pk,pki->pi", self.weights, x[self.corners])

    def distance(self, x: Float[Array, "n 3"], cloud: Float[Array, "q 3"]) -> Float[Array, ""]:
        """P [m^2]; rows of the cloud that are NaN count nowhere. Differentiable where no nearest point changes."""
        there = self.sampled(x)
        of_mesh, of_cloud = nearest(jax.lax.stop_gradient(there), cloud)
        shown = jnp.sum((there - there[of_cloud[of_mesh]]) ** 2, axis=1) <= self.reach**2
        return _sum(there - cloud[of_mesh], shown) + _sum(cloud - there[of_cloud], jnp.isfinite(cloud).all(axis=1))


def _sum(off: Float[Array, "m 3"], counts: Bool[Array, " m"]) -> Float[Array, ""]:
    return jnp.sum(jnp.where(counts[:, None], off, 0.0) ** 2)


def nearest(one: Float[Array, "p 3"], other: Float[Array, "q 3"]) -> tuple[Int[Array, " p"], Int[Array, " q"]]:
    """For each point of either cloud the nearest of the other; a NaN is nearest to nothing, and gives index 0."""

    def search(one, other):
        one, other = np.asarray(one), np.asarray(other)
        return _nearest(one, other), _nearest(other, one)

    shapes = jax.ShapeDtypeStruct(one.shape[:1], np.int32), jax.ShapeDtypeStruct(other.shape[:1], np.int32)
    return jax.pure_callback(search, shapes, one, other)


def _nearest(asking: Float[np.ndarray, "p 3"], there: Float[np.ndarray, "q 3"]) -> Int[np.ndarray, " p"]:
    known, real = (np.flatnonzero(np.isfinite(points).all(axis=1)) for points in (asking, there))
    found = np.zeros(len(asking), np.int32)
    found[known] = real[KDTree(there[real]).query(asking[known])[1]]
    return found
