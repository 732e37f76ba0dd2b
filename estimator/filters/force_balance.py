"""One frame's evidence about the bounded stiffness s of every attachment, by the sheet's balance of forces.

    y = x + n_y,  n_y ~ N(0, R)      observed positions, a 3x3 block for each particle, no row for a missing one
    r(x; s) = n_f                    the forces balance up to the model's error; no row near the grip

With s = b / (b + b_ref), f the gradient of the sheet's own energy and d = x - a the displacement from the anchor a, the
balance f + b d = 0 times 1 - s is

    r = (1 - s) f + s b_ref d,       n_f ~ N(0, (1 - s)^2 tau^2 + (s b_ref sigma_a)^2).

At s = 1 it is a weld, x = a, and stays sensitive to s: D = dr/ds = b_ref d - f holds the reaction force. With
H = dr/dx, W = cov(n_f)^-1 (0 where the force is unknown), A = R^-1 + H^T W H and N^-1 = W - W H A^-1 H^T W, eliminating
x leaves the evidence D^T N^-1 D about s. D counts as far as it exceeds its own error (`calibrated`).

The balance is linear in s at the observed state, so the response of a free sheet, which is strongly nonlinear, is never
needed. R and A are without the noise that neighbours share (`smooth_noise`). A cloud is matched anew at each state
(`Evidence.near`).
"""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..physics.block_tridiagonal import (
    Layout,
    inverse_band,
    lower_square,
    normal_cholesky,
    solve,
    window_sums,
)
from ..physics.energy import SheetEnergy
from ..physics.environment import lengths
from ..physics.mesh import SheetMesh, neighbour_table, pattern, reverse_places
from .config import FilterConfig
from .evidence import Evidence
from .frame import Fit, Frame, FrameInformation
from .noise import ForceResiduals
from .smooth_noise import FrameNoise, each
from .tethered import Tethered

STEP_LENGTHS = (0.0, 0.1, 0.25, 0.5, 1.0)
"""Shares of a step that the line search tries [1]; the first is no step, so that a step never raises the cost."""
CLOUD_GATES = (2.0, 1.0, 0.5, 0.25)
"""Heights up to which points of a cloud count while the sheet settles, matched anew each time [spacing]."""
MIN_SQUARE = 1e-30
"""Lower bound of |D|^2 where it divides [N^2]: far below the square of any force in a sheet."""


