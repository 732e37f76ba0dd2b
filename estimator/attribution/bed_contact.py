"""How much of the bed's contact counts around a predicted state: none where a particle is observed to have lifted off.

The bed only pushes, so that a particle that touches it is held from below alone. Linearised there, the model would hold
it from both sides: one that is predicted to touch, and observed 3 mm above, would cost as if the bed pulled at it, and
that cost, tens of nat, would come and go as the prediction touches the bed. There either contact may be,

    on:  the observed height h errs by noise,            ln p = -h^2 / 2 sigma^2,
    off: the push P of the bed is an error of forces,    ln p = -P^2 / 2 tau^2 - ln(sd of a free height / sigma),

and the stiffness of the bed counts by the probability of the first. Where the prediction just touches, P is 0, and it
makes no difference whether it does. The mean over both linearises a force with a kink statistically [Gelb, Applied
Optimal Estimation, 1974, section 6.2].
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..effects.sheet_model import FrameContext, SheetModel, look
from ..physics.environment import BedContact
from .grasped_frames import ClosedFrame
from .sheet import PredictedSheet

LOG_FREE_SD = 2.0
"""Logarithm of the standard deviation of a free particle's predicted height over that of its observed one: 7 times."""


@eqx.filter_jit
def contact_share(
    sheet: PredictedSheet,
    theta: Float[Array, " p"],
    frame: ClosedFrame,
    context: FrameContext,
    x: Float[Array, "n 3"],
    variance: Float[Array, " n"],
) -> Float[Array, " n"]:
    """Return the share of the bed's contact with each particle that counts at its predicted state; 1 without a bed.

    Args:
        sheet: the predicted sheet.
        theta: all parameters of the library.
        frame: what was observed.
        context: what effects know of it.
        x: predicted state [m].
        variance: of a coordinate of each observed position by its noise [m^2].
    """
    model = sheet.model(theta, context, frame.displacement)
    if not model.has(BedContact):
        return jnp.ones(len(x))
    bed, balance = model.term(BedContact), sheet.balance.with_energy(model.energy)
    above = jnp.maximum((frame.y - look(model, x)) @ bed.up, 0.0)
    push = bed.gradient(x[:, None])[:, 0] @ bed.up / balance.error(x)
    log_odds = LOG_FREE_SD + 0.5 * push**2 - 0.5 * above**2 / variance
    return jnp.where(frame.counted, jax.nn.sigmoid(log_odds), 1.0)


def with_contact(model: SheetModel, share: Float[Array, " n"]) -> SheetModel:
    """Return a model with a share of the bed's stiffness under each particle."""
    if not model.has(BedContact):
        return model
    bed = model.term(BedContact)
    return model.with_term(eqx.tree_at(lambda one: one.stiffness, bed, bed.stiffness * share))


def left_out_contact(model: SheetModel, x: Float[Array, "n 3"], share: Float[Array, " n"]) -> Float[Array, "n 3 3"]:
    """Return the stiffness of the bed that does not count, of each particle at a state x [N/m]."""
    if not model.has(BedContact):
        return jnp.zeros((len(x), 3, 3))
    return with_contact(model, 1 - share).term(BedContact).hessian(x[:, None])[:, 0, :, 0]
