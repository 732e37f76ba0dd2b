"""Terms of the energy that only effects use, one element a particle: friction on the bed, dead load, adhesion film.

Friction is a potential of the displacement since the frame before,

    mu N (sqrt(|d|^2 + e^2) - e)    d: the displacement along the bed

with the pressing force N held fixed [lagged friction: Li et al. 2020, doi:10.1145/3386569.3392425]. For displacements
longer than e the force is Coulomb's mu N against the displacement; for none it is 0.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..physics.energy import Term

STICK_LENGTH = 5e-5
"""Displacement e over which friction builds up [m], below the noise of observed positions."""
FILM_RANGE = 2e-3
"""Distance r at which a film has released most of its energy [m]."""


class FrictionElements(Term):
    """Friction of each particle on the bed."""

    vertices: Int[np.ndarray, "n 1"] | Int[Array, "n 1"]
    start: Float[Array, "n 3"]
    """Where the particles were in the frame before [m]."""
    resisted: Float[Array, " n"]
    """Friction force mu N of sliding [N]."""
    up: Float[Array, " 3"]
    """Unit normal of the bed."""

    @classmethod
    def build(cls, rest: Float[np.ndarray, "n 3"]) -> "FrictionElements":
        """Return the elements without friction."""
        return cls(
            vertices=np.arange(len(rest))[:, None],
            start=jnp.asarray(rest),
            resisted=jnp.zeros(len(rest)),
            up=jnp.array([0.0, 0.0, 1.0]),
        )

    def energy(self, x: Float[Array, "n 1 3"]) -> Float[Array, " n"]:
        """Return the energy of each element [J]."""
        _, length = self._displacement(x)
        return self.resisted * (length - STICK_LENGTH)

    def gradient(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3"]:
        """Return the gradient of each element's energy [N]."""
        d, length = self._displacement(x)
        return (self.resisted / length)[:, None, None] * d[:, None]

    def hessian(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3 1 3"]:
        """Return the Hessian of each element's energy [N/m]."""
        d, length = self._displacement(x)
        flat = jnp.eye(3, dtype=x.dtype) - jnp.outer(self.up, self.up)
        curvature = flat[None] - d[:, :, None] * d[:, None, :] / length[:, None, None] ** 2
        return ((self.resisted / length)[:, None, None] * curvature)[:, None, :, None, :]

    def positive_hessian(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3 1 3"]:
        """Return the Hessian, which is positive semi-definite already."""
        return self.hessian(x)

    def _displacement(self, x: Float[Array, "n 1 3"]) -> tuple[Float[Array, "n 3"], Float[Array, " n"]]:
        """Return the displacement along the bed [m], and its regularised length sqrt(|d|^2 + e^2) [m]."""
        moved = x[:, 0] - self.start
        d = moved - jnp.outer(moved @ self.up, self.up)
        return d, jnp.sqrt(jnp.sum(d**2, axis=1) + STICK_LENGTH**2)


class DeadLoad(Term):
    """Constant force on each particle."""

    vertices: Int[np.ndarray, "n 1"] | Int[Array, "n 1"]
    force: Float[Array, "n 3"]
    """Force on each particle [N]."""

    @classmethod
    def build(cls, rest: Float[np.ndarray, "n 3"]) -> "DeadLoad":
        """Return the elements without force."""
        return cls(vertices=np.arange(len(rest))[:, None], force=jnp.zeros(rest.shape))

    def energy(self, x: Float[Array, "n 1 3"]) -> Float[Array, " n"]:
        """Return the energy of each element [J]."""
        return -jnp.sum(self.force * x[:, 0], axis=1)

    def gradient(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3"]:
        """Return the gradient of each element's energy [N]."""
        return -self.force[:, None]

    def hessian(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3 1 3"]:
        """Return zeros, because the energy is linear [N/m]."""
        return jnp.zeros((len(x), 1, 3, 1, 3), x.dtype)

    def positive_hessian(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3 1 3"]:
        """Return zeros, because the energy is linear [N/m]."""
        return self.hessian(x)


class AdhesionFilm(Term):
    """Film that holds each particle near its rest position until it is peeled off: w (1 - exp(-|x - a|^2 / r^2))."""

    vertices: Int[np.ndarray, "n 1"] | Int[Array, "n 1"]
    rest: Float[Array, "n 3"]
    """Rest positions a [m]."""
    work: Float[Array, " n"]
    """Work w of peeling each particle off [J]."""

    @classmethod
    def build(cls, rest: Float[np.ndarray, "n 3"]) -> "AdhesionFilm":
        """Return the elements of a dry sheet, without work."""
        return cls(vertices=np.arange(len(rest))[:, None], rest=jnp.asarray(rest), work=jnp.zeros(len(rest)))

    def energy(self, x: Float[Array, "n 1 3"]) -> Float[Array, " n"]:
        """Return the energy of each element [J]."""
        return self.work * -jnp.expm1(-jnp.sum((x[:, 0] - self.rest) ** 2, axis=1) / FILM_RANGE**2)
