"""How the errors of a frame follow those of the frames before it in its grasp.

The error of each position is an autoregressive process of order 1 from rest, where it is 0. With rho the
autocorrelation of a frame and the next and kappa the variance, the error e of a particle that was last observed t
frames before has, given its error then, the mean rho^t e_last and the variance kappa (1 - rho^2t).

What drives the errors of all frames of a grasp alike by c standard deviations of what is new in one frame moves those
of t frames later by c f standard deviations of what is new since then, with

    f = sum_(j < t) rho^j / sqrt(sum_(j < t) rho^2j).
"""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

T = TypeVar("T")


class Persistence(eqx.Module):
    """How the errors of a frame follow the last ones."""

    autocorrelation: Float[Array, " n"]
    """Autocorrelation of the error of each particle and of its last one, or of rest."""
    new: Float[Array, " n"]
    """Variance of what is new of it, over the assumed one of all."""
    drive: Float[Array, ""]
    """Factor f of what drives the errors of all frames alike."""

    @classmethod
    def of(cls, autocorrelation: float, variance: float, since: Int[np.ndarray, " n"], driven: int) -> "Persistence":
        """Return it for an autocorrelation of a frame and the next, and the variance of all errors.

        Args:
            autocorrelation: rho.
            variance: kappa, over the assumed variance.
            since: frames since each particle was last observed, or since rest.
            driven: frames since the frame before, or since the grasp began.
        """
        rho = autocorrelation ** since.astype(float)
        return cls(
            autocorrelation=jnp.asarray(rho),
            new=jnp.asarray(variance * new_share(autocorrelation, since)),
            drive=jnp.asarray(drive(autocorrelation, driven)),
        )

    def innovation(self, now: Float[Array, "n ..."], before: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        """Return the innovation of errors, or of how they change, from those of the frame and the last ones."""
        beside = (len(self.new),) + (1,) * (now.ndim - 1)
        return (now - self.autocorrelation.reshape(beside) * before) / jnp.sqrt(self.new).reshape(beside)


def new_share(autocorrelation: float, frames: Int[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the share of the variance of an error that is new after a number of frames."""
    return 1 - autocorrelation ** (2.0 * frames)


def drive(autocorrelation: float, frames: int) -> float:
    """Return the factor of what drives the errors of all frames alike, some frames later."""
    powers = autocorrelation ** np.arange(frames, dtype=float)
    return float(powers.sum() / np.sqrt(np.sum(powers**2)))


def carried(last: Int[np.ndarray, " n"], every: dict[int, T], nothing: T) -> T:
    """Return the rows that each particle has in its last frame, of arrays over particles.

    Args:
        last: that frame of each particle; -1 if there is none.
        every: the arrays of each frame, of any structure.
        nothing: rows of particles without such a frame.
    """
    found = nothing
    for k in np.unique(last[last >= 0]):
        rows = jnp.asarray(last == k)

        def of_frame(now: Array, there: Array, rows: Array = rows) -> Array:
            return jnp.where(rows.reshape((len(rows),) + (1,) * (now.ndim - 1)), there, now)

        found = every[k] if (last == k).all() else jax.tree.map(of_frame, found, every[k])
    return found
