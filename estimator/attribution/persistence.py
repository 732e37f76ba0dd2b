"""How the errors of a frame follow those of the frames before it in its grasp.

The error of each position is an autoregressive process of order 1 from rest, where it is 0. With rho the
autocorrelation of a frame and the next and kappa the variance, the error e of a particle that was last observed t
frames before has, given its error then, the mean rho^t e_last and the variance kappa (1 - rho^2t).

The errors of particles are taken for correlated with each other as what is new in a frame is, where they were hidden
for different times too. Grasps count as independent.

What drives the errors of all frames of a grasp alike, each by c standard deviations of what is new in it, moves those
of a frame by c f standard deviations of what is new since the last frame that is used. From each frame to the next

    d <- rho^t d + sqrt(1 - rho^2t),   q <- rho^2t q + 1 - rho^2t,   f = d / sqrt(q).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..parallel_map import T


class Persistence(eqx.Module):
    """How the errors of a frame follow the last ones."""

    autocorrelation: Float[Array, " n"]
    """Autocorrelation of the error of each particle and of its last one, or of rest."""
    new: Float[Array, " n"]
    """Variance of what is new of it, over the assumed one of all."""
    drive: Float[Array, ""]
    """Factor f of what drives the errors of all frames alike."""

    @classmethod
    def of(
        cls, autocorrelation: float, variance: float, since: Int[np.ndarray, " n"], steps: tuple[int, ...]
    ) -> "Persistence":
        """Return it for an autocorrelation of a frame and the next, and the variance of all errors.

        Args:
            autocorrelation: rho.
            variance: kappa, over the assumed variance.
            since: frames since each particle was last observed, or since rest.
            steps: frames from each frame to the next, from the last one that is used to this one.
        """
        rho = autocorrelation ** since.astype(float)
        return cls(
            autocorrelation=jnp.asarray(rho),
            new=jnp.asarray(variance * new_share(autocorrelation, since)),
            drive=jnp.asarray(drive(autocorrelation, steps)),
        )

    def innovation(self, now: Float[Array, "n ..."], before: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        """Return the innovation of errors, or of how they change, from those of the frame and the last ones."""
        beside = (len(self.new),) + (1,) * (now.ndim - 1)
        return (now - self.autocorrelation.reshape(beside) * before) / jnp.sqrt(self.new).reshape(beside)


def new_share(autocorrelation: float, frames: Int[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the share of the variance of an error that is new after a number of frames."""
    return 1 - autocorrelation ** (2.0 * frames)


def drive(autocorrelation: float, steps: tuple[int, ...]) -> float:
    """Return the factor f of what drives the errors of all frames alike, after some steps of so many frames."""
    driven, variance = 0.0, 0.0
    for frames in steps:
        rho = autocorrelation**frames
        driven, variance = rho * driven + (1 - rho**2) ** 0.5, rho**2 * variance + 1 - rho**2
    return driven / variance**0.5


def carried(last: Int[np.ndarray, " n"], every: dict[int, T], like: T) -> T:
    """Return the rows that each particle has in its last frame, of arrays over particles; 0 where there is none.

    Args:
        last: that frame of each particle; -1 if there is none.
        every: the arrays of each frame, of any structure.
        like: arrays of the same structure and shapes.
    """
    found = jax.tree.map(jnp.zeros_like, like)
    for k in np.unique(last[last >= 0]):
        rows = jnp.asarray(last == k)

        def of_frame(now: Array, there: Array, rows: Array = rows) -> Array:
            return jnp.where(rows.reshape((len(rows),) + (1,) * (now.ndim - 1)), there, now)

        found = every[k] if (last == k).all() else jax.tree.map(of_frame, found, every[k])
    return found
