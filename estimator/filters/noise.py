"""Factors on the assumed variances of the model's forces and of the positions, learned from residuals.

The assumed noises are where learning starts. Given s, a frame's whitened residuals z have gamma degrees of freedom:
those that the fit of its state does not use,

    E |z|^2 = gamma = 3 m - tr(fit),

over m particles. Independent frames add up: E |sum_t z_t|^2 = sum_t gamma_t over the frames of one grasp. An error that
stays the same from frame to frame, as most of what a model lacks does, adds up faster, and counts by its sum [MacKay
1992, doi:10.1162/neco.1992.4.3.415, for the degrees of freedom]. A ratio of the two above 1 is the factor by which the
variance was too small. A variance is only ever inflated above the assumed one, never reduced: the fit of s absorbs part
of both noises, and data hold little evidence about a noise that is smaller than the other.

`Evidence.inflated` and `ForceBalance.inflated` apply the factors to a frame. The fixed factor
`StereoTrackerConfig.variance_inflation` is another: it is part of what perception states.
"""

from collections.abc import Sequence
from functools import reduce

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

MIN_CHANGE = 1.2
"""Factor by which a learned variance must change before all frames are linearised again [1]."""


class ForceResiduals(eqx.Module):
    """Residuals of one frame, or their sum over the frames of one grasp, whitened by the assumed noise."""

    force: Float[Array, "n 3"]
    """Whitened residual force; 0 where the balance of forces is unknown."""
    force_degrees: Float[Array, ""]
    """Degrees of freedom of the residual forces."""
    position: Float[Array, "n 3"]
    """Whitened difference of observed and fitted position; 0 where nothing was seen or the jaws hold."""
    position_degrees: Float[Array, ""]
    """Degrees of freedom of those differences."""

    def __add__(self, other: "ForceResiduals") -> "ForceResiduals":
        """Return the sum over the frames of both."""
        return ForceResiduals(
            force=self.force + other.force,
            force_degrees=self.force_degrees + other.force_degrees,
            position=self.position + other.position,
            position_degrees=self.position_degrees + other.position_degrees,
        )


class Noise(eqx.Module):
    """Factors on the assumed variances, 1 or more."""

    force: float = 1.0
    """Factor on the variance of the model's force error [1]."""
    position: float = 1.0
    """Factor on the variance of the observed positions [1]."""

    def learned(self, grasps: Sequence[ForceResiduals]) -> "Noise":
        """Return the factors that the residuals of each grasp, whitened by this noise, ask for.

        The same object where they are about as large as this noise expects.
        """
        force = _excess([(grasp.force, grasp.force_degrees) for grasp in grasps])
        position = _excess([(grasp.position, grasp.position_degrees) for grasp in grasps])
        learned = Noise(force=max(1.0, self.force * force), position=max(1.0, self.position * position))
        change = max(_ratio(learned.force, self.force), _ratio(learned.position, self.position))
        return learned if change > MIN_CHANGE else self

    @classmethod
    def shared(cls, grasps: Sequence[ForceResiduals]) -> "Noise":
        """Return the further factors for what all grasps estimate together, such as a parameter of the sheet.

        An error that is the same in every grasp, as that of the rest shape is, adds up over all of them. So it counts
        by the sum over all frames, where this asks for more than the sums over each grasp.

        Args:
            grasps: residuals of each grasp, at least one, whitened by the noise as learned.
        """
        total = reduce(ForceResiduals.__add__, grasps)
        return cls(
            force=max(1.0, _excess([(total.force, total.force_degrees)])),
            position=max(1.0, _excess([(total.position, total.position_degrees)])),
        )


def _excess(grasps: list[tuple[Float[Array, "n 3"], Float[Array, ""]]]) -> float:
    """Return the squared sums of residuals over their degrees of freedom."""
    return float(sum(jnp.sum(residual**2) for residual, _ in grasps) / sum(degrees for _, degrees in grasps))


def _ratio(a: float, b: float) -> float:
    """Return the larger of two positive numbers over the smaller."""
    return max(a / b, b / a)
