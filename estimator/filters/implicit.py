"""Implicit extended Kalman filter: the measurement model is the equilibrium itself, with an honest force error.

    y = x + n_y,  n_y ~ N(0, R)         observed positions, a 3x3 block a particle, no row for a missing one
    grad U(x; b) = n_f,  n_f ~ N(0, tau^2 I)    what the model gets wrong, in newtons; no row near the grip

Gauss-Newton on (x, b), from the equilibrium of the sheet tethered to what was observed. With H the Hessian of U,
D = blkdiag(x_i - a_i), W = tau^-2 (0 where loaded), A = R^-1 + H W H and N^-1 = W - W H A^-1 H W, eliminating x leaves
for b the evidence D^T N^-1 D; each frame enters once. Linear in b at the observed state, so the wild response of a free
sheet at b = 0 is never needed. Needs correspondences.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Bool, Float, Int
from jiggle_mj.estimator.belief import BoundaryBelief, entropy, standard_deviations
from jiggle_mj.estimator.block_tridiagonal import (
    BlockCholesky,
    Layout,
    add_to_diagonal,
    assemble,
    cholesky,
    lower_square,
    solve,
)
from jiggle_mj.estimator.energy import SheetEnergy
from jiggle_mj.estimator.environment import Tether
from jiggle_mj.estimator.equilibrium import equilibrium
from jiggle_mj.estimator.filters.evidence import Evidence, Update
from jiggle_mj.estimator.mesh import SheetMesh, pattern


class ImplicitFilter(eqx.Module):
    """The filter for one sheet."""

    energy: SheetEnergy
    tethered: SheetEnergy
    """The same, with springs to the observed positions as its last term."""
    neighbours: Int[Array, "n p"]
    """Particles coupled to each, itself included, padded with n."""
    slots: tuple[Int[Array, "_m _p _p"], ...]
    """Where each term's Hessian windows go in the rows of H."""
    layout: Layout
    """Twice the energy's band: the pattern of H^2."""
    places: Int[Array, "n p p"]
    force_sd: Float[Array, ""]
    """tau [N]."""
    grip_stiffness: Float[Array, ""]
    """Stiffness of the tethers of held particles [N/m]."""

    @classmethod
    def build(cls, mesh: SheetMesh, energy: SheetEnergy, *, force_sd: float, grip_stiffness: float) -> "ImplicitFilter":
        """Prepare the index tables for a mesh and its energy; force_sd [N], grip_stiffness [N/m]."""
        near = sp.csr_array(mesh.adjacency)
        near.sort_indices()
        degree = np.diff(near.indptr)
        neighbours = np.full((mesh.n, degree.max()), -1)
        column = np.arange(len(near.indices)) - np.repeat(near.indptr[:-1], degree)
        neighbours[np.repeat(np.arange(mesh.n), degree), column] = near.indices
        position = {(i, j): k for i, row in enumerate(neighbours.tolist()) for k, j in enumerate(row) if j >= 0}
        width = neighbours.shape[1]
        slots = tuple(
            jnp.asarray([[[i * width + position[i, j] for j in element] for i in element] for element in vertices])
            for vertices in (np.asarray(term.vertices).tolist() for term in energy.terms)
        )
        coupled = sp.csr_array(near.astype(np.int64) @ near.astype(np.int64))
        layout = Layout.from_pattern(pattern(mesh.n, np.column_stack(coupled.nonzero())), mesh.rest)
        return cls(
            energy=energy,
            tethered=SheetEnergy.build(mesh.rest, (*energy.terms, Tether.build(mesh.rest)), energy.layout),
            neighbours=jnp.asarray(np.where(neighbours < 0, mesh.n, neighbours)),
            slots=slots,
            layout=layout,
            places=jnp.asarray(layout.pair_index(neighbours)),
            force_sd=jnp.asarray(force_sd, dtype=float),
            grip_stiffness=jnp.asarray(grip_stiffness, dtype=float),
        )

    @eqx.filter_jit
    def update(
        self, belief: BoundaryBelief, b: Float[Array, " n"], evidence: Evidence, start: Float[Array, "n 3"]
    ) -> Update:
        """See `Filter.update`; the search for the state begins at `start`."""
        frame = self._approach(self._settle(start, b, evidence), b, evidence)
        residual, whitened = self._residual(frame)
        gained, shift = self._information(frame, b, whitened)
        ahead, belief = belief.mean() - b, belief.add(gained, shift)
        factor = jnp.linalg.cholesky(belief.precision)
        nis = self._normalised_innovation(frame, residual, whitened, gained, ahead, factor, evidence)
        b = belief.non_negative_mean(b > 0)
        x = self._polish(frame, b, evidence)
        return Update(belief=belief, x=x, b=b, nis=nis, sd=standard_deviations(factor), entropy=entropy(factor))

    def _force_weight(self, evidence: Evidence) -> Float[Array, " n"]:
        return jnp.where(evidence.loaded, 0.0, self.force_sd**-2)

    def _cost(self, x: Float[Array, "n 3"], b: Float[Array, " n"], evidence: Evidence) -> Float[Array, ""]:
        off = evidence.y - x
        force = jnp.sum(self.energy.gradient(x, b) ** 2, axis=1)
        seen = jnp.einsum("ni,nij,nj->", off, evidence.precision, off)
        return 0.5 * (seen + jnp.sum(self._force_weight(evidence) * force))

    def _settle(self, x: Float[Array, "n 3"], b: Float[Array, " n"], evidence: Evidence) -> Float[Array, "n 3"]:
        """Equilibrium at fixed b of the sheet tethered to the observed positions.

        A tether pulls with tau when a particle is one standard deviation off, so that the outcome nearly balances
        forces and nearly fits, where the raw observation would be crumpled by its noise far outside the linear range.
        """
        sd = jnp.sqrt(3 / jnp.maximum(jnp.trace(evidence.precision, axis1=1, axis2=2), 1e-12))
        pull = (self.force_sd * sd)[:, None, None] * evidence.precision
        stiff = self.grip_stiffness * jnp.eye(3, dtype=x.dtype)
        pull = jnp.where(evidence.held[:, None, None], stiff, pull)
        tethered = eqx.tree_at(lambda e: (e.terms[-1].to, e.terms[-1].stiffness), self.tethered, (evidence.y, pull))
        return equilibrium(tethered, b, x, force_tolerance=self.force_sd / 4, max_steps=25).x

    def _approach(self, x: Float[Array, "n 3"], b: Float[Array, " n"], evidence: Evidence) -> "_Frame":
        """Linearise where a Gauss-Newton step on the state alone, at fixed b, gains no more than `SETTLED`."""

        def look(x: Float[Array, "n 3"]) -> tuple["_Frame", Float[Array, "n 3"], Bool[Array, ""]]:
            frame = self._linearise(x, b, evidence)
            following, cost = self._best_along(x, self._state_step(frame, x, b, evidence), b, evidence)
            return frame, following, cost < (1 - SETTLED) * self._cost(x, b, evidence)

        def step(state):
            _, following, _, count = state
            return *look(following), count + 1

        def unfinished(state):
            return state[2] & (state[3] < STATE_STEPS)

        return jax.lax.while_loop(unfinished, step, (*look(x), jnp.asarray(1)))[0]

    def _polish(self, frame: "_Frame", b: Float[Array, " n"], evidence: Evidence) -> Float[Array, "n 3"]:
        """The state for a new b, by a few steps with the factor at hand."""

        def step(_, x: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
            return self._best_along(x, self._state_step(frame, x, b, evidence), b, evidence)[0]

        return jax.lax.fori_loop(0, POLISH_STEPS, step, frame.x)

    def _best_along(
        self, x: Float[Array, "n 3"], move: Float[Array, "n 3"], b: Float[Array, " n"], evidence: Evidence
    ) -> tuple[Float[Array, "n 3"], Float[Array, ""]]:
        """The point of least cost among a few along a move, and that cost."""
        lengths = jnp.array([0.0, 0.1, 0.25, 0.5, 1.0], x.dtype)
        costs = jax.vmap(lambda length: self._cost(x + length * move, b, evidence))(lengths)
        best = jnp.nanargmin(costs)
        return x + lengths[best] * move, costs[best]

    def _rows(self, x: Float[Array, "n 3"], b: Float[Array, " n"]) -> Float[Array, "n p 3 3"]:
        """H, the windows of each particle's row beside one another."""
        n, width = self.neighbours.shape
        rows = jnp.zeros((n * width, 3, 3), x.dtype)
        for term, slot in zip(self.energy.terms, self.slots, strict=True):
            windows = jnp.swapaxes(term.hessian(x[term.vertices]), 2, 3).reshape(-1, 3, 3)
            rows = rows.at[slot.reshape(-1)].add(windows)
        itself = self.neighbours == jnp.arange(n)[:, None]
        boundary = jnp.where(itself[:, :, None, None], (b[:, None, None] * jnp.eye(3)[None])[:, None], 0.0)
        return rows.reshape(n, width, 3, 3) + boundary

    def _linearise(self, x: Float[Array, "n 3"], b: Float[Array, " n"], evidence: Evidence) -> "_Frame":
        rows, weight = self._rows(x, b), self._force_weight(evidence)
        squares = jnp.einsum("n,npij,nqik->npjqk", weight, rows, rows)
        matrix = assemble(self.layout, [(self.places, squares)])
        matrix = add_to_diagonal(self.layout, matrix, evidence.precision + FAINT * jnp.eye(3)[None])
        return _Frame(
            x=x,
            d=x - self.energy.rest,
            gradient=self.energy.gradient(x, b),
            rows=rows,
            weight=weight,
            factor=cholesky(matrix),
            off=jnp.where(jnp.trace(evidence.precision, axis1=1, axis2=2)[:, None] > 0, evidence.y - x, 0.0),
        )

    def _transposed(self, rows: Float[Array, "n p 3 3"], v: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """H^T v."""
        parts = jnp.einsum("npij,ni->npj", rows, v)
        return jnp.zeros((len(v) + 1, 3), v.dtype).at[self.neighbours].add(parts)[:-1]

    def _state_step(
        self, frame: "_Frame", x: Float[Array, "n 3"], b: Float[Array, " n"], evidence: Evidence
    ) -> Float[Array, "n 3"]:
        """Move of the state at x for fixed b, with the factor of `frame`; Gauss-Newton's if x is its state."""
        pull = jnp.einsum("nij,nj->ni", evidence.precision, evidence.y - x)
        gradient = lambda y: self.energy.gradient(y, b)  # noqa: E731
        push = jax.jvp(gradient, (x,), (frame.weight[:, None] * gradient(x),))[1]
        return solve(self.layout, frame.factor, pull - push)

    def _information(
        self, frame: "_Frame", b: Float[Array, " n"], whitened: Float[Array, "n 3"]
    ) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
        """D^T N^-1 D and the shift that goes with it."""
        layout, w = self.layout, frame.weight
        spread = jnp.einsum("npij,n,ni->npj", frame.rows, w, frame.d)
        padded = layout.n_blocks * layout.width
        slot = jnp.append(layout.slot, padded)[self.neighbours]
        V = jnp.zeros((padded + 1, 3, padded), spread.dtype).at[slot, :, layout.slot[:, None]].add(spread)[:-1]
        square = lower_square(frame.factor, V.reshape(layout.n_blocks, 3 * layout.width, padded))
        gained = jnp.diag(w * jnp.sum(frame.d**2, axis=1)) - square[layout.slot][:, layout.slot]
        return gained, gained @ b - jnp.sum(frame.d * whitened, axis=1)

    def _residual(self, frame: "_Frame") -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
        """The unbalanced force e at the observed positions [N], and N^-1 e."""
        w = frame.weight[:, None]
        residual = frame.gradient + self._apply(frame.rows, frame.off)
        back = solve(self.layout, frame.factor, self._transposed(frame.rows, w * residual))
        return residual, w * (residual - self._apply(frame.rows, back))

    def _normalised_innovation(
        self,
        frame: "_Frame",
        residual: Float[Array, "n 3"],
        whitened: Float[Array, "n 3"],
        gained: Float[Array, "n n"],
        ahead: Float[Array, " n"],
        posterior: Float[Array, "n n"],
        evidence: Evidence,
    ) -> Float[Array, ""]:
        """e^T (N + D Sigma D^T)^-1 e per degree of freedom, with Sigma from before the frame and e at the mean then.

        That mean lies `ahead` of the b that `residual` is for, so e = residual + D ahead. `posterior` is the Cholesky
        factor of the precision after the frame. By Woodbury's identity
        e^T N^-1 e - s^T (Sigma^-1 + D^T N^-1 D)^-1 s with s = D^T N^-1 e.
        """
        at_b = jnp.sum(frame.d * whitened, axis=1)
        squared = jnp.sum(residual * whitened) + ahead @ (2 * at_b + gained @ ahead)
        s = at_b + gained @ ahead
        explained = s @ cho_solve((posterior, True), s)
        observed = 3 * jnp.sum(jnp.trace(evidence.precision, axis1=1, axis2=2) > 0)
        degrees = jnp.maximum(observed - 3 * jnp.sum(evidence.loaded), 1)
        return (squared - explained) / degrees.astype(s.dtype)

    def _apply(self, rows: Float[Array, "n p 3 3"], v: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """H v."""
        padded = jnp.concatenate([v, jnp.zeros((1, 3), v.dtype)])
        return jnp.einsum("npij,npj->ni", rows, padded[self.neighbours])


class _Frame(eqx.Module):
    """The model linearised at a state."""

    x: Float[Array, "n 3"]
    d: Float[Array, "n 3"]
    gradient: Float[Array, "n 3"]
    rows: Float[Array, "n p 3 3"]
    weight: Float[Array, " n"]
    factor: BlockCholesky
    off: Float[Array, "n 3"]


SETTLED = 0.5
"""A step that lowers the cost by less than this share ends the search for the state."""
STATE_STEPS = 8
"""Most Gauss-Newton steps on the state alone, before the one on state and belief."""
POLISH_STEPS = 2
"""Steps of the state after the belief has changed."""
FAINT = 1.0
"""Precision that keeps unseen, slack particles solvable: a standard deviation of 1 m [1/m^2]."""
