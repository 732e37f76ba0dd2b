"""In-plane elasticity of the sheet: St Venant-Kirchhoff triangles, or springs along the edges as in the paper.

Both are `Term`s of the energy and take one membrane stiffness k = Young's modulus x thickness [N/m]. Neither knows
bending. Small strains, large rotations.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from jiggle_mj.estimator.energy import Term
from jiggle_mj.estimator.mesh import SheetMesh


class TriangleMembrane(Term):
    """Constant-strain St Venant-Kirchhoff triangles in plane stress.

    With F the deformation gradient, E = (F^T F - I) / 2 and S = k / (1 - nu^2) ((1 - nu) E + nu tr(E) I), a triangle of
    rest area A stores A/2 S:E.
    """

    vertices: Int[np.ndarray, "f 3"] | Int[Array, "f 3"]
    shape_gradient: Float[Array, "f 3 2"]
    """Derivative of each corner's shape function along two material axes [1/m]."""
    area: Float[Array, " f"]
    """Rest area [m^2]."""
    stiffness: Float[Array, ""]
    """k [N/m]."""
    poisson: Float[Array, ""]

    @classmethod
    def build(cls, mesh: SheetMesh, *, stiffness: float, poisson: float) -> "TriangleMembrane":
        """Triangles of the mesh at rest."""
        a, b, c = np.moveaxis(mesh.rest[mesh.faces], 1, 0)
        first = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
        normal = np.cross(b - a, c - a)
        second = np.cross(normal / np.linalg.norm(normal, axis=1, keepdims=True), first)
        material = np.stack([b - a, c - a], axis=-1)
        flat = np.stack([first, second], axis=1) @ material
        inverse = np.linalg.inv(flat)
        gradient = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
        return cls(
            vertices=mesh.faces,
            shape_gradient=jnp.asarray(gradient),
            area=jnp.asarray(mesh.face_area),
            stiffness=jnp.asarray(stiffness, dtype=float),
            poisson=jnp.asarray(poisson, dtype=float),
        )

    def _stress(self, strain: Float[Array, "f 2 2"]) -> Float[Array, "f 2 2"]:
        trace = jnp.trace(strain, axis1=1, axis2=2)[:, None, None] * jnp.eye(2, dtype=strain.dtype)[None]
        return self.stiffness / (1 - self.poisson**2) * ((1 - self.poisson) * strain + self.poisson * trace)

    def _deformation(self, x: Float[Array, "f 3 3"]) -> tuple[Float[Array, "f 3 2"], Float[Array, "f 2 2"]]:
        F = jnp.einsum("fai,fak->fik", x, self.shape_gradient)
        return F, 0.5 * (F.swapaxes(1, 2) @ F - jnp.eye(2, dtype=x.dtype)[None])

    def energy(self, x: Float[Array, "f 3 3"]) -> Float[Array, " f"]:
        """A/2 S:E [J]."""
        _, strain = self._deformation(x)
        return 0.5 * self.area * jnp.sum(self._stress(strain) * strain, axis=(1, 2))

    def gradient(self, x: Float[Array, "f 3 3"]) -> Float[Array, "f 3 3"]:
        """A F S grad N [N]."""
        F, strain = self._deformation(x)
        return self.area[:, None, None] * jnp.einsum("fik,fkl,fal->fai", F, self._stress(strain), self.shape_gradient)

    def hessian(self, x: Float[Array, "f 3 3"]) -> Float[Array, "f 3 3 3 3"]:
        """Material and geometric part [N/m]."""
        F, strain = self._deformation(x)
        return self._tangent(F, self._stress(strain))

    def positive_hessian(self, x: Float[Array, "f 3 3"]) -> Float[Array, "f 3 3 3 3"]:
        """The same with compressive principal stresses left out, which makes the geometric part semi-definite."""
        F, strain = self._deformation(x)
        return self._tangent(F, _tensile(self._stress(strain)))

    def _tangent(self, F: Float[Array, "f 3 2"], stress: Float[Array, "f 2 2"]) -> Float[Array, "f 3 3 3 3"]:
        N, nu = self.shape_gradient, self.poisson
        variation = jnp.einsum("fik,fal->faikl", F, N)
        variation = 0.5 * (variation + variation.swapaxes(3, 4))
        trace = jnp.trace(variation, axis1=3, axis2=4)
        material = (1 - nu) * jnp.einsum("faikl,fbjkl->faibj", variation, variation)
        material = material + nu * jnp.einsum("fai,fbj->faibj", trace, trace)
        geometric = jnp.einsum("fak,fkl,fbl,ij->faibj", N, stress, N, jnp.eye(3, dtype=F.dtype))
        return self.area[:, None, None, None, None] * (self.stiffness / (1 - nu**2) * material + geometric)


