"""How wrong the model and the measurements are, learned from what they leave unexplained.

What the typed noises allow is a beginning. Given s, a frame's whitened residuals have as many degrees of freedom as the
fit of its state leaves over,

    E |z|^2 = gamma = 3 m - tr(fit),

over m particles, and independent frames add up: E |sum_t z_t|^2 = sum_t gamma_t over the frames of one grasp. An error
that stays the same from frame to frame, as most of what a model lacks, adds up faster, and is worth what its sum is
worth [MacKay 1992, doi:10.1162/neco.1992.4.3.415, for the degrees of freedom]. Above 1, the ratio of the two is the
factor by which the variance was too small. Noises are only widened beyond what was typed, never narrowed: the fit of s
absorbs part of them, and data say little of a noise smaller than the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class ForceResiduals(eqx.Module):
    """What is left of one frame, or of the frames of one grasp together; whitened by the noise assumed."""

    force: Float[Array, "n 3"]
    """Unbalanced force, 0 where it is unknown."""
    force_degrees: Float[Array, ""]
    position: Float[Array, "n 3"]
    """Observed less fitted position, 0 where nothing was seen or the jaws hold."""
    position_degrees: Float[Array, ""]

    def __add__(self, other: "ForceResiduals") -> "ForceResiduals":
        """Of both together."""
        return ForceResiduals(
            force=self.force + other.force,
            force_degrees=self.force_degrees + other.force_degrees,
            position=self.position + other.position,
            position_degrees=self.position_degrees + other.position_degrees,
        )


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Factors on the typed variances, from 1 on."""

    force: float = 1.0
    position: float = 1.0

    def learned(self, grasps: Sequence[ForceResiduals]) -> "Noise":
        """After what this noise left of each grasp; the same object where that is about what it expected."""
        force = _excess([(one.force, one.force_degrees) for one in grasps])
        position = _excess([(one.position, one.position_degrees) for one in grasps])
        found = Noise(force=max(1.0, self.force * force), position=max(1.0, self.position * position))
        worth = max(_ratio(found.force, self.force), _ratio(found.position, self.position)) > WORTH
        return found if worth else self


def _excess(grasps: list[tuple[Float[Array, "n 3"], Float[Array, ""]]]) -> float:
    """Squares of the sums against their degrees of freedom."""
    return float(sum(jnp.sum(left**2) for left, _ in grasps) / sum(degrees for _, degrees in grasps))


def _ratio(one: float, other: float) -> float:
    return max(one / other, other / one)


WORTH = 1.2
"""A factor that changes by less is not worth linearising everything again."""
