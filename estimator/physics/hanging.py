"""A sheet that hangs still: the vertical it hangs by, and the tension that supports its weight in its measured shape.

A sheet on a bed is measured in its stress-free shape. A hanging sheet is measured already stretched by its own weight:
if that shape counted as stress-free, the model would stretch it again. Statics alone give the tension, whatever the
stiffness.
"""

import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float
from scipy.sparse.linalg import spsolve

from .environment import Weight
from .membrane import TriangleMembrane, Triangles
from .mesh import SheetMesh

MAX_NORMAL_GRAVITY = 0.2
"""Component of gravity along the sheet's normal below which the sheet hangs, and the component is an error of the
vertical [gravity]: about 12 degrees."""
TOP_BAND = 0.5
"""Depth below the highest particle within which particles hold the sheet [spacing]."""
TETHER_STIFFNESS = 1e-9
"""Stiffness of weak springs that keep the other particles from rotating about the topmost ones [stiffest particle]."""


class Tension(Triangles):
    """Triangles under a second Piola-Kirchhoff stress S that does not depend on their strain: A S . E(x)."""

    stress: Float[Array, "f 3"]
    """Stress (S_11, S_22, S_12) [N/m]."""

    @classmethod
    def build(cls, mesh: SheetMesh, weight: Weight, *, poisson: float) -> "Tension":
        """Build the tension of an elastic sheet in its plane when its topmost particles alone hold it."""
        membrane = TriangleMembrane.build(mesh, stiffness=1.0, poisson=poisson)
        down = np.asarray(weight.gravity) / np.linalg.norm(weight.gravity)
        height = -mesh.rest @ down
        top = height > height.max() - TOP_BAND * mesh.spacing
        plane = np.stack([np.cross(_normal(mesh), down), down], axis=1)
        B = _strain_matrix(mesh, membrane, plane)
        weights = np.asarray(membrane.area)[:, None, None] * np.asarray(membrane.elasticity)
        K = B.T @ sp.block_diag([sp.coo_array(each) for each in weights], format="csr") @ B
        stiffest = K.diagonal().max()
        K += sp.diags_array(np.repeat(np.where(top, stiffest, TETHER_STIFFNESS * stiffest), 2))
        u = spsolve(K.tocsc(), (np.asarray(weight.force) @ plane).ravel())
        strain = (B @ u).reshape(-1, 3)
        return cls(
            vertices=membrane.vertices,
            shape_gradient=membrane.shape_gradient,
            area=membrane.area,
            stress=jnp.einsum("fpq,fq->fp", membrane.elasticity, jnp.asarray(strain)),
        )

    def energy(self, x: Float[Array, "f 3 3"]) -> Float[Array, " f"]:
        """Return the energy of each element [J]."""
        return self.area * jnp.sum(self.stress * self.strain(x), axis=1)

    def gradient(self, x: Float[Array, "f 3 3"]) -> Float[Array, "f 3 3"]:
        """Return the derivative of each element's energy [N]."""
        return self.force(self.deformation(x), self.stress)

    def hessian(self, x: Float[Array, "f 3 3"]) -> Float[Array, "f 3 3 3 3"]:
        """Return the Hessian, which does not depend on x [N/m]."""
        return self.area[:, None, None, None, None] * self.geometric(self.stress, compressive=True)

    def positive_hessian(self, x: Float[Array, "f 3 3"]) -> Float[Array, "f 3 3 3 3"]:
        """Return the Hessian without compressive principal stresses [N/m]."""
        return self.area[:, None, None, None, None] * self.geometric(self.stress, compressive=False)


def hanging_gravity(mesh: SheetMesh, gravity: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"] | None:
    """Return gravity rotated into the mean plane of a hanging sheet [m/s^2]; None if the plane is not near vertical.

    A camera and a robot agree on the vertical to a few degrees; a limp sheet hangs along it.
    """
    normal = _normal(mesh)
    within, size = gravity - (gravity @ normal) * normal, np.linalg.norm(gravity)
    return within * size / np.linalg.norm(within) if abs(gravity @ normal) < MAX_NORMAL_GRAVITY * size else None


def _normal(mesh: SheetMesh) -> Float[np.ndarray, " 3"]:
    """Return the unit normal of the mean plane."""
    a, b, c = (mesh.rest[mesh.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a).sum(axis=0)
    return normal / np.linalg.norm(normal)


def _strain_matrix(mesh: SheetMesh, membrane: TriangleMembrane, plane: Float[np.ndarray, "3 2"]) -> sp.csr_array:
    """Return the matrix from small displacements in the plane to (E_11, E_22, 2 E_12) of each triangle [1/m]."""
    gradient = membrane.strain_gradient(membrane.deformation(jnp.asarray(mesh.rest[mesh.faces])))
    rows = np.einsum("faip,ij->fpaj", np.asarray(gradient, dtype=float), plane)
    column = np.broadcast_to((2 * mesh.faces[:, :, None] + np.arange(2))[:, None], rows.shape)
    row = np.broadcast_to(np.arange(3 * len(mesh.faces)).reshape(-1, 3, 1, 1), rows.shape)
    return sp.csr_array((rows.ravel(), (row.ravel(), column.ravel())), shape=(3 * len(mesh.faces), 2 * mesh.n))