class EdgeMembrane(Term):
    """Distance springs along the edges, the paper's C_m, with Van Gelder's stiffness.

    Edge e of rest length l between triangles of area A_1, A_2 gets k_e = k (A_1 + A_2) / l^2 [Van Gelder 1998,
    Journal of Graphics Tools 3(2)]: exact for equilateral triangles and Poisson's ratio 1/3, which springs have.
    """

    vertices: Int[np.ndarray, "e 2"] | Int[Array, "e 2"]
    length: Float[Array, " e"]
    """Rest length [m]."""
    stiffness: Float[Array, " e"]
    """[N/m]."""

    @classmethod
    def build(cls, mesh: SheetMesh, *, stiffness: float) -> "EdgeMembrane":
        """Springs on every edge of the mesh."""
        length = np.linalg.norm(mesh.rest[mesh.edges[:, 0]] - mesh.rest[mesh.edges[:, 1]], axis=1)
        number = {tuple(edge): i for i, edge in enumerate(mesh.edges.tolist())}
        area = np.zeros(len(mesh.edges))
        for face, size in zip(mesh.faces.tolist(), mesh.face_area, strict=True):
            for a, b in zip(face, face[1:] + face[:1], strict=True):
                area[number[min(a, b), max(a, b)]] += size
        return cls(vertices=mesh.edges, length=jnp.asarray(length), stiffness=jnp.asarray(stiffness * area / length**2))

    def energy(self, x: Float[Array, "e 2 3"]) -> Float[Array, " e"]:
        """k_e/2 (|x_1 - x_0| - l)^2 [J]."""
        return 0.5 * self.stiffness * (jnp.linalg.norm(x[:, 1] - x[:, 0], axis=1) - self.length) ** 2

    def hessian(self, x: Float[Array, "e 2 3"]) -> Float[Array, "e 2 3 2 3"]:
        """Along the edge k_e, across it k_e (1 - l/|d|) [N/m]."""
        return self._tangent(x, compressive=True)

    def positive_hessian(self, x: Float[Array, "e 2 3"]) -> Float[Array, "e 2 3 2 3"]:
        """The same without the negative stiffness across a compressed edge."""
        return self._tangent(x, compressive=False)

    def _tangent(self, x: Float[Array, "e 2 3"], *, compressive: bool) -> Float[Array, "e 2 3 2 3"]:
        d = x[:, 1] - x[:, 0]
        length = jnp.linalg.norm(d, axis=1)
        along = jnp.einsum("ei,ej->eij", d, d) / length[:, None, None] ** 2
        across = 1 - self.length / length
        across = across if compressive else jnp.maximum(across, 0)
        window = along + across[:, None, None] * (jnp.eye(3, dtype=x.dtype)[None] - along)
        sign = jnp.array([[1.0, -1.0], [-1.0, 1.0]], dtype=x.dtype)
        return jnp.einsum("e,ab,eij->eaibj", self.stiffness, sign, window)


def _tensile(stress: Float[Array, "f 2 2"]) -> Float[Array, "f 2 2"]:
    """Symmetric 2x2 matrices with negative eigenvalues set to zero, in closed form."""
    mean = 0.5 * (stress[:, 0, 0] + stress[:, 1, 1])
    deviator = stress - mean[:, None, None] * jnp.eye(2, dtype=stress.dtype)[None]
    radius = jnp.sqrt(0.5 * jnp.sum(deviator**2, axis=(1, 2)) + jnp.finfo(stress.dtype).tiny)
    high, low = jnp.maximum(mean + radius, 0), jnp.maximum(mean - radius, 0)
    slope = (high - low) / (2 * radius)
    return 0.5 * (high + low)[:, None, None] * jnp.eye(2, dtype=stress.dtype)[None] + slope[:, None, None] * deviator
