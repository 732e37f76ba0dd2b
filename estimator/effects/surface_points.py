"""Points of the sheet that are observed as the particles: the particles themselves, or where a tracker slid to.

A place is a point in the plane of the sheet's two mean material axes. A sheet that is far from flat at rest is not
unrolled.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

MAX_OUTSIDE = 1e-3
"""Distance by which a point may be outside its triangle [heights of the triangle], so that particles on the outline
have derivatives both ways."""


class SurfacePoints(eqx.Module):
    """One point of the sheet for each particle, in one of its triangles.

    Inside a triangle the sheet is a cubic Bezier patch with the sheet's derivatives at the corners [PN triangles:
    Vlachos et al. 2001, doi:10.1145/364338.364387]. It is exact for a quadratic sheet, and smooth at the particles.
    """

    corners: Int[Array, "n 3"]
    """Particles at the corners of the triangle."""
    weights: Float[Array, "n 3"]
    """Barycentric coordinates."""
    sides: Float[Array, "n 3 3 2"]
    """Vectors from each corner to each other, in places of the sheet [m]."""

    @classmethod
    def themselves(cls, n: int) -> "SurfacePoints":
        """Return n points that are the particles themselves."""
        return cls(
            corners=jnp.broadcast_to(jnp.arange(n)[:, None], (n, 3)),
            weights=jnp.broadcast_to(jnp.asarray([1.0, 0.0, 0.0]), (n, 3)),
            sides=jnp.zeros((n, 3, 3, 2)),
        )

    @classmethod
    def at(cls, triangles: Int[Array, "f 3"], place: Float[Array, "n 2"], to: Float[Array, "n 2"]) -> "SurfacePoints":
        """Return the points at given places; beyond the outline they stop near it.

        Args:
            triangles: particles at the corners of each triangle.
            place: of the particles [m].
            to: places of the points [m].
        """
        gradient, first = _barycentric_gradients(place[triangles]), jnp.eye(3)[:1]

        def own_triangle(at: Float[Array, "n 2"]) -> Int[Array, " n"]:
            index = jnp.broadcast_to(jnp.arange(len(triangles))[:, None], triangles.shape)
            return jnp.zeros(len(at), dtype=index.dtype).at[triangles].set(index)

        def containing_triangle(at: Float[Array, "n 2"]) -> Int[Array, " n"]:
            start = jnp.einsum("fka,fa->fk", gradient, place[triangles[:, 0]]) - first
            return jnp.argmax(jnp.min(jnp.einsum("fka,na->nfk", gradient, at) - start[None], axis=2), axis=1)

        fixed = jax.lax.stop_gradient(to)
        triangle = jax.lax.cond(jnp.all(fixed == place), own_triangle, containing_triangle, fixed)
        corners = triangles[triangle]
        weights = first + jnp.einsum("nka,na->nk", gradient[triangle], to - place[corners[:, 0]])
        weights = jnp.maximum(weights, -MAX_OUTSIDE)
        return cls(
            corners=corners,
            weights=weights / jnp.sum(weights, axis=1, keepdims=True),
            sides=place[corners][:, None] - place[corners][:, :, None],
        )

    def __call__(self, x: Float[Array, "n 3"], tangents: Float[Array, "n 3 2"]) -> Float[Array, "n 3"]:
        """Return the positions of the points [m], for particles at x [m] and the sheet's derivatives there."""
        w, at = self.weights, x[self.corners]
        edges = at[:, :, None] + jnp.einsum("nkia,nkja->nkji", tangents[self.corners], self.sides) / 3
        middle = jnp.sum(edges, axis=(1, 2)) / 4 - jnp.sum(at, axis=1) * 5 / 12
        share = w[:, :, None] ** 2 * w[:, None] * (3 - 2 * jnp.eye(3)[None])
        return jnp.einsum("nkj,nkji->ni", share, edges) + 6 * jnp.prod(w, axis=1)[:, None] * middle


def _barycentric_gradients(corners: Float[Array, "f 3 2"]) -> Float[Array, "f 3 2"]:
    """Return the gradients of the barycentric coordinates of each triangle [1/m]."""
    opposite = jnp.roll(corners, -2, axis=1) - jnp.roll(corners, -1, axis=1)
    normal = jnp.stack([-opposite[..., 1], opposite[..., 0]], axis=-1)
    height = jnp.sum(normal * (corners - jnp.roll(corners, -1, axis=1)), axis=-1, keepdims=True)
    return normal / height
