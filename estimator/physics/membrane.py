"""In-plane elasticity of the sheet: St Venant-Kirchhoff triangles, or springs along the edges as in the paper.

Both are `Term`s of the energy and take one membrane stiffness k = Young's modulus x thickness [N/m]. Neither resists
bending. Valid for small strains and large rotations.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .energy import Term
from .mesh import SheetMesh


class Triangles(Term):
    """Triangles with a constant deformation gradient F from their rest shape to their present one."""

    vertices: Int[np.ndarray, "f 3"] | Int[Array, "f 3"]
    shape_gradient: Float[Array, "f 3 2"]
    """Derivative N of each corner's shape function along the two material axes [1/m]."""
    area: Float[Array, " f"]
    """Rest area [m^2]."""

    def deformation(self, x: Float[Array, "f 3 3"]) -> Float[Array, "f 3 2"]:
        """Return the deformation gradient F of each triangle."""
        return jnp.einsum("fai,fak->fik", x, self.shape_gradient)

    def strain(self, x: Float[Array, "f 3 3"]) -> Float[Array, "f 3"]:
        """Return the total Green strain, elastic or not: (E_11, E_22, 2 E_12)."""
        return _green(self.deformation(x))

    def strain_gradient(self, F: Float[Array, "f 3 2"]) -> Float[Array, "f 3 3 3"]:
        """Return the derivative of each strain (last axis) by the corners' coordinates [1/m]."""
        N = self.shape_gradient
        shear = jnp.einsum("fi,fa->fai", F[:, :, 0], N[:, :, 1]) + jnp.einsum("fi,fa->fai", F[:, :, 1], N[:, :, 0])
        return jnp.stack([*(jnp.einsum("fi,fa->fai", F[:, :, k], N[:, :, k]) for k in (0, 1)), shear], axis=-1)

    def force(self, F: Float[Array, "f 3 2"], stress: Float[Array, "f 3"]) -> Float[Array, "f 3 3"]:
        """Return A F S grad N [N] of second Piola-Kirchhoff stresses (S_11, S_22, S_12) [N/m]."""
        return self.area[:, None, None] * jnp.einsum("fik,fkl,fal->fai", F, _matrix(stress), self.shape_gradient)

    def geometric(self, stress: Float[Array, "f 3"], *, compressive: bool) -> Float[Array, "f 3 3 3 3"]:
        """Return the geometric stiffness of a stress per area [N/m^3], of its tensile part unless `compressive`."""
        N, S = self.shape_gradient, _matrix(stress) if compressive else _tensile(_matrix(stress))
        return jnp.einsum("fak,fkl,fbl,ij->faibj", N, S, N, jnp.eye(3, dtype=N.dtype))


