"""What acts on the sheet from outside, besides the unknown attachments: weight, the bed it lies on, the grip.

Each is a `Term` with one particle an element. The bed is frictionless and only pushes; the grip is the paper's C_a.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .energy import Term


class Weight(Term):
    """-m g . x."""

    vertices: Int[np.ndarray, "n 1"] | Int[Array, "n 1"]
    mass: Float[Array, " n"]
    """[kg]."""
    gravity: Float[Array, " 3"]
    """[m/s^2]."""

    @classmethod
    def build(
        cls, particle_area: Float[np.ndarray, " n"], *, areal_density: float, gravity: tuple[float, float, float]
    ) -> "Weight":
        """Weight of each particle's share of the sheet."""
        mass, g = areal_density * particle_area, np.asarray(gravity, dtype=float)
        return cls(vertices=np.arange(len(mass))[:, None], mass=jnp.asarray(mass), gravity=jnp.asarray(g))

    @property
    def force(self) -> Float[Array, "n 3"]:
        """Mass times gravity [N]."""
        return self.mass[:, None] * self.gravity[None]

    def energy(self, x: Float[Array, "n 1 3"]) -> Float[Array, " n"]:
        """[J]."""
        return -jnp.sum(self.force * x[:, 0], axis=1)

    def gradient(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3"]:
        """[N]."""
        return -self.force[:, None]

    def hessian(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3 1 3"]:
        """Zero."""
        return jnp.zeros((len(x), 1, 3, 1, 3), x.dtype)

    def positive_hessian(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3 1 3"]:
        """Zero."""
        return self.hessian(x)


class BedContact(Term):
    """k/2 min(0, x . up - height)^2: the bed only pushes, and carries the sheet where it lay at rest.

    Taking the bed's height from the sheet itself keeps errors of the camera's height out of the contact.
    """

    vertices: Int[np.ndarray, "n 1"] | Int[Array, "n 1"]
    height: Float[Array, " n"]
    """Height at which each particle touches the bed [m]."""
    up: Float[Array, " 3"]
    """Unit vector against gravity."""
    stiffness: Float[Array, ""]
    """[N/m] per particle."""

    @classmethod
    def build(
        cls,
        rest: Float[np.ndarray, "n 3"],
        *,
        load: Float[np.ndarray, " n"],
        up: Float[np.ndarray, " 3"],
        stiffness: float,
    ) -> "BedContact":
        """A bed in which the sheet at rest lies so deep that it carries the load on each particle [N]."""
        return cls(
            vertices=np.arange(len(rest))[:, None],
            height=jnp.asarray(rest @ up + load / stiffness),
            up=jnp.asarray(up),
            stiffness=jnp.asarray(stiffness, dtype=float),
        )

    def _depth(self, x: Float[Array, "n 1 3"]) -> Float[Array, " n"]:
        return jnp.minimum(x[:, 0] @ self.up - self.height, 0)

    def energy(self, x: Float[Array, "n 1 3"]) -> Float[Array, " n"]:
        """[J]."""
        return 0.5 * self.stiffness * self._depth(x) ** 2

    def gradient(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3"]:
        """[N]."""
        return self.stiffness * jnp.outer(self._depth(x), self.up)[:, None]

    def hessian(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3 1 3"]:
        """The bed's stiffness where it is touched [N/m]."""
        touched = jnp.where(self._depth(x) < 0, self.stiffness, 0)
        return (touched[:, None, None] * jnp.outer(self.up, self.up)[None])[:, None, :, None, :]

    def positive_hessian(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3 1 3"]:
        """The Hessian, which is semi-definite already."""
        return self.hessian(x)


class Grip(Term):
    """Springs from the tip to the held particles, the paper's C_a: k_a/2 (|x_j - u| - r_j)^2."""

    vertices: Int[np.ndarray, "n 1"] | Int[Array, "n 1"]
    tip: Float[Array, " 3"]
    """u [m]."""
    length: Float[Array, " n"]
    """r_j, the distance to the tip when the jaws closed [m]."""
    stiffness: Float[Array, " n"]
    """k_a [N/m], zero for particles that are not held."""

    @classmethod
    def build(cls, x: Float[Array, "n 3"], tip: Float[Array, " 3"], *, radius: float, stiffness: float) -> "Grip":
        """Close the jaws at `tip` around the particles x within the radius."""
        length = jnp.linalg.norm(x - tip[None], axis=1)
        return cls.of(tip, length, jnp.where(length <= radius, stiffness, 0.0))

    @classmethod
    def of(cls, tip: Float[Array, " 3"], length: Float[Array, " n"], stiffness: Float[Array, " n"]) -> "Grip":
        """Springs to a tip that has moved since the jaws closed."""
        return cls(vertices=np.arange(len(length))[:, None], tip=tip, length=length, stiffness=stiffness)

    def _stretch(self, x: Float[Array, "n 1 3"]) -> tuple[Float[Array, "n 3"], Float[Array, " n"]]:
        d = x[:, 0] - self.tip[None]
        return d, lengths(d)

    def energy(self, x: Float[Array, "n 1 3"]) -> Float[Array, " n"]:
        """[J]."""
        return 0.5 * self.stiffness * (self._stretch(x)[1] - self.length) ** 2

    def hessian(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3 1 3"]:
        """Along the spring k_a, across it k_a (1 - r/|d|) [N/m]."""
        return self._window(x, compressive=True)

    def positive_hessian(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3 1 3"]:
        """Along the spring k_a, across it k_a (1 - r/|d|) where that is positive [N/m]."""
        return self._window(x, compressive=False)

    def _window(self, x: Float[Array, "n 1 3"], *, compressive: bool) -> Float[Array, "n 1 3 1 3"]:
        d, distance = self._stretch(x)
        along = jnp.einsum("ni,nj->nij", d, d) / distance[:, None, None] ** 2
        across = jnp.where(self.length > 0, 1 - self.length / distance, 1.0)
        across = (across if compressive else jnp.maximum(across, 0))[:, None, None]
        window = along + across * (jnp.eye(3, dtype=x.dtype)[None] - along)
        return (self.stiffness[:, None, None] * window)[:, None, :, None, :]


def lengths(d: Float[Array, "m 3"]) -> Float[Array, " m"]:
    """|d|, with a finite derivative where there is none."""
    squared = jnp.sum(d**2, axis=1)
    return jnp.sqrt(jnp.where(squared > 0, squared, jnp.finfo(d.dtype).tiny))


class Tether(Term):
    """Springs from the particles to given points: 1/2 (x - to)^T K (x - to)."""

    vertices: Int[np.ndarray, "n 1"] | Int[Array, "n 1"]
    to: Float[Array, "n 3"]
    """[m]."""
    stiffness: Float[Array, "n 3 3"]
    """Symmetric, zero for 'none' [N/m]."""

    @classmethod
    def build(cls, to: Float[np.ndarray, "n 3"]) -> "Tether":
        """Slack springs, to be set later."""
        return cls(vertices=np.arange(len(to))[:, None], to=jnp.asarray(to), stiffness=jnp.zeros((len(to), 3, 3)))

    def energy(self, x: Float[Array, "n 1 3"]) -> Float[Array, " n"]:
        """[J]."""
        return 0.5 * jnp.sum(self.gradient(x)[:, 0] * (x[:, 0] - self.to), axis=1)

    def gradient(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3"]:
        """[N]."""
        return jnp.einsum("nij,nj->ni", self.stiffness, x[:, 0] - self.to)[:, None]

    def hessian(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3 1 3"]:
        """[N/m]."""
        return self.stiffness[:, None, :, None, :]

    def positive_hessian(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3 1 3"]:
        """The Hessian, which is semi-definite already."""
        return self.hessian(x)
