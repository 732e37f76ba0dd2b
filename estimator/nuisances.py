"""What the sheet's forces and shape depend on besides its own parameters, unknown and the same in every frame.

Taken for noise, which averages out over frames, each would bias every frame alike. So they are nuisance parameters with
a prior, in a frame linearised as in `identification`:

    height    What is seen is a surface at a height h over the middle of the sheet, where the forces act. With unit
              normals m it is at y = x + h (m - m_rest). A surface 0.2 mm high on a sheet bent to a radius of 20 mm
              looks strained by 1 %, and the membrane then seems to carry more than the weight.
    friction  The bed resists sliding by mu times its pressure, which the sheet's energy lacks. The displacement from
              rest stands for the direction of sliding, as a lift draws the sheet towards the tool.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .effects.terms import FrictionElements
from .filters.force_balance import ForceBalance
from .filters.frame import Frame
from .physics.energy import SheetEnergy
from .physics.environment import BedContact

HEIGHT, FRICTION = "the height of what is seen above the middle of the sheet", "friction with the bed"
"""What they are called in messages."""
FRICTION_SD = 0.3
"""Prior standard deviation of the coefficient of friction [1], that of the effect `friction`."""


def prior_sd(energy: SheetEnergy, *, height_sd: float) -> dict[str, float]:
    """Return the nuisance parameters of a sheet by name, each with its prior standard deviation, about 0.

    Args:
        energy: of the sheet.
        height_sd: that of the height [m].
    """
    return {HEIGHT: height_sd} if _bed(energy) is None else {HEIGHT: height_sd, FRICTION: FRICTION_SD}


def dr_dnuisance(balance: ForceBalance, frame: Frame, triangles: Int[Array, "f 3"]) -> Float[Array, "n 3 q"]:
    """Return the derivative of the residual force of a frame by each nuisance parameter [N over its unit]."""
    energy, x = balance.energy, frame.x
    rotated = normals(x, triangles) - normals(energy.rest, triangles)
    height = -balance.apply(frame.dr_dx, jnp.where(frame.evidence.seen[:, None], rotated, 0.0))
    bed = _bed(energy)
    if bed is None:
        return height[:, :, None]
    pressing = jnp.linalg.norm(bed.gradient(x[bed.vertices])[:, 0], axis=1)
    elements = FrictionElements(vertices=bed.vertices, start=energy.rest, resisted=pressing, up=bed.up)
    friction = (1 - frame.s)[:, None] * elements.gradient(x[bed.vertices])[:, 0]
    return jnp.stack([height, friction], axis=2)


def normals(x: Float[Array, "n 3"], triangles: Int[Array, "f 3"]) -> Float[Array, "n 3"]:
    """Return the unit normal at each particle: that of its triangles together, by their area."""
    a, b, c = jnp.moveaxis(x[triangles], 1, 0)
    total = jnp.zeros_like(x).at[triangles].add(jnp.cross(b - a, c - a)[:, None])
    return total / jnp.linalg.norm(total, axis=1, keepdims=True)


def _bed(energy: SheetEnergy) -> BedContact | None:
    return next((term for term in energy.terms if isinstance(term, BedContact)), None)