class ForceBalance(eqx.Module):
    """The balance of forces of one sheet, which can be linearised at any state."""

    energy: SheetEnergy
    """Energy of the sheet without attachments and grip [J]."""
    tethered: Tethered
    """The same sheet on springs to observed positions."""
    neighbours: Int[Array, "n p"]
    """Particles coupled to each, itself included, padded with n."""
    back: Int[Array, "n p"]
    """Index of the particle among each neighbour's own neighbours; anything where there is no neighbour."""
    slots: tuple[Int[Array, "_m _p _p"], ...]
    """Index of each energy term's Hessian windows in the rows of H."""
    layout: Layout
    """Pattern of H^T H, twice the band of the energy's Hessian."""
    places: Int[Array, "n p p"]
    """Index in the layout of the windows of each particle and its neighbours."""
    own_place: Int[Array, "n 1 1"]
    """Index in the layout of each particle's own window."""
    force_sd: Float[Array, ""]
    """tau where forces of `force_level` meet [N]; see `error`."""
    force_level: Float[Array, ""]
    """Sum of the forces that meet at a particle for which `force_sd` holds [N]."""
    anchor_sd: Float[Array, ""]
    """sigma_a, the standard deviation of a welded particle from its anchor [m]."""
    reference: Float[Array, ""]
    """b_ref [N/m]."""
    grip_stiffness: Float[Array, ""]
    """Stiffness of the springs of held particles to where the tool takes them [N/m]."""
    config: FilterConfig = eqx.field(static=True)
    """Numbers of the linearisation."""

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
        config: FilterConfig | None = None,
    ) -> "ForceBalance":
        """Prepare the index tables for a mesh and its energy.

        Args:
            mesh: the sheet.
            energy: of the sheet without attachments and grip.
            reference: b_ref [N/m].
            force_sd: tau where forces of `force_level` meet [N], as the other numbers at the fields.
            force_level: see there [N].
            anchor_sd: see there [m].
            grip_stiffness: see there [N/m].
            config: numbers of the linearisation; the defaults if None.
        """
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
            back=jnp.asarray(reverse_places(neighbours)),
            slots=slots,
            layout=layout,
            places=jnp.asarray(layout.pair_index(neighbours)),
            own_place=jnp.asarray(layout.pair_index(np.arange(mesh.n)[:, None])),
            force_sd=jnp.asarray(force_sd, dtype=float),
            force_level=jnp.asarray(force_level, dtype=float),
            anchor_sd=jnp.asarray(anchor_sd, dtype=float),
            reference=jnp.asarray(reference, dtype=float),
            grip_stiffness=jnp.asarray(grip_stiffness, dtype=float),
            config=config or FilterConfig(),
        )

    def inflated(self, variance: float | Float[Array, ""]) -> "ForceBalance":
        """Return the balance with `variance` times the variance of the force error."""
        return eqx.tree_at(lambda balance: balance.force_sd, self, self.force_sd * jnp.sqrt(variance))

    def with_energy(self, energy: SheetEnergy) -> "ForceBalance":
        """Return the balance of the same mesh with another energy, such as one of other parameters."""
        return eqx.tree_at(lambda b: (b.energy, b.tethered), self, (energy, self.tethered.with_energy(energy)))

    def in_frame(self, evidence: Evidence) -> tuple["ForceBalance", Evidence]:
        """Return the balance with the energy of one frame, and the frame's evidence without it."""
        own = self if evidence.energy is None else self.with_energy(evidence.energy)
        return own, replace(evidence, energy=None)

    def error(self, x: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """Return tau, the standard deviation of the model's force error on each particle [N].

        A mesh errs by a share of the forces that its elements bring to a particle, however well these cancel: between
        the reference's shells and the surrogate by 0.05 of the sum of their norms, from 0.3 to 20 mN. The error is
        alike in every frame of a grasp and does not average out, so the assumed share is larger. Where the forces are
        small, `FilterConfig.force_sd_floor` stays.
        """
        flow = jnp.zeros(len(x), x.dtype)
        for term in self.energy.terms:
            flow = flow.at[term.vertices].add(lengths(term.gradient(x[term.vertices])))
        return self.force_sd * jnp.sqrt(self.config.force_sd_floor**2 + (flow / self.force_level) ** 2)

    @eqx.filter_jit
    def settle(
        self, x: Float[Array, "n 3"], s: Float[Array, " n"], evidence: Evidence, *, unbalanced: float | None = None
    ) -> Float[Array, "n 3"]:
        """Return the equilibrium at fixed s of the sheet on springs to the observed positions [m], searched from x.

        The search ends where no particle feels more than `unbalanced` times the smallest standard deviation of the
        force error; None stands for `FilterConfig.smooth_force`.
        """
        unbalanced = self.config.smooth_force if unbalanced is None else unbalanced
        b, sd = self.reference * s / (1 - s), self.config.force_sd_floor * self.force_sd
        tolerance, stiff = unbalanced * sd, self.grip_stiffness
        for gate in (0.0,) if evidence.cloud is None else CLOUD_GATES:
            near = evidence.near(x, gate=gate)
            x = self.tethered.settle(b, near, x, force_sd=sd, force_tolerance=tolerance, grip_stiffness=stiff).x
        return x

    def predict(self, x: Float[Array, "n 3"], s: Float[Array, " n"], evidence: Evidence) -> Float[Array, "n 3"]:
        """Return the equilibrium at fixed s of the sheet that only the grip pulls at [m], searched from x."""
        return self.settle(x, s, evidence.of_grip(), unbalanced=1.0)

    def approach(self, x: Float[Array, "n 3"], s: Float[Array, " n"], evidence: Evidence) -> Frame:
        """Return the frame linearised at the state that Gauss-Newton steps from x, at fixed s, lead to.

        Where noise is shared, all steps but the last take it for that of single particles, which is faster.

        The search ends where a step lowers the cost by less than `FilterConfig.min_cost_decrease` of it, and is cut off
        after `FilterConfig.max_state_steps`: then `Frame.converged` is False.
        """
        config, single = self.config, evidence.without_fields()

        def step(state):
            _, x, _, count = state
            frame = self.linearise(x, s, single)
            following, costs = self._best_along(frame, self._state_step(frame, s), s)
            return frame, following, jnp.nanmin(costs) < (1 - config.min_cost_decrease) * costs[0], count + 1

        def unfinished(state):
            _, _, decreasing, count = state
            return decreasing & (count < config.max_state_steps)

        shapes = jax.eval_shape(lambda: self.linearise(x, s, single))  # of the frame that the first step replaces
        empty = jax.tree.map(lambda part: jnp.zeros(part.shape, part.dtype), shapes)
        frame, _, decreasing, _ = jax.lax.while_loop(unfinished, step, (empty, x, jnp.asarray(True), jnp.asarray(0)))
        if evidence.fields is not None:
            near = self.linearise(frame.x, s, evidence)
            frame = self.linearise(self.polish(near, s), s, evidence)
        return eqx.tree_at(lambda frame: frame.converged, frame, ~decreasing)

    @eqx.filter_jit
    def evidence_near(
        self, x: Float[Array, "n 3"], s: Float[Array, " n"], evidence: Evidence
    ) -> tuple[Frame, Fit, FrameInformation]:
        """Return a frame linearised at a state near x [m], its fit, and its evidence about s, as one program."""
        fit = self.fit(frame := self.approach(x, s, evidence))
        return frame, fit, self.information(frame, fit)

    def polish(self, frame: Frame, s: Float[Array, " n"]) -> Float[Array, "n 3"]:
        """Return the state for another s [m], by one step with the frame's own factor."""
        return self._best_along(frame, self._state_step(frame, s), s)[0]

    def linearise(self, x: Float[Array, "n 3"], s: Float[Array, " n"], evidence: Evidence) -> Frame:
        """Return the balance of forces linearised at x and s."""
        evidence = evidence.near(x)
        internal, error = self._internal_dr_dx(x), self.error(x)
        weight = self.weight(error, s, evidence)
        identity = (self.neighbours == jnp.arange(len(x))[:, None])[:, :, None, None]
        identity = jnp.where(identity, jnp.eye(3, dtype=x.dtype), 0.0)
        dr_dx = (1 - s)[:, None, None, None] * internal + (s * self.reference)[:, None, None, None] * identity
        precision, fields = self.position_precision(evidence), evidence.seen_fields
        factor = normal_cholesky(self.layout, self.places, dr_dx, weight, precision)
        return Frame(
            x=x,
            s=s,
            unbalanced=self.unbalanced(x, s),
            dr_ds=self.reference * (x - self.energy.rest) - self.energy.internal_gradient(x),
            dD_dx=self.reference * identity - internal,
            dr_dx=dr_dx,
            error=error,
            weight=weight,
            factor=factor,
            smooth=FrameNoise.build(self.layout, factor, precision, fields) if fields.shape[1] else None,
            converged=jnp.asarray(True),
            evidence=evidence,
        )

    def fit(self, frame: Frame) -> Fit:
        """Return the state that explains a frame best, for the s of its linearisation."""
        residual = frame.unbalanced + self.apply(frame.dr_dx, frame.innovation)
        position_residual = self.explained(frame, residual)
        return Fit(
            residual=residual,
            force_residual=residual - self.apply(frame.dr_dx, position_residual),
            position_residual=position_residual,
            covariance=inverse_band(frame.factor),
        )

    def information(self, frame: Frame, fit: Fit) -> FrameInformation:
        """Return the frame's evidence about s, with its state eliminated."""
        D, whitened = self.calibrated(frame, fit), frame.weight[:, None] * fit.force_residual
        score = -jnp.sum(D * whitened, axis=1)
        chi2 = jnp.sum(fit.residual * whitened)
        return FrameInformation(precision=self.precision_along(frame, D), score=score, chi2=chi2, at=frame.s)

    def precision_along(self, frame: Frame, D: Float[Array, "n 3"]) -> Float[Array, "n n"]:
        """Return D^T N^-1 D for a matrix D with a column for each particle, which is `D[i]` there and 0 elsewhere.

        By A = R^-1 + H^T W H = L L^T it is diag(w |D|^2) - |L^-1 H^T W D|^2.
        """
        layout, w = self.layout, frame.weight
        spread = jnp.einsum("npij,n,ni->npj", frame.dr_dx, w, D)
        padded = layout.n_blocks * layout.width
        slot = jnp.append(layout.slot, padded)[self.neighbours]
        V = jnp.zeros((padded + 1, 3, padded), spread.dtype).at[slot, :, layout.slot[:, None]].add(spread)[:-1]
        square = lower_square(frame.factor, V.reshape(layout.n_blocks, 3 * layout.width, padded))
        precision = jnp.diag(w * jnp.sum(D**2, axis=1)) - square[layout.slot][:, layout.slot]
        if frame.smooth is None:
            return precision
        pushed = each(partial(self.apply, frame.dr_dx), frame.smooth.states)
        shared = frame.smooth.whitened(jnp.einsum("ni,nic->nc", w[:, None] * D, pushed))
        return precision - shared @ shared.T

    def whitened(self, frame: Frame, v: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Return N^-1 v."""
        return frame.weight[:, None] * (v - self.apply(frame.dr_dx, self.explained(frame, v)))

    def explained(self, frame: Frame, v: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Return A^-1 H^T W v, the change of the state that explains forces v best [m]."""
        return self.solved(frame, self.transposed(frame.dr_dx, frame.weight[:, None] * v))

    def residuals(self, frame: Frame, fit: Fit) -> ForceResiduals:
        """Return the whitened residuals of the frame's fit, with their degrees of freedom."""
        evidence = frame.evidence
        w, free, smooth = frame.weight, evidence.seen & ~evidence.held, frame.smooth
        fitted = w * window_sums(self.layout, fit.covariance, self.places, frame.dr_dx)
        white = self.position_precision(evidence)
        root = jnp.linalg.cholesky(jnp.where(free[:, None, None], white, jnp.eye(3)))
        root = jnp.where(free[:, None, None], jnp.swapaxes(root, 1, 2), 0.0)
        seen = window_sums(self.layout, fit.covariance, self.own_place, root[:, None])
        observed, position = evidence.directions.astype(seen.dtype), fit.position_residual
        position_degrees = jnp.sum(jnp.where(free, observed - seen, 0.0))
        if smooth is not None:
            fitted = fitted + w * smooth.spread_of(partial(self.apply, frame.dr_dx))
            position = position - smooth.explained(position)
            position_degrees = position_degrees + smooth.added_degrees(root)
        return ForceResiduals(
            force=jnp.sqrt(w)[:, None] * fit.force_residual,
            force_degrees=jnp.sum(jnp.where(w > 0, 3 - fitted, 0.0)),
            position=jnp.einsum("nij,nj->ni", root, position),
            position_degrees=position_degrees,
        )

    def calibrated(self, frame: Frame, fit: Fit) -> Float[Array, "n 3"]:
        """Return D, shrunk towards 0 by `FilterConfig.error_weight` times the share of |D|^2 that its error makes up.

        D is taken at an estimate of x, whose covariance is A^-1. Where nothing moves D is all error, and as a regressor
        would pull s towards where it was linearised. Its expectation given the estimate does not [regression
        calibration: Carroll et al. 2006, doi:10.1201/9781420010138]. Only the mean of that share is known: in a single
        frame the |D|^2 of an error with three components exceeds its mean by chance, and these excesses add up over the
        frames.
        """
        error = window_sums(self.layout, fit.covariance, self.places, frame.dD_dx)
        if frame.smooth is not None:
            error = error + frame.smooth.spread_of(partial(self.apply, frame.dD_dx))
        share = self.config.error_weight * error / jnp.maximum(jnp.sum(frame.dr_ds**2, axis=1), MIN_SQUARE)
        return jnp.maximum(1 - share, 0.0)[:, None] * frame.dr_ds

    def position_precision(self, evidence: Evidence) -> Float[Array, "n 3 3"]:
        """Return R^-1 of the white noise, with `FilterConfig.position_precision_floor` [1/m^2]."""
        return evidence.white_precision + self.config.position_precision_floor * jnp.eye(3)[None]

    def weight(self, error: Float[Array, " n"], s: Float[Array, " n"], evidence: Evidence) -> Float[Array, " n"]:
        """Return W, the inverse variance of r at each particle [1/N^2]."""
        variance = ((1 - s) * error) ** 2 + (s * self.reference * self.anchor_sd) ** 2
        return jnp.where(evidence.force_unknown, 0.0, 1 / variance)

    def unbalanced(self, x: Float[Array, "n 3"], s: Float[Array, " n"]) -> Float[Array, "n 3"]:
        """Return the residual force r(x; s) [N]."""
        internal, d = self.energy.internal_gradient(x), x - self.energy.rest
        return (1 - s)[:, None] * internal + (s * self.reference)[:, None] * d

    def _best_along(
        self, frame: Frame, move: Float[Array, "n 3"], s: Float[Array, " n"]
    ) -> tuple[Float[Array, "n 3"], Float[Array, " _lengths"]]:
        """Return the point of least cost among a few along a move from a frame's state, and the costs of all."""
        evidence, weight = frame.evidence, self.weight(frame.error, s, frame.evidence)

        def cost(length: Float[Array, ""]) -> Float[Array, ""]:
            x = frame.x + length * move
            innovation, force = evidence.y - x, jnp.sum(self.unbalanced(x, s) ** 2, axis=1)
            seen = jnp.einsum("ni,nij,nj->", innovation, evidence.white_precision, innovation)
            if frame.smooth is not None:
                seen = seen + frame.smooth.added_cost(innovation)
            return 0.5 * (seen + jnp.sum(weight * force))

        shares = jnp.array(STEP_LENGTHS, move.dtype)
        costs = jax.vmap(cost)(shares)
        return frame.x + shares[jnp.nanargmin(costs)] * move, costs

    def _internal_dr_dx(self, x: Float[Array, "n 3"]) -> Float[Array, "n p 3 3"]:
        """Return df/dx, the windows of each particle's row beside one another [N/m]."""
        n, width = self.neighbours.shape
        rows = jnp.zeros((n * width, 3, 3), x.dtype)
        for term, slot in zip(self.energy.terms, self.slots, strict=True):
            windows = jnp.swapaxes(term.hessian(x[term.vertices]), 2, 3).reshape(-1, 3, 3)
            rows = rows.at[slot.reshape(-1)].add(windows)
        return rows.reshape(n, width, 3, 3)

    def transposed(self, rows: Float[Array, "n p 3 3"], v: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Return H^T v by indexing: adding into indices takes a CPU five times as long."""
        return self.apply(jnp.swapaxes(rows[self.neighbours, self.back], 2, 3), v)

    def apply(self, rows: Float[Array, "n p 3 3"], v: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Return H v for the windows of H's rows."""
        padded = jnp.concatenate([v, jnp.zeros((1, 3), v.dtype)])
        return jnp.einsum("npij,npj->ni", rows, padded[self.neighbours])

    def _state_step(self, frame: Frame, s: Float[Array, " n"]) -> Float[Array, "n 3"]:
        """Return the step A^-1 (R^-1 (y - x) - H^T W r) at fixed s; a Gauss-Newton step if s is the frame's, as A is.

        With D = b_ref d - f it is r = b_ref d - (1 - s) D and H = b_ref I - (1 - s) dD/dx.
        """
        evidence = frame.evidence
        pull = jnp.einsum("nij,nj->ni", evidence.white_precision, evidence.y - frame.x)
        d, free = frame.x - self.energy.rest, (1 - s)[:, None]
        unbalanced = self.reference * d - free * frame.dr_ds
        weighted = self.weight(frame.error, s, evidence)[:, None] * unbalanced
        push = self.reference * weighted - self.transposed(frame.dD_dx, free * weighted)
        if frame.smooth is not None:
            pull = pull + frame.smooth.added_pull(evidence.y - frame.x)
        return self.solved(frame, pull - push)

    def solved(self, frame: Frame, v: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Return A^-1 v, with the smooth noise in A."""
        solved = solve(self.layout, frame.factor, v)
        return solved if frame.smooth is None else solved + frame.smooth.added_state(solved)
