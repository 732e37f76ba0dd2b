"""Which material of the sheet is seen in each particle's place: its own, or what a tracker has slid to.

A place is a point of the plane that the sheet's two material axes span in the mean; a sheet that lies far from flat is
not unrolled.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

BEYOND = 1e-3
"""How far beyond a side a point may be, by the triangle's height: from the outline particles may go either way."""


class SurfacePoints(eqx.Module):
    """A point of the sheet for each particle, in one of its triangles.

    Between the corners of a triangle the sheet is a cubic Bezier patch with its derivatives there [PN triangles:
    Vlachos et al. 2001, doi:10.1145/364338.364387]: exact where it is quadratic, and smooth at the particles.
    """

    corners: Int[Array, "n 3"]
    weights: Float[Array, "n 3"]
    """Barycentric."""
    sides: Float[Array, "n 3 3 2"]
    """From each corner to each, in the sheet [m]."""

    @classmethod
    def themselves(cls, n: int) -> "SurfacePoints":
        """The particles."""
        return cls(
            corners=jnp.broadcast_to(jnp.arange(n)[:, None], (n, 3)),
            weights=jnp.broadcast_to(jnp.asarray([1.0, 0.0, 0.0]), (n, 3)),
            sides=jnp.zeros((n, 3, 3, 2)),
        )

    @classmethod
    def at(cls, triangles: Int[Array, "f 3"], place: Float[Array, "n 2"], to: Float[Array, "n 2"]) -> "SurfacePoints":
        """Material at places [m], where particles are at `place`; what is beyond the outline stops near it."""
        slope, first = _slopes(place[triangles]), jnp.eye(3)[:1]

        def own(at: Float[Array, "n 2"]) -> Int[Array, " n"]:
            every = jnp.broadcast_to(jnp.arange(len(triangles))[:, None], triangles.shape)
            return jnp.zeros(len(at), dtype=every.dtype).at[triangles].set(every)

        def around(at: Float[Array, "n 2"]) -> Int[Array, " n"]:
            start = jnp.einsum("fka,fa->fk", slope, place[triangles[:, 0]]) - first
            return jnp.argmax(jnp.min(jnp.einsum("fka,na->nfk", slope, at) - start[None], axis=2), axis=1)

        still = jax.lax.stop_gradient(to)
        triangle = jax.lax.cond(jnp.all(still == place), own, around, still)
        corners = triangles[triangle]
        weights = first + jnp.einsum("nka,na->nk", slope[triangle], to - place[corners[:, 0]])
        weights = jnp.maximum(weights, -BEYOND)
        return cls(
            corners=corners,
            weights=weights / jnp.sum(weights, axis=1, keepdims=True),
            sides=place[corners][:, None] - place[corners][:, :, None],
        )

    def __call__(self, x: Float[Array, "n 3"], tangents: Float[Array, "n 3 2"]) -> Float[Array, "n 3"]:
        """Where they are, for particles at x [m] and the sheet's derivatives there along its material axes."""
        w, at = self.weights, x[self.corners]
        edges = at[:, :, None] + jnp.einsum("nkia,nkja->nkji", tangents[self.corners], self.sides) / 3
        middle = jnp.sum(edges, axis=(1, 2)) / 4 - jnp.sum(at, axis=1) * 5 / 12
        share = w[:, :, None] ** 2 * w[:, None] * (3 - 2 * jnp.eye(3)[None])
        return jnp.einsum("nkj,nkji->ni", share, edges) + 6 * jnp.prod(w, axis=1)[:, None] * middle


def _slopes(corners: Float[Array, "f 3 2"]) -> Float[Array, "f 3 2"]:
    """Derivatives of barycentric coordinates [1/m]."""
    opposite = jnp.roll(corners, -2, axis=1) - jnp.roll(corners, -1, axis=1)
    across = jnp.stack([-opposite[..., 1], opposite[..., 0]], axis=-1)
    height = jnp.sum(across * (corners - jnp.roll(corners, -1, axis=1)), axis=-1, keepdims=True)
    return across / height
