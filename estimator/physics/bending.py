"""Bending of the sheet: the quadratic isometric model over hinges [Bergou et al. 2006, doi:10.2312/SGP/SGP06/227-230].

It resists a change of the mean curvature only. A hinge of area A has the weight B / A, a third of the paper's 3 / A.
With that weight a sheet bent to a cylinder of curvature c stores B c^2 / 2 per area, as a plate does (a test measures
it). The rest curvature rotates with the hinge's normal, so a sheet that was measured with some roughness is in
equilibrium in its measured shape.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .energy import Term
from .mesh import SheetMesh


class IsometricBending(Term):
    """Hinges, one for each inner edge: 1/2 |sum_a w_a x_a - c n|^2 with n the hinge's unit normal."""

    vertices: Int[np.ndarray, "h 4"] | Int[Array, "h 4"]
    weight: Float[Array, "h 4"]
    """Cotangent weights times the square root of the hinge's stiffness [(N/m)^(1/2)]."""
    curvature: Float[Array, " h"]
    """Rest curvature c: the weighted sum along the normal at rest [J^(1/2)]."""
    facing: Float[Array, "h 2"]
    """Weight of each triangle in the hinge's normal, so that both have equal influence at rest [1/m^2]."""

    @classmethod
    def build(cls, mesh: SheetMesh, *, stiffness: float) -> "IsometricBending":
        """Build the hinges of a mesh; `stiffness` is the plate's B = E t^3 / (12 (1 - nu^2)) [N m]."""
        rest = mesh.rest[mesh.hinges]
        x0, x1, x2, x3 = np.moveaxis(rest, 1, 0)
        c01, c02 = _cotangent(x1 - x0, x2 - x0), _cotangent(x1 - x0, x3 - x0)
        c03, c04 = _cotangent(x0 - x1, x2 - x1), _cotangent(x0 - x1, x3 - x1)
        cotangent = np.stack([c03 + c04, c01 + c02, -c01 - c03, -c02 - c04], axis=1)
        first, second = np.cross(x1 - x0, x2 - x0), np.cross(x1 - x0, x3 - x0)
        area = 0.5 * (np.linalg.norm(first, axis=1) + np.linalg.norm(second, axis=1))
        weight = cotangent * np.sqrt(stiffness / area)[:, None]
        facing = 0.5 / np.stack([np.linalg.norm(first, axis=1), np.linalg.norm(second, axis=1)], axis=1)
        normal = np.asarray(_normal(jnp.asarray(rest), jnp.asarray(facing)))
        curvature = np.sum(np.einsum("ha,hai->hi", weight, rest) * normal, axis=1)
        return cls(
            vertices=mesh.hinges,
            weight=jnp.asarray(weight),
            curvature=jnp.asarray(curvature),
            facing=jnp.asarray(facing),
        )

    def energy(self, x: Float[Array, "h 4 3"]) -> Float[Array, " h"]:
        """Return the energy of each element [J]."""
        residual = jnp.einsum("ha,hai->hi", self.weight, x) - self.curvature[:, None] * _normal(x, self.facing)
        return 0.5 * jnp.sum(residual**2, axis=1)

    def gradient(self, x: Float[Array, "h 4 3"]) -> Float[Array, "h 4 3"]:
        """Return the derivative of each element's energy [N]."""
        edge, across = _sides(x, self.facing)
        normal = jnp.cross(edge, across)
        length = jnp.linalg.norm(normal, axis=1, keepdims=True)
        normal = normal / length
        residual = jnp.einsum("ha,hai->hi", self.weight, x) - self.curvature[:, None] * normal
        tangential = residual - jnp.sum(residual * normal, axis=1, keepdims=True) * normal
        by_normal = self.curvature[:, None] / length * tangential
        by_edge, by_across = jnp.cross(across, by_normal), jnp.cross(by_normal, edge)
        first, second = self.facing[:, :1] * by_across, self.facing[:, 1:] * by_across
        direct = self.weight[:, :, None] * residual[:, None, :]
        return direct - jnp.stack([second - first - by_edge, by_edge, first, -second], axis=1)

    def curvature_at(self, x: Float[Array, "h 4 3"]) -> Float[Array, " h"]:
        """Return the weighted sum along each hinge's normal, which is c at rest [J^(1/2)]."""
        return jnp.sum(jnp.einsum("ha,hai->hi", self.weight, x) * _normal(x, self.facing), axis=1)

    def positive_hessian(self, x: Float[Array, "h 4 3"]) -> Float[Array, "h 4 3 4 3"]:
        """Return the Hessian of a flat rest shape, which is positive semi-definite [N/m]."""
        return jnp.einsum("ha,hb,ij->haibj", self.weight, self.weight, jnp.eye(3, dtype=x.dtype))


def _normal(x: Float[Array, "h 4 3"], facing: Float[Array, "h 2"]) -> Float[Array, "h 3"]:
    """Return the unit mean normal of a hinge's two triangles; with equal weights, a bent hinge pulls along it."""
    normal = jnp.cross(*_sides(x, facing))
    return normal / jnp.linalg.norm(normal, axis=1, keepdims=True)


def _sides(x: Float[Array, "h 4 3"], facing: Float[Array, "h 2"]) -> tuple[Float[Array, "h 3"], Float[Array, "h 3"]]:
    """Return two vectors whose cross product is along the mean normal: the hinge's edge and one across it."""
    across = facing[:, :1] * (x[:, 2] - x[:, 0]) - facing[:, 1:] * (x[:, 3] - x[:, 0])
    return x[:, 1] - x[:, 0], across


def _cotangent(u: Float[np.ndarray, "h 3"], v: Float[np.ndarray, "h 3"]) -> Float[np.ndarray, " h"]:
    """Return the cotangent of the angle between two vectors."""
    return np.sum(u * v, axis=1) / np.linalg.norm(np.cross(u, v), axis=1)
