"""Bending of the sheet: the quadratic isometric model over hinges [Bergou et al. 2006, doi:10.2312/SGP/SGP06/227-230].

Linear in the positions, so its Hessian is constant and positive semi-definite. The rest shape is flat. It resists the
mean curvature only. A hinge of area A weighs B / A, a third of the paper's 3 / A: with that a sheet bent to a cylinder
of curvature c stores B c^2 / 2 per area, as a plate does (a test measures it).
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jiggle_mj.estimator.energy import Term
from jiggle_mj.estimator.mesh import SheetMesh


class IsometricBending(Term):
    """One hinge an inner edge: 1/2 |sum_a w_a x_a|^2."""

    vertices: Int[np.ndarray, "h 4"] | Int[Array, "h 4"]
    weight: Float[Array, "h 4"]
    """Cotangent weights times the square root of the hinge's stiffness [(N/m)^(1/2)]."""

    @classmethod
    def build(cls, mesh: SheetMesh, *, stiffness: float) -> "IsometricBending":
        """Hinges of the mesh; stiffness is the plate's B = E t^3 / (12 (1 - nu^2)) [N m]."""
        x0, x1, x2, x3 = np.moveaxis(mesh.rest[mesh.hinges], 1, 0)
        c01, c02 = _cotangent(x1 - x0, x2 - x0), _cotangent(x1 - x0, x3 - x0)
        c03, c04 = _cotangent(x0 - x1, x2 - x1), _cotangent(x0 - x1, x3 - x1)
        cotangent = np.stack([c03 + c04, c01 + c02, -c01 - c03, -c02 - c04], axis=1)
        area = 0.5 * (np.linalg.norm(np.cross(x1 - x0, x2 - x0), axis=1) + np.linalg.norm(np.cross(x1 - x0, x3 - x0), axis=1))
        return cls(vertices=mesh.hinges, weight=jnp.asarray(cotangent * np.sqrt(stiffness / area)[:, None]))

    def energy(self, x: Float[Array, "h 4 3"]) -> Float[Array, " h"]:
        """Squared weighted sum of the four positions [J]."""
        return 0.5 * jnp.sum(jnp.einsum("ha,hai->hi", self.weight, x) ** 2, axis=1)

    def gradient(self, x: Float[Array, "h 4 3"]) -> Float[Array, "h 4 3"]:
        """[N]."""
        return jnp.einsum("ha,hb,hbi->hai", self.weight, self.weight, x)

    def hessian(self, x: Float[Array, "h 4 3"]) -> Float[Array, "h 4 3 4 3"]:
        """[N/m]."""
        return jnp.einsum("ha,hb,ij->haibj", self.weight, self.weight, jnp.eye(3, dtype=x.dtype))

    def positive_hessian(self, x: Float[Array, "h 4 3"]) -> Float[Array, "h 4 3 4 3"]:
        """The Hessian, which is semi-definite already."""
        return self.hessian(x)



def _cotangent(u: Float[np.ndarray, "h 3"], v: Float[np.ndarray, "h 3"]) -> Float[np.ndarray, " h"]:
    """Cotangent of the angle between two vectors."""
    return np.sum(u * v, axis=1) / np.linalg.norm(np.cross(u, v), axis=1)
