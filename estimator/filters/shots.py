"""Multiple shooting with a horizon of one step, as in the paper: samples of the trajectory, and the simulator f.

A sample is one step of the tool: the state before, where the tip moved, and what was observed after. M = {m_1, ...,
m_k} holds the latest step and k - 1 others, drawn uniformly from those since t_c, the last cut or suture.
"""

import copy
from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ..physics.environment import Grip
from ..physics.xpbd import XPBD
from .evidence import Evidence

JACOBIAN_BATCH = 100
"""Columns of the Jacobian that are computed together, which bounds the memory."""


class Shots(eqx.Module):
    """Samples of the trajectory, each of one step."""

    start: Float[Array, "k n 3"]
    """x_m, the particles before the step [m]."""
    tip: Float[Array, "k 3"]
    """u_m, where the tip moved to [m]."""
    length: Float[Array, "k n"]
    """Rest length of each particle's spring to the tip [m]."""
    stiffness: Float[Array, "k n"]
    """Stiffness of those springs, zero for particles that are not held [N/m]."""
    end: Float[Array, "k n 3"]
    """x_m+1, what was observed after the step [m]; anything finite where nothing was."""
    precision: Float[Array, "k n 3 3"]
    """Inverse covariance of `end`, zero where nothing was observed [1/m^2]."""


class ShotHistory(eqx.Module):
    """The samples since t_c; a pytree, never changed in place."""

    shots: tuple[Shots, ...]
    """One sample for each step, in order of time."""
    generator: np.random.Generator
    """Draws the earlier samples; copied before a draw, so that a history gives the same draw again."""

    @classmethod
    def empty(cls, key: PRNGKeyArray) -> "ShotHistory":
        """Return a history without samples, whose draws follow from the key."""
        return cls(shots=(), generator=np.random.default_rng(np.asarray(jax.random.key_data(key))))

    def with_step(self, evidence: Evidence, *, grip_stiffness: float) -> "ShotHistory":
        """Return the history with the step that led to a frame.

        Args:
            evidence: of the frame.
            grip_stiffness: of the springs to the tip [N/m].

        Raises:
            ValueError: the evidence lacks the step that led to the frame.
        """
        pull = evidence.pull
        if pull is None:
            raise ValueError("multiple shooting needs Evidence.pull, the step that led to the frame; got None.")
        stiffness = jnp.where(evidence.held, grip_stiffness, 0.0)
        parts = (pull.before, pull.tip, pull.length, stiffness, evidence.y, evidence.precision)
        return replace(self, shots=(*self.shots, Shots(*(part[None] for part in parts))))

    def draw(self, k: int) -> tuple["ShotHistory", Shots]:
        """Return M and the history after the draw; samples of no weight stand for those that M lacks to k."""
        generator = copy.deepcopy(self.generator)
        chosen = [self.shots[m] for m in draw_samples(len(self.shots) - 1, k, generator)]
        empty = eqx.tree_at(lambda shot: shot.precision, self.shots[-1], replace_fn=jnp.zeros_like)
        chosen += [empty] * (k - len(chosen))
        drawn = jax.tree.map(lambda *parts: jnp.concatenate(parts), *chosen)
        return replace(self, generator=generator), drawn

    def without_latest(self) -> "ShotHistory":
        """Return the history without the latest step, which no state explains."""
        return replace(self, shots=self.shots[:-1])

    def forgotten(self) -> "ShotHistory":
        """Return the history with t_c set to now: no later update draws a step from before."""
        return replace(self, shots=())


def predicted(simulator: XPBD, shot: Shots, b: Float[Array, " n"], *, sweeps: int) -> Float[Array, "n 3"]:
    """Return f(x_m, u_m, b) of one sample [m], whose arrays lack the leading axis; b [N/m]."""
    grip = Grip.of(shot.tip, shot.length, shot.stiffness)
    return simulator.step(shot.start, b, grip, sweeps=sweeps)


def slopes(f: Callable[[Float[Array, " n"]], Float[Array, "n 3"]], b: Float[Array, " n"]) -> Float[Array, "n n 3"]:
    """Return J^T of a prediction: row i is the derivative of the state by b_i [m^2/N]."""
    columns = jnp.eye(len(b), dtype=b.dtype)
    return jax.lax.map(lambda d: jax.jvp(f, (b,), (d,))[1], columns, batch_size=JACOBIAN_BATCH)


def draw_samples(latest: int, k: int, rng: np.random.Generator) -> Int[np.ndarray, " _k"]:
    """Return the latest step and k - 1 earlier ones, drawn uniformly; fewer where there are fewer."""
    return np.append(rng.choice(latest, size=min(k - 1, latest), replace=False), latest).astype(int)
