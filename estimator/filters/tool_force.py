"""The force of the tool in one frame: what the sheet's balance as a whole says about it.

Inner forces of a sheet cancel, so the tool pulls as hard as the attachments and the sheet's own loads do:

    sum_i c_i (f_i + b_i d_i) = P + n_P,

with f the elastic forces, d the displacements from the anchors, and P the force of the tool on the tissue, less what
lifts the weight and presses on the bed. However wrong the membrane's law is, it does not enter where c is 1.

A weld holds with a force that its position does not show. In the rows of `force_balance` the force on a particle errs
by n_f of the sheet and b n_a of its anchor. Of the sum above, only the anchors' errors are in those rows as well;
taking out what the rows know of them leaves

    c = (1 - s)^2 tau^2 W,    var(n_P) = sum_i s^2 b_ref^2 sigma_a^2 tau^2 W + that of sensor, bed and weight,

which has no noise in common with the rows. At a free particle c is 1; a weld is cut off, and the elastic forces around
it take its place. Where the force is unknown, W is 0, and c is 1.

With x eliminated as in `force_balance`, Z = A^-1 J^T and J the derivative of the left side by x,

    C = dE/ds - (H Z)^T W D,    V = J Z + var(n_P).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..physics.energy import SheetEnergy
from ..physics.environment import BedContact, Weight
from .force_balance import ForceBalance
from .frame import Fit, Frame

MIN_FREE = 0.01
"""Lower bound of 1 - s where it divides at a held particle [1]: stiffer than 100 b_ref, the balance says nothing."""
FRICTION = 0.2
"""Standard deviation of the friction on the bed along each horizontal axis [force on the bed]. The bed of the model has
none; tissue on a wet bed has a coefficient of 0.1 to 0.3, and slides in part only."""
WEIGHT_ERROR = 0.05
"""Standard deviation of the lifted weight [1]: the declared density, and where the sheet leaves the bed."""


class FrameForce(eqx.Module):
    """What the tool's force says about s in one frame: elastic(s) = pull - loads up to both covariances.

    `elastic` and `dE_ds` are of the state fitted to the frame for each s; see `tool_force`.
    """

    index: Int[Array, ""]
    """Index of the observation."""
    elastic: Float[Array, " 3"]
    """Force of the tool on the tissue that sheet and attachments need, at the s of the linearisation [N]."""
    loads: Float[Array, " 3"]
    """The same for weight and bed [N]."""
    pull: Float[Array, " 3"]
    """Force of the tool on the tissue as it was measured [N]."""
    dE_ds: Float[Array, "3 n"]
    """Derivative of `elastic` by s [N]."""
    at: Float[Array, " n"]
    """s of the linearisation."""
    model_covariance: Float[Array, "3 3"]
    """Covariance of `elastic` given s [N^2]."""
    load_covariance: Float[Array, "3 3"]
    """Covariance of the measured force less `loads`, without that of the sensor's offset [N^2]."""
    offset_sd: Float[Array, ""]
    """See `MeasuredPull`."""
    offset_number: Int[Array, ""]
    """See `MeasuredPull`."""


@eqx.filter_jit
def frame_force(balance: ForceBalance, frame: Frame, fit: Fit) -> FrameForce | None:
    """Return what the force of the tool says about s in a linearised frame; None where it was not measured."""
    force = frame.evidence.force
    if force is None:
        return None
    s, unknown, tau, energy = frame.s, frame.evidence.force_unknown, frame.error, balance.energy
    free = jnp.maximum(1 - s, MIN_FREE)
    count = jnp.where(unknown, 1.0, ((1 - s) * tau) ** 2 * frame.weight)
    stiffness = balance.reference * jnp.where(unknown, s / free, s * (1 - s) * tau**2 * frame.weight)
    d = frame.x - energy.rest

    def sums(x: Float[Array, "n 3"]) -> tuple[Float[Array, " 3"], Float[Array, " 3"]]:
        elastic, loads = counted_forces(energy, x, count)
        return elastic + jnp.sum(stiffness[:, None] * (x - energy.rest), axis=0), loads

    (elastic, loads), pullback = jax.vjp(sums, frame.x)
    elastic_at_rest, loads_at_rest = sums(energy.rest)
    J = jax.vmap(lambda axis: pullback((axis, axis))[0], out_axes=2)(jnp.eye(3, dtype=d.dtype))
    Z = jax.vmap(lambda column: balance.solved(frame, column), in_axes=2, out_axes=2)(J)
    HZ = jax.vmap(lambda column: balance.apply(frame.dr_dx, column), in_axes=2, out_axes=2)(Z)
    D = balance.calibrated(frame, fit)
    # Where r = 0, the derivative of b d is D / (1 - s); D then counts as far as in the rows.
    own = jnp.where(
        unknown[:, None],
        (balance.reference / free**2)[:, None] * d,
        ((1 - s) * tau**2 * frame.weight)[:, None] * D,
    )
    anchors = (s * balance.reference * balance.anchor_sd) ** 2
    anchors = jnp.sum(anchors * jnp.where(unknown, 1 / free**2, tau**2 * frame.weight))
    moved = frame.innovation - fit.position_residual
    return FrameForce(
        index=force.index,
        elastic=elastic - elastic_at_rest + jnp.einsum("nic,ni->c", J, moved),
        loads=loads - loads_at_rest,
        pull=force.pull,
        dE_ds=(own - jnp.einsum("n,nic,ni->nc", frame.weight, HZ, D)).T,
        at=s,
        model_covariance=jnp.einsum("nic,nid->cd", J, Z) + anchors * jnp.eye(3),
        load_covariance=_load_covariance(energy, frame.x, loads - loads_at_rest) + force.covariance,
        offset_sd=force.offset_sd,
        offset_number=force.offset_number,
    )


def counted_forces(
    energy: SheetEnergy, x: Float[Array, "n 3"], count: Float[Array, " n"]
) -> tuple[Float[Array, " 3"], Float[Array, " 3"]]:
    """Return the sums of the elastic forces, and of weight and bed, each particle's counted by a factor [N]."""
    sums = [jnp.zeros(3, x.dtype), jnp.zeros(3, x.dtype)]
    for term in energy.terms:
        gradient = term.gradient(x[term.vertices])
        sums[isinstance(term, Weight | BedContact)] += jnp.sum(count[term.vertices][..., None] * gradient, axis=(0, 1))
    return sums[0], sums[1]


def _load_covariance(energy: SheetEnergy, x: Float[Array, "n 3"], loads: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    """Return the covariance of friction and of the lifted weight [N^2]."""
    covariance = WEIGHT_ERROR**2 * jnp.outer(loads, loads)
    for term in energy.terms:
        if isinstance(term, BedContact):
            pressed = jnp.sum(term.gradient(x[term.vertices]), axis=(0, 1)) @ term.up
            covariance += (FRICTION * pressed) ** 2 * (jnp.eye(3) - jnp.outer(term.up, term.up))
    return covariance
