"""Elements that only effects use: friction on the bed, a dead load, a film that sticks. One particle each.

Friction is a potential of the way since the frame before,

    mu N (sqrt(|d|^2 + e^2) - e)    d: the way along the bed

with the pressing force N held fixed [lagged friction: Li et al. 2020, doi:10.1145/3386569.3392425]: for ways longer
than e it is Coulomb's mu N against the way, and nothing for none.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..physics.energy import Term

STICK = 5e-5
"""e [m]."""
REACH = 2e-3
"""Distance at which a film has given most of its energy [m]."""


class FrictionElements(Term):
    """Friction on the bed."""

    vertices: Int[np.ndarray, "n 1"] | Int[Array, "n 1"]
    start: Float[Array, "n 3"]
    """Where the particles were in the frame before [m]."""
    resisted: Float[Array, " n"]
    """mu N [N]."""
    up: Float[Array, " 3"]

    @classmethod
    def build(cls, rest: Float[np.ndarray, "n 3"]) -> "FrictionElements":
        """Without friction."""
        return cls(
            vertices=np.arange(len(rest))[:, None],
            start=jnp.asarray(rest),
            resisted=jnp.zeros(len(rest)),
            up=jnp.array([0.0, 0.0, 1.0]),
        )

    def energy(self, x: Float[Array, "n 1 3"]) -> Float[Array, " n"]:
        """[J]."""
        _, length = self._way(x)
        return self.resisted * (length - STICK)

    def gradient(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3"]:
        """[N]."""
        way, length = self._way(x)
        return (self.resisted / length)[:, None, None] * way[:, None]

    def hessian(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3 1 3"]:
        """[N/m]."""
        way, length = self._way(x)
        flat = jnp.eye(3, dtype=x.dtype) - jnp.outer(self.up, self.up)
        window = flat[None] - way[:, :, None] * way[:, None, :] / length[:, None, None] ** 2
        return ((self.resisted / length)[:, None, None] * window)[:, None, :, None, :]

    def positive_hessian(self, x: Float[Array, "n 1 3"]) -> Float[Array, "n 1 3 1 3"]:
        """The Hessian, which is semi-definite already."""
        return self.hessian(x)

    def _way(self, x: Float[Array, "n 1 3"]) -> tuple[Float[Array, "n 3"], Float[Array, " n"]]:
        moved = x[:, 0] - self.start
        way = moved - jnp.outer(moved @ self.up, self.up)
        return way, jnp.sqrt(jnp.sum(way**2, axis=1) + STICK**2)


class DeadLoad(Term):
    """A force that stays as it is."""

    vertices: Int[np.ndarray, "n 1"] | Int[Array, "n 1"]
    force: Float[Array, "n 3"]
    """[N]."""

    @classmethod
    def build(cls, rest: Float[np.ndarray, "n 3"]) -> "DeadLoad":
        """None."""
        return cls(vertices=np.arange(len(rest))[:, None], force=jnp.zeros(rest.shape))

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


class AdhesionFilm(Term):
    """What holds a particle near where it lay until it is peeled off: w (1 - exp(-|x - a|^2 / r^2))."""

    vertices: Int[np.ndarray, "n 1"] | Int[Array, "n 1"]
    rest: Float[Array, "n 3"]
    """a [m]."""
    work: Float[Array, " n"]
    """w, of peeling a particle off [J]."""

    @classmethod
    def build(cls, rest: Float[np.ndarray, "n 3"]) -> "AdhesionFilm":
        """A dry sheet."""
        return cls(vertices=np.arange(len(rest))[:, None], rest=jnp.asarray(rest), work=jnp.zeros(len(rest)))

    def energy(self, x: Float[Array, "n 1 3"]) -> Float[Array, " n"]:
        """[J]."""
        return self.work * -jnp.expm1(-jnp.sum((x[:, 0] - self.rest) ** 2, axis=1) / REACH**2)
