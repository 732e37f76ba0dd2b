"""A sheet that hangs still: by which vertical, and what tension carries its weight where it was seen to lie.

A sheet on a bed lies as it would by itself. One that hangs has been seen stretched by its own weight: were the seen
shape taken for free of stress, the model would let it stretch once more. What its tension is follows from statics,
whatever its stiffness.
"""

import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float
from scipy.sparse.linalg import spsolve

from .environment import Weight
from .membrane import TriangleMembrane, Triangles
from .mesh import SheetMesh

ACROSS = 0.2
"""Share of gravity across a sheet that hangs, up to which the vertical is what is wrong."""
LOOSE = 1e-9
"""Share of the stiffest particle's that keeps the others from turning about the topmost."""


class Tension(Triangles):
    """Triangles under a second Piola-Kirchhoff stress S that does not depend on their strain: A S . E(x)."""

    stress: Float[Array, "f 3"]
    """S_11, S_22, S_12 [N/m]."""

    @classmethod
    def build(cls, mesh: SheetMesh, weight: Weight, *, poisson: float) -> "Tension":
        """What an elastic sheet in its plane has when its topmost particles alone hold it."""
        membrane = TriangleMembrane.build(mesh, stiffness=1.0, poisson=poisson)
        down = np.asarray(weight.gravity) / np.linalg.norm(weight.gravity)
        height = -mesh.rest @ down
        top = height > height.max() - mesh.spacing / 2
        plane = np.stack([np.cross(_normal(mesh), down), down], axis=1)
        B = _strain_matrix(mesh, membrane, plane)
        weights = np.asarray(membrane.area)[:, None, None] * np.asarray(membrane.elasticity)
        K = B.T @ sp.block_diag(weights, format="csr") @ B
        firm = K.diagonal().max()
        K += sp.diags_array(np.repeat(np.where(top, firm, LOOSE * firm), 2))
        u = spsolve(K.tocsc(), (np.asarray(weight.force) @ plane).ravel())
        strain = (B @ u).reshape(-1, 3)
        return cls(
            vertices=membrane.vertices,
            shape_gradient=membrane.shape_gradient,
            area=membrane.area,
            stress=jnp.einsum("fpq,fq->fp", membrane.elasticity, jnp.asarray(strain)),
        )

    def energy(self, x: Float[Array, "f 3 3"]) -> Float[Array, " f"]:
        """[J]."""
        return self.area * jnp.sum(self.stress * self.strain(x), axis=1)

    def gradient(self, x: Float[Array, "f 3 3"]) -> Float[Array, "f 3 3"]:
        """[N]."""
        return self.force(self.deformation(x), self.stress)

    def hessian(self, x: Float[Array, "f 3 3"]) -> Float[Array, "f 3 3 3 3"]:
        """The same wherever the sheet is [N/m]."""
        return self.area[:, None, None, None, None] * self.geometric(self.stress, compressive=True)

    def positive_hessian(self, x: Float[Array, "f 3 3"]) -> Float[Array, "f 3 3 3 3"]:
        """The same without what is compressed."""
        return self.area[:, None, None, None, None] * self.geometric(self.stress, compressive=False)


def as_it_hangs(mesh: SheetMesh, gravity: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"] | None:
    """Gravity turned into the mean plane of a sheet that hangs still, None if that is far from it [m/s^2].

    A camera and a robot agree on the vertical to a few degrees; a limp sheet hangs by it.
    """
    normal = _normal(mesh)
    within, size = gravity - (gravity @ normal) * normal, np.linalg.norm(gravity)
    return within * size / np.linalg.norm(within) if abs(gravity @ normal) < ACROSS * size else None


def _normal(mesh: SheetMesh) -> Float[np.ndarray, " 3"]:
    """Of the mean plane."""
    one, two, three = (mesh.rest[mesh.faces[:, k]] for k in range(3))
    normal = np.cross(two - one, three - one).sum(axis=0)
    return normal / np.linalg.norm(normal)


def _strain_matrix(mesh: SheetMesh, membrane: TriangleMembrane, plane: Float[np.ndarray, "3 2"]) -> sp.csr_array:
    """From small displacements along the plane's two axes to (E_11, E_22, 2 E_12) of each triangle [1/m]."""
    gradient = membrane.strain_gradient(membrane.deformation(jnp.asarray(mesh.rest[mesh.faces])))
    rows = np.einsum("faip,ij->fpaj", np.asarray(gradient, dtype=float), plane)
    column = np.broadcast_to((2 * mesh.faces[:, :, None] + np.arange(2))[:, None], rows.shape)
    row = np.broadcast_to(np.arange(3 * len(mesh.faces)).reshape(-1, 3, 1, 1), rows.shape)
    return sp.csr_array((rows.ravel(), (row.ravel(), column.ravel())), shape=(3 * len(mesh.faces), 2 * mesh.n))