class TriangleMembrane(Triangles):
    """Constant-strain triangles in plane stress, St Venant-Kirchhoff as built.

    With F the deformation gradient, E = (F^T F - I) / 2 - E_0 as (E_11, E_22, 2 E_12), and w = E.C E / k, a triangle of
    rest area A stores A k / 2 (w + a w^2 / 2): C is the elasticity, E_0 a stress-free strain, a the stiffening. Axis 1
    lies in the triangle and follows a world axis, the same for all triangles.
    """

    stiffness: Float[Array, ""]
    """Membrane stiffness k [N/m]."""
    poisson: Float[Array, ""]
    """Poisson's ratio nu."""
    elasticity: Float[Array, "f 3 3"]
    """Elasticity C of each triangle [N/m]."""
    inelastic: Float[Array, "f 3"]
    """Stress-free strain E_0 of each triangle."""
    stiffening: Float[Array, ""]
    """Stiffening a."""

    @classmethod
    def build(cls, mesh: SheetMesh, *, stiffness: float, poisson: float) -> "TriangleMembrane":
        """Build isotropic triangles from the mesh at rest: C E = k / (1 - nu^2) ((1 - nu) E + nu tr(E) I)."""
        a, b, c = np.moveaxis(mesh.rest[mesh.faces], 1, 0)
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        axis = material_axis(normal.mean(axis=0))
        first = axis - (normal @ axis)[:, None] * normal
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        second = np.cross(normal, first)
        material = np.stack([b - a, c - a], axis=-1)
        flat = np.stack([first, second], axis=1) @ material
        inverse = np.linalg.inv(flat)
        gradient = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
        m = len(mesh.faces)
        return cls(
            vertices=mesh.faces,
            shape_gradient=jnp.asarray(gradient),
            area=jnp.asarray(mesh.face_area),
            stiffness=jnp.asarray(stiffness, dtype=float),
            poisson=jnp.asarray(poisson, dtype=float),
            elasticity=jnp.broadcast_to(stiffness * plane_stress(poisson), (m, 3, 3)),
            inelastic=jnp.zeros((m, 3)),
            stiffening=jnp.zeros(()),
        )

    def energy(self, x: Float[Array, "f 3 3"]) -> Float[Array, " f"]:
        """Return the energy of each element [J]."""
        strain = self.strain(x) - self.inelastic
        w = jnp.einsum("fp,fpq,fq->f", strain, self.elasticity, strain) / self.stiffness
        return 0.5 * self.area * self.stiffness * (w + 0.5 * self.stiffening * w**2)

    def gradient(self, x: Float[Array, "f 3 3"]) -> Float[Array, "f 3 3"]:
        """Return A F S grad N [N]."""
        F = self.deformation(x)
        stress, _, _ = self._stress(F)
        return self.force(F, stress)

    def hessian(self, x: Float[Array, "f 3 3"]) -> Float[Array, "f 3 3 3 3"]:
        """Return the material and geometric stiffness [N/m]."""
        return self._tangent(x, compressive=True)

    def positive_hessian(self, x: Float[Array, "f 3 3"]) -> Float[Array, "f 3 3 3 3"]:
        """Return the Hessian without compressive principal stresses [N/m]: its geometric part is semi-definite."""
        return self._tangent(x, compressive=False)

    def _stress(self, F: Float[Array, "f 3 2"]) -> tuple[Float[Array, "f 3"], Float[Array, "f 3"], Float[Array, " f"]]:
        """Return S = (1 + a w) C E [N/m], C E [N/m], and 1 + a w."""
        strain = _green(F) - self.inelastic
        linear = jnp.einsum("fpq,fq->fp", self.elasticity, strain)
        stiffer = 1 + self.stiffening * jnp.sum(strain * linear, axis=1) / self.stiffness
        return stiffer[:, None] * linear, linear, stiffer

    def _tangent(self, x: Float[Array, "f 3 3"], *, compressive: bool) -> Float[Array, "f 3 3 3 3"]:
        """Return the Hessian [N/m], without compressive principal stresses unless `compressive`."""
        F = self.deformation(x)
        stress, linear, stiffer = self._stress(F)
        tangent = stiffer[:, None, None] * self.elasticity
        tangent = tangent + 2 * self.stiffening / self.stiffness * linear[:, :, None] * linear[:, None, :]
        variation = self.strain_gradient(F)
        material = jnp.einsum("faip,fpq,fbjq->faibj", variation, tangent, variation)
        return self.area[:, None, None, None, None] * (material + self.geometric(stress, compressive=compressive))


def plane_stress(poisson: float | Float[Array, ""]) -> Float[Array, "3 3"]:
    """Return C / k of an isotropic sheet, over (E_11, E_22, 2 E_12)."""
    return jnp.array([[1, poisson, 0], [poisson, 1, 0], [0, 0, (1 - poisson) / 2]]) / (1 - poisson**2)


