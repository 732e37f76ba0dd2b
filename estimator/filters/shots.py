"""Multiple shooting with a horizon of one step, as in the paper: samples of the trajectory, and the f they restart.

A sample is one step of the tool: the state before, the tip, and what was observed after. M = {m_1, ..., m_k} holds the
latest step and k - 1 others, drawn uniformly from those since t_c, the last cut or suture.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..physics.environment import Grip
from ..physics.xpbd import XPBD
from .evidence import Evidence

AT_ONCE = 100
"""Columns of the Jacobian that are computed together, which bounds the memory."""


class Shots(eqx.Module):
    """Samples of the trajectory, each of one step."""

    start: Float[Array, "k n 3"]
    """x_m, the particles before the step [m]."""
    tip: Float[Array, "k 3"]
    """u_m, where the tip moved [m]."""
    length: Float[Array, "k n"]
    """Rest length of each particle's spring to the tip [m]."""
    stiffness: Float[Array, "k n"]
    """Of those springs, zero for particles that are not held [N/m]."""
    end: Float[Array, "k n 3"]
    """x_m+1, what was observed after it; anything finite where nothing was [m]."""
    precision: Float[Array, "k n 3 3"]
    """Inverse covariance of `end`, zero where nothing was observed [1/m^2]."""


class ShotHistory:
    """The samples since t_c; remembers, so that it belongs to one filter."""

    def __init__(self, *, grip_stiffness: float, samples: int) -> None:
        """See `MultipleShooting`."""
        self._grip_stiffness, self._samples = grip_stiffness, samples
        self._rng = np.random.default_rng(0)
        self._shots: list[Shots] = []

    def add(self, evidence: Evidence) -> Shots:
        """Keep the latest step, and draw M; fewer than k are filled up with samples of no weight.

        Raises:
            ValueError: the evidence does not say which step led to the frame.
        """
        pull = evidence.pull
        if pull is None:
            raise ValueError("multiple shooting needs Evidence.pull, the step that led to the frame; got None.")
        stiffness = jnp.where(evidence.held, self._grip_stiffness, 0.0)
        parts = (pull.before, pull.tip, pull.length, stiffness, evidence.y, evidence.precision)
        self._shots.append(Shots(*(part[None] for part in parts)))
        chosen = [self._shots[m] for m in draw_samples(len(self._shots) - 1, self._samples, self._rng)]
        empty = eqx.tree_at(lambda shot: shot.precision, self._shots[-1], replace_fn=jnp.zeros_like)
        chosen += [empty] * (self._samples - len(chosen))
        return jax.tree.map(lambda *parts: jnp.concatenate(parts), *chosen)

    def reject(self) -> None:
        """Drop the latest step, which no state explains."""
        self._shots.pop()

    def forget(self) -> None:
        """Set t_c to now: no later update draws a step from before."""
        self._shots.clear()


def predicted(simulator: XPBD, shot: Shots, b: Float[Array, " n"], *, sweeps: int) -> Float[Array, "n 3"]:
    """f(x_m, u_m, b) of one sample, whose arrays lack the leading axis."""
    grip = Grip.of(shot.tip, shot.length, shot.stiffness)
    return simulator.step(shot.start, b, grip, sweeps=sweeps)


def slopes(f: Callable[[Float[Array, " n"]], Float[Array, "n 3"]], b: Float[Array, " n"]) -> Float[Array, "n n 3"]:
    """J^T of a prediction: row i is how the state moves with b_i [m^2/N]."""
    columns = jnp.eye(len(b), dtype=b.dtype)
    return jax.lax.map(lambda d: jax.jvp(f, (b,), (d,))[1], columns, batch_size=AT_ONCE)


def draw_samples(latest: int, k: int, rng: np.random.Generator) -> Int[np.ndarray, " _k"]:
    """The latest step and k - 1 earlier ones, uniformly, as far as there are any."""
    return np.append(rng.choice(latest, size=min(k - 1, latest), replace=False), latest).astype(int)
