"""What one frame says of the bounded stiffness s of every attachment, through the sheet's balance of forces.

    y = x + n_y,  n_y ~ N(0, R)      observed positions, a 3x3 block a particle, no row for a missing one
    r(x; s) = n_f                    forces balance up to what the model gets wrong; no row near the grip

With s = b / (b + b_ref), f the gradient of the sheet's own energy and d = x - a, the balance f + b d = 0 times 1 - s is

    r = (1 - s) f + s b_ref d,       n_f ~ N(0, (1 - s)^2 tau^2 + (s b_ref sigma_a)^2),

which at s = 1 is a weld, x = a, and stays sensitive there: D = dr/ds = b_ref d - f holds the reaction force. With
H = dr/dx, W = cov(n_f)^-1 (0 where loaded), A = R^-1 + H^T W H and N^-1 = W - W H A^-1 H^T W, eliminating x leaves for
s the evidence D^T N^-1 D, with D as far as it is more than its own error (`calibrated`). Linear in s at the observed
state, so the wild response of a free sheet is never needed. Needs correspondences.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..physics.block_tridiagonal import (
    BlockCholesky,
    BlockTridiagonal,
    Layout,
    add_to_diagonal,
    assemble,
    cholesky,
    inverse_band,
    lower_square,
    solve,
    window_sums,
)
from ..physics.energy import SheetEnergy
from ..physics.mesh import SheetMesh, neighbour_table, pattern, places_back
from .evidence import Evidence
from .noise import ForceResiduals
from .tethered import Tethered

ROUGH = 3.0
"""Unbalanced force at which a state is smooth enough to be linearised at, in standard deviations of the least force
error."""


class ForceBalance(eqx.Module):
    """The balance of forces of one sheet, to be linearised at any state."""

    energy: SheetEnergy
    tethered: Tethered
    neighbours: Int[Array, "n p"]
    """Particles coupled to each, itself included, padded with n."""
    back: Int[Array, "n p"]
    """Which of each neighbour's own neighbours the particle is; anything where there is none."""
    slots: tuple[Int[Array, "_m _p _p"], ...]
    """Where each term's Hessian windows go in the rows of H."""
    layout: Layout
    """Twice the energy's band: the pattern of H^T H."""
    places: Int[Array, "n p p"]
    """Where the windows of each particle and its neighbours lie in the layout."""
    own_place: Int[Array, "n 1 1"]
    """Where each particle's own window lies."""
    force_sd: Float[Array, ""]
    """Tau where forces of `force_level` meet [N]; see `error`."""
    force_level: Float[Array, ""]
    """[N]."""
    anchor_sd: Float[Array, ""]
    """sigma_a, how far a welded particle may be from its anchor [m]."""
    reference: Float[Array, ""]
    """b_ref [N/m]."""
    grip_stiffness: Float[Array, ""]
    """Stiffness of the tethers of held particles [N/m]."""

    @classmethod
    def build(
        cls,
        mesh: SheetMesh,
        energy: SheetEnergy,
        *,
        reference: float,
        force_sd: float,
        force_level: float,
        anchor_sd: float,
        grip_stiffness: float,
    ) -> "ForceBalance":
        """Prepare the index tables for a mesh and its energy; reference and grip_stiffness [N/m]."""
        neighbours = neighbour_table(mesh.adjacency)
        position = {(i, j): k for i, row in enumerate(neighbours.tolist()) for k, j in enumerate(row) if j >= 0}
        width = neighbours.shape[1]
        slots = tuple(
            jnp.asarray([[[i * width + position[i, j] for j in element] for i in element] for element in vertices])
            for vertices in (np.asarray(term.vertices).tolist() for term in energy.terms)
        )
        coupled = mesh.adjacency.astype(int) @ mesh.adjacency.astype(int)
        layout = Layout.from_pattern(pattern(mesh.n, np.column_stack(coupled.nonzero())), mesh.rest)
        return cls(
            energy=energy,
            tethered=Tethered.build(energy),
            neighbours=jnp.asarray(np.where(neighbours < 0, mesh.n, neighbours)),
            back=jnp.asarray(places_back(neighbours)),
            slots=slots,
            layout=layout,
            places=jnp.asarray(layout.pair_index(neighbours)),
            own_place=jnp.asarray(layout.pair_index(np.arange(mesh.n)[:, None])),
            force_sd=jnp.asarray(force_sd, dtype=float),
            force_level=jnp.asarray(force_level, dtype=float),
            anchor_sd=jnp.asarray(anchor_sd, dtype=float),
            reference=jnp.asarray(reference, dtype=float),
            grip_stiffness=jnp.asarray(grip_stiffness, dtype=float),
        )

    def widened(self, variance: float) -> "ForceBalance":
        """With that many times the variance of the unbalanced force."""
        return eqx.tree_at(lambda one: one.force_sd, self, self.force_sd * jnp.sqrt(variance))

    def of(self, energy: SheetEnergy) -> "ForceBalance":
        """That of the same sheet with other parameters."""
        return eqx.tree_at(lambda one: (one.energy, one.tethered), self, (energy, Tethered.build(energy)))

    def error(self, x: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """tau: standard deviation of the force that the model gets wrong on each particle [N].

        A mesh errs by a share of the forces that its elements bring to a particle, however well these cancel: between
        the reference's shells and the surrogate by 0.05 of the sum of their norms, from 0.3 to 20 mN. It errs alike in
        every frame of a grasp, and is not averaged away, so the share allowed is larger; where they are small `LEAST`
        stays, without which a sheet that hardly moves would seem to say much.
        """
        flow = jnp.zeros(len(x), x.dtype)
        for term in self.energy.terms:
            flow = flow.at[term.vertices].add(jnp.sqrt(jnp.sum(term.gradient(x[term.vertices]) ** 2, axis=-1)))
        return self.force_sd * jnp.sqrt(LEAST**2 + (flow / self.force_level) ** 2)

    def settle(
        self, x: Float[Array, "n 3"], s: Float[Array, " n"], evidence: Evidence, *, unbalanced: float = ROUGH
    ) -> Float[Array, "n 3"]:
        """Equilibrium at fixed s of the sheet tethered to the observed positions, searched from x.

        The search ends where no particle feels more than `unbalanced` standard deviations of the least force error.
        """
        b, sd = self.reference * s / (1 - s), LEAST * self.force_sd
        tolerance, stiff = unbalanced * sd, self.grip_stiffness
        return self.tethered.settle(b, evidence, x, force_sd=sd, force_tolerance=tolerance, grip_stiffness=stiff).x

    def predict(self, x: Float[Array, "n 3"], s: Float[Array, " n"], evidence: Evidence) -> Float[Array, "n 3"]:
        """Equilibrium at fixed s of the sheet that only the grip pulls at, searched from x."""
        held = jnp.where(evidence.held[:, None, None], evidence.precision, 0.0)
        return self.settle(x, s, eqx.tree_at(lambda one: one.precision, evidence, held), unbalanced=1.0)

    def approach(self, x: Float[Array, "n 3"], s: Float[Array, " n"], evidence: Evidence) -> "Frame":
        """Linearise where a Gauss-Newton step on the state alone, at fixed s, gains no more than `SETTLED`."""

        def step(state):
            _, x, _, count = state
            frame = self.linearise(x, s, evidence)
            following, costs = self._best_along(frame, self._state_step(frame, s, evidence), s, evidence)
            return frame, following, jnp.nanmin(costs) < (1 - SETTLED) * costs[0], count + 1

        def unfinished(state):
            return state[2] & (state[3] < STATE_STEPS)

        shapes = jax.eval_shape(lambda: self.linearise(x, s, evidence))
        unlooked = jax.tree.map(lambda part: jnp.zeros(part.shape, part.dtype), shapes)
        frame, _, gaining, _ = jax.lax.while_loop(unfinished, step, (unlooked, x, jnp.asarray(True), jnp.asarray(0)))
        return eqx.tree_at(lambda one: one.converged, frame, ~gaining)

    def polish(self, frame: "Frame", s: Float[Array, " n"], evidence: Evidence) -> Float[Array, "n 3"]:
        """The state for a new s, by a step with the factor at hand."""
        return self._best_along(frame, self._state_step(frame, s, evidence), s, evidence)[0]

    def linearise(self, x: Float[Array, "n 3"], s: Float[Array, " n"], evidence: Evidence) -> "Frame":
        """The balance of forces around x and s."""
        internal, error = self._internal_rows(x), self.error(x)
        weight = self._weight(error, s, evidence)
        itself = (self.neighbours == jnp.arange(len(x))[:, None])[:, :, None, None]
        itself = jnp.where(itself, jnp.eye(3, dtype=x.dtype), 0.0)
        rows = (1 - s)[:, None, None, None] * internal + (s * self.reference)[:, None, None, None] * itself
        squares = jnp.einsum("n,npij,nqik->npjqk", weight, rows, rows)
        matrix = assemble(self.layout, [(self.places, squares)])
        matrix = add_to_diagonal(self.layout, matrix, evidence.precision + FAINT * jnp.eye(3)[None])
        return Frame(
            x=x,
            s=s,
            unbalanced=self.unbalanced(x, s),
            slope=self.reference * (x - self.energy.rest) - self.energy.internal_gradient(x),
            turn=self.reference * itself - internal,
            rows=rows,
            error=error,
            weight=weight,
            factor=cholesky(matrix),
            converged=jnp.asarray(True),
            off=jnp.where(evidence.seen[:, None], evidence.y - x, 0.0),
        )

    def fit(self, frame: "Frame") -> "Fit":
        """The state that explains a frame best, for the s of its linearisation."""
        residual = frame.unbalanced + self.apply(frame.rows, frame.off)
        pushed = self._transposed(frame.rows, frame.weight[:, None] * residual)
        off = solve(self.layout, frame.factor, pushed)
        return Fit(
            residual=residual,
            left=residual - self.apply(frame.rows, off),
            off=off,
            covariance=inverse_band(frame.factor),
        )

    def information(self, frame: "Frame", fit: "Fit") -> "FrameInformation":
        """What the frame says of s, with its state eliminated."""
        slope, whitened = self.calibrated(frame, fit), frame.weight[:, None] * fit.left
        pulled = -jnp.sum(slope * whitened, axis=1)
        squared = jnp.sum(fit.residual * whitened)
        return FrameInformation(
            precision=self.precision_along(frame, slope), pulled=pulled, squared=squared, at=frame.s
        )

    def precision_along(self, frame: "Frame", slope: Float[Array, "n 3"]) -> Float[Array, "n n"]:
        """D^T N^-1 D for a D with a column for each particle, which is `slope` there."""
        layout, w = self.layout, frame.weight
        spread = jnp.einsum("npij,n,ni->npj", frame.rows, w, slope)
        padded = layout.n_blocks * layout.width
        slot = jnp.append(layout.slot, padded)[self.neighbours]
        V = jnp.zeros((padded + 1, 3, padded), spread.dtype).at[slot, :, layout.slot[:, None]].add(spread)[:-1]
        square = lower_square(frame.factor, V.reshape(layout.n_blocks, 3 * layout.width, padded))
        return jnp.diag(w * jnp.sum(slope**2, axis=1)) - square[layout.slot][:, layout.slot]

    def whitened(self, frame: "Frame", v: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """N^-1 v."""
        pushed = self._transposed(frame.rows, frame.weight[:, None] * v)
        return frame.weight[:, None] * (v - self.apply(frame.rows, solve(self.layout, frame.factor, pushed)))

    def misfit(self, frame: "Frame", fit: "Fit", evidence: Evidence) -> ForceResiduals:
        """What is left of the frame."""
        w, free = frame.weight, evidence.seen & ~evidence.held
        fitted = w * window_sums(self.layout, fit.covariance, self.places, frame.rows)
        root = jnp.linalg.cholesky(jnp.where(free[:, None, None], evidence.precision, jnp.eye(3)))
        root = jnp.where(free[:, None, None], jnp.swapaxes(root, 1, 2), 0.0)
        seen = window_sums(self.layout, fit.covariance, self.own_place, root[:, None])
        return ForceResiduals(
            force=jnp.sqrt(w)[:, None] * fit.left,
            force_degrees=jnp.sum(jnp.where(w > 0, 3 - fitted, 0.0)),
            position=jnp.einsum("nij,nj->ni", root, fit.off),
            position_degrees=jnp.sum(jnp.where(free, 3 - seen, 0.0)),
        )

    def calibrated(self, frame: "Frame", fit: "Fit") -> Float[Array, "n 3"]:
        """D, shrunk towards 0 by `DOUBT` times the share of |D|^2 that its own error makes up.

        D is taken at an estimate of x, whose covariance is A^-1. Where nothing moves D is all error, and as a regressor
        would pull s towards where it was linearised; its expectation given what was estimated does not [regression
        calibration: Carroll et al. 2006, doi:10.1201/9781420010138]. The share is known in the mean alone: in one frame
        |D|^2 of an error of three components exceeds its mean by chance, and what that leaves adds up over the frames.
        """
        error = window_sums(self.layout, fit.covariance, self.places, frame.turn)
        squared = jnp.sum(frame.slope**2, axis=1)
        return jnp.maximum(1 - DOUBT * error / jnp.maximum(squared, 1e-30), 0.0)[:, None] * frame.slope

    def _weight(self, error: Float[Array, " n"], s: Float[Array, " n"], evidence: Evidence) -> Float[Array, " n"]:
        variance = ((1 - s) * error) ** 2 + (s * self.reference * self.anchor_sd) ** 2
        return jnp.where(evidence.force_unknown, 0.0, 1 / variance)

    def unbalanced(self, x: Float[Array, "n 3"], s: Float[Array, " n"]) -> Float[Array, "n 3"]:
        """R [N]."""
        internal, d = self.energy.internal_gradient(x), x - self.energy.rest
        return (1 - s)[:, None] * internal + (s * self.reference)[:, None] * d

    def _best_along(
        self, frame: "Frame", move: Float[Array, "n 3"], s: Float[Array, " n"], evidence: Evidence
    ) -> tuple[Float[Array, "n 3"], Float[Array, " _lengths"]]:
        """The point of least cost among a few along a move from a frame's state, and the costs, of no move first."""
        weight = self._weight(frame.error, s, evidence)

        def cost(length: Float[Array, ""]) -> Float[Array, ""]:
            x = frame.x + length * move
            off, force = evidence.y - x, jnp.sum(self.unbalanced(x, s) ** 2, axis=1)
            return 0.5 * (jnp.einsum("ni,nij,nj->", off, evidence.precision, off) + jnp.sum(weight * force))

        lengths = jnp.array([0.0, 0.1, 0.25, 0.5, 1.0], move.dtype)
        costs = jax.vmap(cost)(lengths)
        return frame.x + lengths[jnp.nanargmin(costs)] * move, costs

    def _internal_rows(self, x: Float[Array, "n 3"]) -> Float[Array, "n p 3 3"]:
        """df/dx, the windows of each particle's row beside one another."""
        n, width = self.neighbours.shape
        rows = jnp.zeros((n * width, 3, 3), x.dtype)
        for term, slot in zip(self.energy.terms, self.slots, strict=True):
            windows = jnp.swapaxes(term.hessian(x[term.vertices]), 2, 3).reshape(-1, 3, 3)
            rows = rows.at[slot.reshape(-1)].add(windows)
        return rows.reshape(n, width, 3, 3)

    def _transposed(self, rows: Float[Array, "n p 3 3"], v: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """H^T v, gathered: to scatter takes a CPU five times as long."""
        return self.apply(jnp.swapaxes(rows[self.neighbours, self.back], 2, 3), v)

    def apply(self, rows: Float[Array, "n p 3 3"], v: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """H v."""
        padded = jnp.concatenate([v, jnp.zeros((1, 3), v.dtype)])
        return jnp.einsum("npij,npj->ni", rows, padded[self.neighbours])

    def _state_step(self, frame: "Frame", s: Float[Array, " n"], evidence: Evidence) -> Float[Array, "n 3"]:
        """Move of a frame's state for fixed s, with its factor; Gauss-Newton's if s is its own."""
        pull = jnp.einsum("nij,nj->ni", evidence.precision, evidence.y - frame.x)
        d, free = frame.x - self.energy.rest, (1 - s)[:, None]
        unbalanced = self.reference * d - free * frame.slope
        weighted = self._weight(frame.error, s, evidence)[:, None] * unbalanced
        push = self.reference * weighted - self._transposed(frame.turn, free * weighted)
        return solve(self.layout, frame.factor, pull - push)


class Frame(eqx.Module):
    """The model linearised at a state."""

    x: Float[Array, "n 3"]
    s: Float[Array, " n"]
    unbalanced: Float[Array, "n 3"]
    """r [N]."""
    slope: Float[Array, "n 3"]
    """D [N]."""
    turn: Float[Array, "n p 3 3"]
    """dD/dx [N/m]."""
    rows: Float[Array, "n p 3 3"]
    """H [N/m]."""
    error: Float[Array, " n"]
    """tau [N]."""
    weight: Float[Array, " n"]
    """W [1/N^2]."""
    factor: BlockCholesky
    """Of A."""
    off: Float[Array, "n 3"]
    """y - x, zero where nothing was seen [m]."""
    converged: Bool[Array, ""]
    """Whether the search for x, if there was one, came to an end."""


class Fit(eqx.Module):
    """The state that explains a frame best."""

    residual: Float[Array, "n 3"]
    """Unbalanced force where the particles were seen, e = r + H (y - x) [N]."""
    left: Float[Array, "n 3"]
    """Unbalanced force at the state [N]."""
    off: Float[Array, "n 3"]
    """Seen less fitted position [m]."""
    covariance: BlockTridiagonal
    """The blocks of A^-1 where A has blocks [m^2]."""


class FrameInformation(eqx.Module):
    """What a frame says of s."""

    precision: Float[Array, "n n"]
    """D^T N^-1 D."""
    pulled: Float[Array, " n"]
    """-D^T N^-1 e with e = r + H (y - x), at the s of the linearisation."""
    squared: Float[Array, ""]
    """e^T N^-1 e."""
    at: Float[Array, " n"]
    """s of the linearisation."""

    @property
    def shift(self) -> Float[Array, " n"]:
        """The information form's other half."""
        return self.pulled + self.precision @ self.at


LEAST = 0.25
"""Tau where no forces meet [force_sd]. With 1, attachments of 0.003 k are lost among it."""
DOUBT = 3.0
"""A slope no larger than this many times its expected error says nothing. With 1, particles shielded inside a rigid
patch, of which nothing can be known, are surely called free."""
SETTLED = 0.5
"""A step that lowers the cost by less than this share ends the search for the state."""
STATE_STEPS = 8
"""Most Gauss-Newton steps on the state alone, before the one on state and belief."""
FAINT = 1.0
"""Precision that keeps unseen, slack particles solvable: a standard deviation of 1 m [1/m^2]."""