class EdgeMembrane(Term):
    """Distance springs along the edges, the paper's C_m, with Van Gelder's stiffness.

    Edge e of rest length l between triangles of area A_1, A_2 gets k_e = k (A_1 + A_2) / l^2 [Van Gelder 1998,
    Journal of Graphics Tools 3(2)]: exact for equilateral triangles and Poisson's ratio 1/3, the ratio of such springs.
    """

    vertices: Int[np.ndarray, "e 2"] | Int[Array, "e 2"]
    length: Float[Array, " e"]
    """Rest length [m]."""
    stiffness: Float[Array, " e"]
    """Stiffness k_e [N/m]."""

    @classmethod
    def build(cls, mesh: SheetMesh, *, stiffness: float) -> "EdgeMembrane":
        """Build springs on every edge of the mesh."""
        length = np.linalg.norm(mesh.rest[mesh.edges[:, 0]] - mesh.rest[mesh.edges[:, 1]], axis=1)
        number = {tuple(edge): i for i, edge in enumerate(mesh.edges.tolist())}
        area = np.zeros(len(mesh.edges))
        for face, size in zip(mesh.faces.tolist(), mesh.face_area, strict=True):
            for a, b in zip(face, face[1:] + face[:1], strict=True):
                area[number[min(a, b), max(a, b)]] += size
        return cls(vertices=mesh.edges, length=jnp.asarray(length), stiffness=jnp.asarray(stiffness * area / length**2))

    def energy(self, x: Float[Array, "e 2 3"]) -> Float[Array, " e"]:
        """Return k_e/2 (|x_1 - x_0| - l)^2 of each edge [J]."""
        return 0.5 * self.stiffness * (jnp.linalg.norm(x[:, 1] - x[:, 0], axis=1) - self.length) ** 2

    def hessian(self, x: Float[Array, "e 2 3"]) -> Float[Array, "e 2 3 2 3"]:
        """Return the Hessian: k_e along the edge, k_e (1 - l/|d|) across it [N/m]."""
        return self._tangent(x, compressive=True)

    def positive_hessian(self, x: Float[Array, "e 2 3"]) -> Float[Array, "e 2 3 2 3"]:
        """Return the Hessian without the negative stiffness across a compressed edge [N/m]."""
        return self._tangent(x, compressive=False)

    def _tangent(self, x: Float[Array, "e 2 3"], *, compressive: bool) -> Float[Array, "e 2 3 2 3"]:
        """Return the Hessian [N/m], without negative stiffness across compressed edges unless `compressive`."""
        d = x[:, 1] - x[:, 0]
        length = jnp.linalg.norm(d, axis=1)
        along = jnp.einsum("ei,ej->eij", d, d) / length[:, None, None] ** 2
        across = 1 - self.length / length
        across = across if compressive else jnp.maximum(across, 0)
        window = along + across[:, None, None] * (jnp.eye(3, dtype=x.dtype)[None] - along)
        sign = jnp.array([[1.0, -1.0], [-1.0, 1.0]], dtype=x.dtype)
        return jnp.einsum("e,ab,eij->eaibj", self.stiffness, sign, window)


def material_axis(normal: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """Return the world axis that material axis 1 follows: x, or y if the normal is nearer to x than to y and z."""
    return np.eye(3)[0 if abs(normal[0]) <= max(abs(normal[1]), abs(normal[2])) else 1]


def _green(F: Float[Array, "f 3 2"]) -> Float[Array, "f 3"]:
    """Return the Green strain (F^T F - I) / 2 as (E_11, E_22, 2 E_12)."""
    metric = jnp.einsum("fik,fil->fkl", F, F)
    return jnp.stack([0.5 * (metric[:, 0, 0] - 1), 0.5 * (metric[:, 1, 1] - 1), metric[:, 0, 1]], axis=1)


def _matrix(stress: Float[Array, "f 3"]) -> Float[Array, "f 2 2"]:
    """Return (S_11, S_22, S_12) as symmetric matrices."""
    return stress[:, jnp.array([[0, 2], [2, 1]])]


def _tensile(stress: Float[Array, "f 2 2"]) -> Float[Array, "f 2 2"]:
    """Return symmetric 2x2 matrices with negative eigenvalues set to zero, in closed form."""
    mean = 0.5 * (stress[:, 0, 0] + stress[:, 1, 1])
    deviator = stress - mean[:, None, None] * jnp.eye(2, dtype=stress.dtype)[None]
    radius = jnp.sqrt(0.5 * jnp.sum(deviator**2, axis=(1, 2)) + jnp.finfo(stress.dtype).tiny)
    high, low = jnp.maximum(mean + radius, 0), jnp.maximum(mean - radius, 0)
    slope = (high - low) / (2 * radius)
    return 0.5 * (high + low)[:, None, None] * jnp.eye(2, dtype=stress.dtype)[None] + slope[:, None, None] * deviator
