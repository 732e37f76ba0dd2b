"""Extended position-based dynamics [Macklin et al. 2016, doi:10.1145/2994258.2994272]: the paper's simulator f.

One step from x_t, with no velocity, approaches the minimum of

    1/2 dt^-2 (x - x~)^T M (x - x~) + U(x; b),   x~ = x_t + dt^2 M^-1 f_external,

by sweeps of Gauss-Seidel over the constraints C = C_m + C_a + C_b, each with a multiplier lambda, zero at the start:

    d_lambda = -(C + alpha~ lambda) / (grad C M^-1 grad C^T + alpha~),   alpha~ = 1 / (k dt^2),
    dx = M^-1 grad C^T d_lambda.

Here numerator and denominator are multiplied by k dt^2, so that zero stiffness means no constraint and no division by
zero. Constraints of one colour share no particle and move at once. A few sweeps are the paper's f. A step that is
swept until it converges is one step of implicit Euler, except for the rotation of the springs during the step. `settle`
reaches argmin U in many steps, and `equilibrium` directly.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .environment import Grip, lengths
from .membrane import EdgeMembrane
from .mesh import SheetMesh

Residual = Callable[[Float[Array, "n 3"]], Float[Array, "n 3"]]
"""Displacement that is added to the particles at given positions [m]."""


class XPBD(eqx.Module):
    """The simulator of one sheet."""

    rest: Float[Array, "n 3"]
    """Anchors of the boundary springs [m]."""
    batches: tuple[EdgeMembrane, ...]
    """Springs C_m on edges and across hinges, by colour."""
    inverse_mass: Float[Array, " n"]
    """Inverse mass of each particle [1/kg]."""
    force: Float[Array, "n 3"]
    """External force on each particle [N]; the paper has none."""
    time_step: Float[Array, ""]
    """Time step dt [s]."""

    @classmethod
    def build(
        cls,
        mesh: SheetMesh,
        springs: tuple[EdgeMembrane, ...],
        *,
        areal_density: float,
        time_step: float,
        gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> "XPBD":
        """Build the simulator of a mesh, with its springs in colours.

        Args:
            mesh: the sheet.
            springs: its C_m, for example `EdgeMembrane.build` and `hinge_springs`.
            areal_density: mass per area [kg/m^2].
            time_step: dt [s].
            gravity: acceleration [m/s^2].
        """
        mass = areal_density * mesh.particle_area
        batches = tuple(
            EdgeMembrane(
                vertices=np.asarray(spring.vertices)[colour],
                length=spring.length[colour],
                stiffness=spring.stiffness[colour],
            )
            for spring in springs
            for colour in colours(np.asarray(spring.vertices), mesh.n)
        )
        return cls(
            rest=jnp.asarray(mesh.rest),
            batches=batches,
            inverse_mass=jnp.asarray(1 / mass),
            force=jnp.asarray(mass[:, None] * np.asarray(gravity)),
            time_step=jnp.asarray(time_step, dtype=float),
        )

    def step(
        self,
        x: Float[Array, "n 3"],
        b: Float[Array, " n"],
        grip: Grip | None = None,
        *,
        sweeps: int,
        residual: Residual | None = None,
    ) -> Float[Array, "n 3"]:
        """Return f(x_t, u, b) [m], one step from x_t, differentiable by unrolling in all arguments but `sweeps`.

        Args:
            x: x_t [m].
            b: stiffness of the boundary springs [N/m].
            grip: C_a with the tip at u; None for open jaws.
            sweeps: number of Gauss-Seidel sweeps.
            residual: displacement to add before the constraints of each sweep: the paper's f', matched to a cloud.
        """
        return self._sweeps(self._fall(x), self._zero_multipliers(x), b, grip, sweeps, residual)[0]

    def settle(
        self, x: Float[Array, "n 3"], b: Float[Array, " n"], grip: Grip | None = None, *, sweeps: int, steps: int
    ) -> Float[Array, "n 3"]:
        """Return positions near argmin U [m], by steps that each begin with the multipliers of the step before.

        Steps whose multipliers begin at zero, as in `step`, come to rest elsewhere, because the springs rotate between
        the fall and the sweeps that undo it. Here a state that does not move has grad U = 0. Stable while k dt^2 / m is
        below about 0.2 for the stiffest spring, so this takes thousands of short steps; it is for checking.
        """

        def advance(state, _):
            x, multipliers = state
            return self._sweeps(
                self._with_impulses(self._fall(x), x, multipliers, grip), multipliers, b, grip, sweeps
            ), None

        return jax.lax.scan(advance, (x, self._zero_multipliers(x)), length=steps)[0][0]

    def _fall(self, x):
        """Return x~ [m], the end of a step without constraints."""
        return x + self.time_step**2 * self.inverse_mass[:, None] * self.force

    def _zero_multipliers(self, x):
        """Return zero multipliers for the mesh's batches, the grip and the boundary springs."""
        of_mesh = tuple(jnp.zeros(len(batch.length), x.dtype) for batch in self.batches)
        return of_mesh, jnp.zeros(len(x), x.dtype), jnp.zeros_like(x)

    def _with_impulses(self, start, x, multipliers, grip):
        """Return `start` moved by M^-1 grad C(x)^T lambda [m]."""
        of_mesh, of_grip, of_boundary = multipliers
        w = self.inverse_mass[:, None]
        impulse = of_boundary
        for batch, multiplier in zip(self.batches, of_mesh, strict=True):
            i, j = batch.vertices.T
            push = _direction(x[j] - x[i])[0] * multiplier[:, None]
            impulse = impulse.at[i].add(-push).at[j].add(push)
        if grip is not None:
            impulse = impulse + _direction(x - grip.tip[None])[0] * of_grip[:, None]
        return start + w * impulse

    def _sweeps(self, start, multipliers, b, grip, number: int, residual: Residual | None = None):
        """Return positions and multipliers after a number of sweeps."""

        def advance(state, _):
            x, multipliers = state
            x = x if residual is None else x + residual(x)
            return self._sweep(x, multipliers, b, grip), None

        return jax.lax.scan(advance, (start, multipliers), length=number)[0]

    def _sweep(self, x, multipliers, b, grip):
        """Apply all constraints once: C_m colour by colour, then C_a, then C_b."""
        of_mesh, of_grip, of_boundary = multipliers
        moved = []
        for batch, multiplier in zip(self.batches, of_mesh, strict=True):
            x, multiplier = self._stretch(x, multiplier, batch)
            moved.append(multiplier)
        if grip is not None:
            x, of_grip = self._hold(x, of_grip, grip)
        x, of_boundary = self._anchor(x, of_boundary, b)
        return x, (tuple(moved), of_grip, of_boundary)

    def _stretch(self, x, multiplier, batch: EdgeMembrane):
        """Apply C = |x_1 - x_0| - l."""
        i, j = batch.vertices.T
        direction, distance = _direction(x[j] - x[i])
        w_i, w_j = self.inverse_mass[i], self.inverse_mass[j]
        change = self._change(distance - batch.length, multiplier, w_i + w_j, batch.stiffness)
        push = direction * change[:, None]
        x = x.at[i].add(-w_i[:, None] * push, unique_indices=True).at[j].add(w_j[:, None] * push, unique_indices=True)
        return x, multiplier + change

    def _hold(self, x, multiplier, grip: Grip):
        """Apply C_a = |x_j - u| - r_j."""
        direction, distance = _direction(x - grip.tip[None])
        change = self._change(distance - grip.length, multiplier, self.inverse_mass, grip.stiffness)
        return x + (self.inverse_mass * change)[:, None] * direction, multiplier + change

    def _anchor(self, x, multiplier, b):
        """Apply the vector C_b = x_i - a_i: the paper's |x_i - a_i| has no gradient at x_i = a_i, where it starts."""
        change = self._change(x - self.rest, multiplier, self.inverse_mass[:, None], b[:, None])
        return x + self.inverse_mass[:, None] * change, multiplier + change

    def _change(self, constraint, multiplier, inverse_mass, stiffness):
        """Return d_lambda of constraints with a unit gradient."""
        scaled = stiffness * self.time_step**2
        return -(scaled * constraint + multiplier) / (scaled * inverse_mass + 1)


