"""External loads on the sheet, without the unknown attachments: weight, bed contact, grip, and springs to given points.

Each is a `Term` with one particle per element. The bed is frictionless and only pushes; the grip is the paper's C_a.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .energy import Term


class Weight(Term):
    """Weight of each particle, -m g . x."""

    vertices: Int[np.ndarray, "n 1"] | Int[Array, "n 1"]
    mass: Float[Array, " n"]
    """Mass of each particle [kg]."""
    gravity: Float[Array, " 3"]
    """Acceleration of gravity [m/s^2]."""

    @classmethod
    def build(
        cls, particle_area: Float[np.ndarray, " n"], *, areal_density: float, gravity: tuple[float, float, float]
    ) -> "Weight":
        """Build the weight of each particle's share of the sheet."""
        mass, g = areal_density * particle_area, np.asarray(gravity, dtype=float)
        return cls(vertices=np.arange(len(mass))[:, None], mass=jnp.asarray(mass), gravity=jnp.asarray(g))

    @property
    def force(self) -> Float[Array, "n 3"]:
        """Return mass times gravity [N]."""
        return self.mass[:, None] * self.gravity[None]

    def energy(self, x: Float[Array, "n 1 3"]) -> Float[Array, " n"]:
        """Return the energy of each element [J]."""
        return -jnp.sum(self.force * x[:, 0], axis=1)

    def gradient(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3"]:
        """Return the derivative of each element's energy [N]."""
        return -self.force[:, None]

    def hessian(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3 1 3"]:
        """Return zero: the weight is linear in x."""
        return jnp.zeros((len(x), 1, 3, 1, 3), x.dtype)

    def positive_hessian(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3 1 3"]:
        """Return zero: the weight is linear in x."""
        return self.hessian(x)


class BedContact(Term):
    """Contact with the bed, k/2 min(0, x . up - height)^2: it only pushes, and supports the sheet in its rest shape.

    The height of the bed comes from the sheet itself, so that an error of the camera's height does not enter.
    """

    vertices: Int[np.ndarray, "n 1"] | Int[Array, "n 1"]
    height: Float[Array, " n"]
    """Height at which each particle touches the bed [m]."""
    up: Float[Array, " 3"]
    """Unit vector against gravity."""
    stiffness: Float[Array, ""] | Float[Array, " n"]
    """Stiffness of the bed under each particle [N/m]; one number if it is the same."""

    @classmethod
    def build(
        cls,
        rest: Float[np.ndarray, "n 3"],
        *,
        load: Float[np.ndarray, " n"],
        up: Float[np.ndarray, " 3"],
        stiffness: float,
    ) -> "BedContact":
        """Build a bed into which the sheet at rest sinks until it supports the load on each particle.

        Args:
            rest: rest positions [m].
            load: weight of each particle against `up` [N].
            up: unit vector against gravity.
            stiffness: of the bed under one particle [N/m].
        """
        return cls(
            vertices=np.arange(len(rest))[:, None],
            height=jnp.asarray(rest @ up + load / stiffness),
            up=jnp.asarray(up),
            stiffness=jnp.asarray(stiffness, dtype=float),
        )

    def _depth(self, x: Float[Array, "n 1 3"]) -> Float[Array, " n"]:
        """Return how far each particle is below the surface, as a number of at most 0 [m]."""
        return jnp.minimum(x[:, 0] @ self.up - self.height, 0)

    def energy(self, x: Float[Array, "n 1 3"]) -> Float[Array, " n"]:
        """Return the energy of each element [J]."""
        return 0.5 * self.stiffness * self._depth(x) ** 2

    def gradient(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3"]:
        """Return the derivative of each element's energy [N]."""
        return jnp.outer(self.stiffness * self._depth(x), self.up)[:, None]

    def hessian(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3 1 3"]:
        """Return the bed's stiffness for particles in contact [N/m]."""
        stiffness = jnp.where(self._depth(x) < 0, self.stiffness, 0)
        return (stiffness[:, None, None] * jnp.outer(self.up, self.up)[None])[:, None, :, None, :]

    def positive_hessian(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3 1 3"]:
        """Return the Hessian, which is positive semi-definite already."""
        return self.hessian(x)


class Grip(Term):
    """Springs from the tip to the held particles, the paper's C_a: k_a/2 (|x_j - u| - r_j)^2."""

    vertices: Int[np.ndarray, "n 1"] | Int[Array, "n 1"]
    tip: Float[Array, " 3"]
    """Position u of the tip [m]."""
    length: Float[Array, " n"]
    """Rest length r_j: the distance to the tip when the jaws closed [m]."""
    stiffness: Float[Array, " n"]
    """Stiffness k_a [N/m]; zero for particles that are not held."""

    @classmethod
    def build(cls, x: Float[Array, "n 3"], tip: Float[Array, " 3"], *, radius: float, stiffness: float) -> "Grip":
        """Build the springs of jaws that close at `tip` around the particles x within the radius [m]."""
        length = jnp.linalg.norm(x - tip[None], axis=1)
        return cls.of(tip, length, jnp.where(length <= radius, stiffness, 0.0))

    @classmethod
    def of(cls, tip: Float[Array, " 3"], length: Float[Array, " n"], stiffness: Float[Array, " n"]) -> "Grip":
        """Build springs to a tip that has moved since the jaws closed."""
        return cls(vertices=np.arange(len(length))[:, None], tip=tip, length=length, stiffness=stiffness)

    def _stretch(self, x: Float[Array, "n 1 3"]) -> tuple[Float[Array, "n 3"], Float[Array, " n"]]:
        """Return each spring's vector and length [m]."""
        d = x[:, 0] - self.tip[None]
        return d, lengths(d)

    def energy(self, x: Float[Array, "n 1 3"]) -> Float[Array, " n"]:
        """Return the energy of each element [J]."""
        return 0.5 * self.stiffness * (self._stretch(x)[1] - self.length) ** 2

    def hessian(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3 1 3"]:
        """Return the Hessian: k_a along the spring, k_a (1 - r/|d|) across it [N/m]."""
        return self._window(x, compressive=True)

    def positive_hessian(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3 1 3"]:
        """Return k_a along the spring and max(0, k_a (1 - r/|d|)) across it [N/m]."""
        return self._window(x, compressive=False)

    def _window(self, x: Float[Array, "n 1 3"], *, compressive: bool) -> Float[Array, "n 1 3 1 3"]:
        """Return the Hessian, without the negative stiffness of compressed springs unless `compressive`."""
        d, distance = self._stretch(x)
        along = jnp.einsum("ni,nj->nij", d, d) / distance[:, None, None] ** 2
        across = jnp.where(self.length > 0, 1 - self.length / distance, 1.0)
        across = (across if compressive else jnp.maximum(across, 0))[:, None, None]
        window = along + across * (jnp.eye(3, dtype=x.dtype)[None] - along)
        return (self.stiffness[:, None, None] * window)[:, None, :, None, :]


def lengths(d: Float[Array, "*m 3"]) -> Float[Array, "*m"]:
    """Return |d|, with a finite derivative at d = 0."""
    squared = jnp.sum(d**2, axis=-1)
    return jnp.sqrt(jnp.where(squared > 0, squared, jnp.finfo(d.dtype).tiny))


class Tether(Term):
    """Springs from the particles to given points, 1/2 (x - to)^T K (x - to)."""

    vertices: Int[np.ndarray, "n 1"] | Int[Array, "n 1"]
    to: Float[Array, "n 3"]
    """Point that each particle is tied to [m]."""
    stiffness: Float[Array, "n 3 3"]
    """Symmetric stiffness K [N/m]; zero for 'none'."""

    @classmethod
    def build(cls, to: Float[np.ndarray, "n 3"]) -> "Tether":
        """Build springs of zero stiffness, to be set later."""
        return cls(vertices=np.arange(len(to))[:, None], to=jnp.asarray(to), stiffness=jnp.zeros((len(to), 3, 3)))

    def energy(self, x: Float[Array, "n 1 3"]) -> Float[Array, " n"]:
        """Return the energy of each element [J]."""
        return 0.5 * jnp.sum(self.gradient(x)[:, 0] * (x[:, 0] - self.to), axis=1)

    def gradient(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3"]:
        """Return the derivative of each element's energy [N]."""
        return jnp.einsum("nij,nj->ni", self.stiffness, x[:, 0] - self.to)[:, None]

    def hessian(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3 1 3"]:
        """Return the stiffness K of each spring [N/m]."""
        return self.stiffness[:, None, :, None, :]

    def positive_hessian(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3 1 3"]:
        """Return the Hessian, which is positive semi-definite already."""
        return self.hessian(x)
