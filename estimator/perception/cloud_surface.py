"""What a cloud without identities says of each particle at a given state of the sheet.

A point says how far the surface is from it along the surface's normal, and nothing of where along the surface it
belongs [point to plane: Chen & Medioni 1992, doi:10.1016/0262-8856(92)90066-C]. The outline of the cloud says where
the sheet's edge is, across the edge and within the surface. So the precision of a particle has rank one inside the
sheet and two on its edge, as far as points show them, and the sheet may slide within its own surface as far as its
edge allows.

A point's height above the triangle below it is shared among the corners by their barycentric weights. The outermost
point beside an edge lies inside of it by a gap, which is measured while the sheet is at rest: its mean for each edge,
its spread over all. Points and edges that are further off than `GATE` times the spread of most, found anew at each
state, are taken for other things: the tool, the ground, a hidden part of the sheet.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..physics.mesh import SheetMesh

GATE = 4.0
"""Distance beyond which a point is of something else [robust standard deviations]."""
NORMAL_MEDIAN = 0.6745
"""Median of the absolute value of a standard normal variable."""
REACH = 2.0
"""Largest height above the surface at which a point is looked at [spacing]."""
MAX_OUTSIDE = 0.3
"""How far outside of its triangle a point may lie, as the negative of its smallest barycentric weight [1]."""
BORDER_REACH = 1.5
"""Largest distance from an edge of the outline, to either side, at which a point is looked at [spacing]."""


class CloudSurface(eqx.Module):
    """The mesh as the surface that clouds are matched to."""

    faces: Int[Array, "f 3"]
    """Particles of each triangle."""
    around: Int[Array, "n d"]
    """Triangles at each particle; the first is repeated where there are fewer."""
    border: Int[Array, "e 2"]
    """Particles of each edge of the outline, in the order of its triangle."""
    border_face: Int[Array, " e"]
    """Triangle of each edge of the outline."""
    spacing: Float[Array, ""]
    """Median edge length [m]."""
    gap: Float[Array, " e"]
    """Mean distance by which the outermost point beside an edge lies inside of it [m]."""
    gap_sd: Float[Array, ""]
    """Standard deviation of that distance [m]."""

    @classmethod
    def build(cls, mesh: SheetMesh, still: list[Float[np.ndarray, "_q 3"]], *, sd: float) -> "CloudSurface":
        """Prepare the surface, and measure the gaps at its outline.

        Args:
            mesh: the sheet at rest.
            still: clouds of it at rest, without NaN [m].
            sd: standard deviation of their coordinates [m].
        """
        corner, face = mesh.faces.ravel(), np.repeat(np.arange(len(mesh.faces)), 3)
        order = np.argsort(corner, kind="stable")
        at = np.split(face[order], np.cumsum(np.bincount(corner, minlength=mesh.n))[:-1])
        width = max(map(len, at))
        edges, edge_face = mesh.border_edges
        surface = cls(
            faces=jnp.asarray(mesh.faces),
            around=jnp.asarray([np.concatenate([one, np.full(width - len(one), one[0])]) for one in at]),
            border=jnp.asarray(edges),
            border_face=jnp.asarray(edge_face),
            spacing=jnp.asarray(mesh.spacing),
            gap=jnp.zeros(len(edges)),
            gap_sd=jnp.asarray(mesh.spacing),
        )
        beyond = [_outermost(surface, jnp.asarray(cloud), jnp.asarray(mesh.rest), GATE * sd) for cloud in still]
        gap, gap_sd = _gaps(-np.asarray(beyond), spacing=mesh.spacing)
        return eqx.tree_at(lambda s: (s.gap, s.gap_sd), surface, (jnp.asarray(gap), jnp.asarray(gap_sd)))


class Cloud(eqx.Module):
    """One cloud, to be matched to the surface at any state."""

    surface: CloudSurface
    """What it is matched to."""
    points: Float[Array, "q 3"]
    """Positions [m]; rows of NaN are none."""
    sd: Float[Array, ""]
    """Standard deviation of each coordinate [m]."""
    sd_ratio: Float[Array, ""]
    """Factor on the standard deviations of points and outline that was learned [1]."""

    def matched(
        self, x: Float[Array, "n 3"], held: Bool[Array, " n"], *, gate: float = 0.0
    ) -> tuple[Float[Array, "n 3"], Float[Array, "n 3 3"]]:
        """Return the precision of each particle times its displacement from x [1/m], and the precision [1/m^2].

        Args:
            x: the state [m].
            held: particles in the jaws; the outline beside them does not count, as the jaws are in its way.
            gate: height up to which points count in any case [spacing].
        """
        normal, (face, weights, height, counts, spread) = _normals(self.surface, x), self._heights(x, gate)
        corners = self.surface.faces[face]
        share = jnp.where(counts[:, None], jnp.clip(weights, 0, 1), 0.0) / (self.sd_ratio * self.sd) ** 2
        weight = jnp.zeros(len(x)).at[corners].add(share)
        above = jnp.zeros(len(x)).at[corners].add(share * height[:, None])
        precision = weight[:, None, None] * normal[:, :, None] * normal[:, None, :]
        outward, beyond, edge_weight = self._edges(x, GATE * spread)
        edge_weight = jnp.where(held[self.surface.border].any(axis=1), 0.0, edge_weight)
        edge = edge_weight[:, None, None] * outward[:, :, None] * outward[:, None, :]
        pull = (
            (above[:, None] * normal)
            .at[self.surface.border]
            .add((edge_weight * beyond)[:, None, None] * outward[:, None])
        )
        return pull, precision.at[self.surface.border].add(edge[:, None])

    def belongs(self, x: Float[Array, "n 3"]) -> Bool[Array, " q"]:
        """Return which points lie on the surface at a state."""
        return self._heights(x, 0.0)[3]

    def _heights(
        self, x: Float[Array, "n 3"], gate: float
    ) -> tuple[Int[Array, " q"], Float[Array, "q 3"], Float[Array, " q"], Bool[Array, " q"], Float[Array, ""]]:
        """Return each point's triangle, weights, height [m] and whether it counts, and the heights' spread [m]."""
        surface, known = self.surface, jnp.isfinite(self.points).all(axis=1)
        points = jnp.where(known[:, None], self.points, 0.0)
        face, weights = _below(surface, points, x)
        a, b, c = jnp.moveaxis(x[surface.faces[face]], 1, 0)
        normal = _unit(jnp.cross(b - a, c - a))
        height = jnp.sum((points - a) * normal, axis=1)
        near = known & (jnp.min(weights, axis=1) > -MAX_OUTSIDE) & (jnp.abs(height) < REACH * surface.spacing)
        spread = _spread(height, near, at_least=self.sd)
        counts = near & (jnp.abs(height) < jnp.maximum(GATE * spread, gate * surface.spacing))
        return face, weights, height, counts, spread

    def _edges(
        self, x: Float[Array, "n 3"], thickness: Float[Array, ""]
    ) -> tuple[Float[Array, "e 3"], Float[Array, " e"], Float[Array, " e"]]:
        """Return each outline edge's outward direction, how far out the cloud has it [m], and either end's weight."""
        surface = self.surface
        beyond = _outermost(surface, self.points, x, thickness) + surface.gap
        shown = jnp.isfinite(beyond)
        beyond = jnp.where(shown, beyond, 0.0)
        shown = shown & (jnp.abs(beyond) < GATE * _spread(beyond, shown, at_least=surface.gap_sd))
        weight = jnp.where(shown, 0.5 / (self.sd_ratio * surface.gap_sd) ** 2, 0.0)
        return _outward(surface, x), beyond, weight


def _gaps(gaps: Float[np.ndarray, "t e"], *, spacing: float) -> tuple[Float[np.ndarray, " e"], float]:
    """Return each edge's mean gap over the clouds at rest [m], NaN where none shows it, and the gaps' spread [m].

    Where a single cloud is at rest the gaps' mean stands for their spread, as both are equal for points that are
    spread at random.
    """
    shown = np.isfinite(gaps)
    count = shown.sum(axis=0)
    mean = np.where(count > 0, np.where(shown, gaps, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)
    left = np.where(shown, gaps - mean, 0.0)
    degrees = np.maximum(count - 1, 0).sum()
    if degrees:
        return mean, float(np.sqrt(np.sum(left**2) / degrees))
    return mean, float(np.abs(mean[count > 0]).mean()) if (count > 0).any() else spacing


def _below(
    surface: CloudSurface, points: Float[Array, "q 3"], x: Float[Array, "n 3"]
) -> tuple[Int[Array, " q"], Float[Array, "q 3"]]:
    """Return the triangle below each point, of those at the nearest particle, and its barycentric weights there."""
    squared = jnp.sum(x**2, axis=1)[None] - 2 * points @ x.T
    faces = surface.around[jnp.argmin(squared, axis=1)]
    a, b, c = jnp.moveaxis(x[surface.faces[faces]], 2, 0)
    u, v, p = b - a, c - a, points[:, None] - a
    uu, uv, vv, pu, pv = (jnp.sum(i * j, axis=2) for i, j in ((u, u), (u, v), (v, v), (p, u), (p, v)))
    second, third = (vv * pu - uv * pv) / (uu * vv - uv**2), (uu * pv - uv * pu) / (uu * vv - uv**2)
    weights = jnp.stack([1 - second - third, second, third], axis=2)
    rows, best = jnp.arange(len(points)), jnp.argmax(jnp.min(weights, axis=2), axis=1)
    return faces[rows, best], weights[rows, best]


def _outermost(
    surface: CloudSurface, points: Float[Array, "q 3"], x: Float[Array, "n 3"], thickness: Float[Array, ""] | float
) -> Float[Array, " e"]:
    """Return how far outside of each outline edge the outermost point beside it lies [m]; -inf where there is none.

    Beside it are points in the strip between its ends and within `thickness` of its triangle's plane [m].
    """
    outward, start = _outward(surface, x), x[surface.border[:, 0]]
    along = x[surface.border[:, 1]] - start
    normal = _unit(jnp.cross(outward, along))
    share, across, height = (
        points @ axis.T - jnp.sum(start * axis, axis=1)[None]
        for axis in (along / jnp.sum(along**2, axis=1)[:, None], outward, normal)
    )
    beside = (share >= 0) & (share <= 1) & (jnp.abs(height) < thickness)
    return jnp.max(jnp.where(beside & (jnp.abs(across) < BORDER_REACH * surface.spacing), across, -jnp.inf), axis=0)


def _outward(surface: CloudSurface, x: Float[Array, "n 3"]) -> Float[Array, "e 3"]:
    """Return the unit vector across each edge of the outline, out of the sheet and within its surface."""
    a, b, c = jnp.moveaxis(x[surface.faces[surface.border_face]], 1, 0)
    along = x[surface.border[:, 1]] - x[surface.border[:, 0]]
    return _unit(jnp.cross(along, jnp.cross(b - a, c - a)))


def _normals(surface: CloudSurface, x: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Return the unit normal of the surface at each particle, by the areas of the triangles around it."""
    a, b, c = jnp.moveaxis(x[surface.faces], 1, 0)
    return _unit(jnp.zeros_like(x).at[surface.faces].add(jnp.cross(b - a, c - a)[:, None]))


def _unit(v: Float[Array, "m 3"]) -> Float[Array, "m 3"]:
    """Return vectors of length 1."""
    return v / jnp.linalg.norm(v, axis=1, keepdims=True)


def _spread(values: Float[Array, " m"], counts: Bool[Array, " m"], *, at_least: Float[Array, ""]) -> Float[Array, ""]:
    """Return the standard deviation of values about 0 by the median of their size, which a minority leaves alone."""
    median = jnp.nanmedian(jnp.where(counts, jnp.abs(values), jnp.nan))
    return jnp.maximum(at_least, jnp.where(jnp.isfinite(median), median, 0.0) / NORMAL_MEDIAN)