def hinge_springs(mesh: SheetMesh, *, stiffness: float) -> EdgeMembrane:
    """Return bending springs between the two corners opposite to each inner edge.

    The paper asks for "bending constraints between neighboring mesh faces" and says that all its constraints are
    distances between particles; this constraint is both. `stiffness` [N/m] is that of each spring.
    """
    pairs = mesh.hinges[:, 2:]
    length = np.linalg.norm(mesh.rest[pairs[:, 1]] - mesh.rest[pairs[:, 0]], axis=1)
    return EdgeMembrane(
        vertices=pairs, length=jnp.asarray(length), stiffness=jnp.full(len(pairs), stiffness, dtype=float)
    )


def colours(pairs: Int[np.ndarray, "m 2"], n: int) -> list[Int[np.ndarray, " _k"]]:
    """Return groups of pairs that share no particle: greedy colouring, each pair in the first group that is free."""
    taken: list[set[int]] = [set() for _ in range(n)]
    groups: list[list[int]] = []
    for number, (i, j) in enumerate(pairs.tolist()):
        colour = next(c for c in range(len(groups) + 1) if c not in taken[i] and c not in taken[j])
        if colour == len(groups):
            groups.append([])
        groups[colour].append(number)
        taken[i].add(colour)
        taken[j].add(colour)
    return [np.array(group) for group in groups]


def _direction(d: Float[Array, "m 3"]) -> tuple[Float[Array, "m 3"], Float[Array, " m"]]:
    """Return unit vectors and lengths [m]."""
    distance = lengths(d)
    return d / distance[:, None], distance
