"""Effects of what yields: a load beyond a limit moves something, and it stays there until the load turns far enough.

This is rate-independent plasticity with linear hardening. Let v be the displacement or the strain that loads a spring
in series with a slider, and y the largest elongation of the spring. The slider is where

    p = p_before + max(0, 1 - y / |v - p_before|) (v - p_before)

puts it [the play operator: Krasnosel'skii and Pokrovskii 1989, doi:10.1007/978-3-642-61302-9]. With hardening it moves
by a share of p alone, which is the parameter: 1 without hardening, 0 if nothing yields. The model is linear in it. The
limit y has one of a few sizes, the effect's sites.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..physics.environment import lengths
from ..physics.membrane import TriangleMembrane
from .effect import Effect
from .sheet_model import FrameContext, SheetModel

ANCHOR_LIMITS = (5e-4, 1e-3, 2e-3, 4e-3)
"""Elongations beyond which an anchor may yield [m]."""
STRAIN_LIMITS = (0.0125, 0.025, 0.05, 0.1, 0.2)
"""Strains beyond which tissue may yield."""
PULL_LIMITS = (2e-3, 5e-3, 0.01, 0.02)
"""Displacements of the tool beyond which what it holds may slip [m]."""


def play(
    loads: Float[Array, "t n 3"], count: Bool[Array, " t"], limits: tuple[float, ...]
) -> Float[Array, "limits n 3"]:
    """Return where the sliders are after some loads in turn, from 0 on, for each limit of the springs' elongation.

    Args:
        loads: displacement or strain of each spring with its slider.
        count: loads that take place; the others are passed over.
        limits: largest elongations y.
    """

    def slide(limit: Float[Array, ""]) -> Float[Array, "n 3"]:
        def step(p: Float[Array, "n 3"], load: tuple[Float[Array, "n 3"], Bool[Array, ""]]):
            v, counts = load
            beyond = jnp.maximum(1 - limit / lengths(v - p), 0.0)
            return p + jnp.where(counts, beyond[:, None] * (v - p), 0.0), None

        return jax.lax.scan(step, jnp.zeros_like(loads[0]), (loads, count))[0]

    return jax.vmap(slide)(jnp.asarray(limits, dtype=loads.dtype))


def _anchor_yield(model: SheetModel, theta: Float[Array, " limits"], context: FrameContext) -> SheetModel:
    """Let the anchors follow what stretches their springs too far, and stay there."""
    followed = play(context.past - context.rest[None], context.ended <= context.time, ANCHOR_LIMITS)
    shift = jnp.einsum("l,lni->ni", theta, followed)
    return eqx.tree_at(lambda m: m.energy.rest, model, model.energy.rest + shift)


def _tissue_yield(model: SheetModel, theta: Float[Array, " limits"], context: FrameContext) -> SheetModel:
    """Let the unstressed strain follow where the tissue is stretched too far, and stay."""
    membrane = model.term(TriangleMembrane)
    root = jnp.sqrt(jnp.array([[[1.0, 1.0, 0.5]]]))  # |E|^2 = E_11^2 + E_22^2 + 2 E_12^2, from (E_11, E_22, 2 E_12)
    strains = jax.vmap(lambda x: membrane.strain(x[membrane.vertices]))(context.past)
    followed = play(root * strains, context.ended <= context.time, STRAIN_LIMITS) / root
    inelastic = membrane.inelastic + jnp.einsum("l,lfp->fp", theta, followed)
    return model.with_term(eqx.tree_at(lambda t: t.inelastic, membrane, inelastic))


def _grasp_slip(model: SheetModel, theta: Float[Array, " limits"], context: FrameContext) -> SheetModel:
    """Let what is held slip through the jaws, against the tool, where the tool pulls too far since they closed."""
    slipped = play(context.reports[:, None], context.report_times <= context.time, PULL_LIMITS)[:, 0]
    return eqx.tree_at(lambda m: m.tool, model, model.tool - theta @ slipped)


YIELDING = (
    Effect(
        name="anchor_yield",
        acts=_anchor_yield,
        units=("",),
        prior_sd=(0.5,),
        sites=len(ANCHOR_LIMITS),
        source="a share, from 0 where nothing yields to 1",
        confounded_with=("substrate", "tissue_yield", "attachments"),
        non_negative=True,
        history_dependent=True,
    ),
    Effect(
        name="tissue_yield",
        acts=_tissue_yield,
        units=("",),
        prior_sd=(0.5,),
        sites=len(STRAIN_LIMITS),
        source="a share, from 0 where nothing yields to 1",
        confounded_with=("tissue_creep", "anchor_yield"),
        non_negative=True,
        history_dependent=True,
    ),
    Effect(
        name="grasp_slip",
        acts=_grasp_slip,
        units=("",),
        prior_sd=(0.5,),
        sites=len(PULL_LIMITS),
        source="a share, from 0 where nothing slips to 1",
        confounded_with=("tool_scale", "tool_bias"),
        non_negative=True,
        sensing=True,
    ),
)
