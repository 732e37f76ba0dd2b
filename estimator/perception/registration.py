"""Where each material point is now: the current images, warped back to the first one through the mesh, and refined.

`MaterialRegistration` follows the left image against the first left image, so nothing drifts; `refine_disparity`
matches the current left and right images in the same material coordinates, so a slanted sheet is no trouble.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from .lucas_kanade import Match, Normalised, Step, gradients, match, normalise, step_along, step_in_plane
from .material_map import MaterialMap
from .mesh_field import MeshField
from .resampling import sample_doubled

FINE = 4.0
"""Standard deviation of the matching window [px]."""
COARSE = 8.0
"""The same, for the first steps."""
CONTRAST = 27
"""Width of the square in which brightness and contrast are evened out [px]."""
LONGEST_STEP = 3.0
"""Steps are cut to this length [px]."""
STRAY = 1.0
"""A step that differs by more than this from its neighbours' median is replaced by theirs [px]."""
LEAST_AGREEMENT = 0.2
"""Steps from windows that look alike over less than this share are not taken."""
LEAST_CORRELATION = 0.6
"""Below this a particle is not seen."""


@dataclass(frozen=True, kw_only=True)
class Registered:
    """Outcome of a registration at each particle."""

    value: Float[np.ndarray, "n k"]
    """Current pixel (k = 2) or disparity (k = 1) [px]."""
    match: Match
    spread: Float[np.ndarray, "n k k"]
    """Covariance that residuals of this size would give, were they independent from pixel to pixel [px^2]."""
    last_step: Float[np.ndarray, " n"]
    """Length of the last step [px]: not small where the steps did not settle."""


class MaterialRegistration:
    """Registers left images against the first one."""

    def __init__(self, first: Float[np.ndarray, "height width"], material: MaterialMap, field: MeshField):
        self._material, self._field = material, field
        self._template = normalise(first[material.region], material.support, width=CONTRAST)

    def refine(
        self,
        fine: Float[np.ndarray, "doubled_height doubled_width"],
        tissue: Bool[np.ndarray, "height width"],
        start: Float[np.ndarray, "n 2"],
        *,
        windows: tuple[float, ...],
    ) -> Registered:
        """One step for each window, coarse ones first.

        Args:
            fine: current left image, doubled.
            tissue: its tissue pixels; nothing else is compared.
            start: guessed current pixel of each particle.
            windows: standard deviations of the matching windows, one a step [px].
        """
        value = start
        for window in windows[:-1]:
            value, _ = self._advance(fine, tissue, value, window)
        jacobian = self._field.jacobian(value)
        settled, step = self._advance(fine, tissue, value, windows[-1])
        warped = self._warp(fine, tissue, settled)
        information = np.linalg.pinv(step.information, hermitian=True)
        quality = match(self._template, warped, self._material, window=FINE)
        spread = _white_noise(quality, windows[-1]) * (jacobian @ information @ jacobian.transpose(0, 2, 1))
        return Registered(
            value=settled, match=quality, spread=spread, last_step=np.linalg.norm(settled - value, axis=1)
        )

    def _advance(
        self,
        fine: Float[np.ndarray, "doubled_height doubled_width"],
        tissue: Bool[np.ndarray, "height width"],
        value: Float[np.ndarray, "n 2"],
        window: float,
    ) -> tuple[Float[np.ndarray, "n 2"], Step]:
        step = step_in_plane(self._template, self._warp(fine, tissue, value), self._material, window=window)
        shift = np.einsum("nij,nj->ni", self._field.jacobian(value), _shorten(step.shift))
        return value + _settle(self._field, shift, step), step

    def _warp(
        self,
        fine: Float[np.ndarray, "doubled_height doubled_width"],
        tissue: Bool[np.ndarray, "height width"],
        value: Float[np.ndarray, "n 2"],
    ) -> Normalised:
        where = self._material.spread(value)
        warped = sample_doubled(fine, where[..., 0], where[..., 1])
        seen = sample_mask(tissue, where[..., 0], where[..., 1])
        return normalise(warped, self._material.support & seen, width=CONTRAST)


def refine_disparity(
    left: Float[np.ndarray, "doubled_height doubled_width"],
    right: Float[np.ndarray, "doubled_height doubled_width"],
    tissue: tuple[Bool[np.ndarray, "height width"], Bool[np.ndarray, "height width"]],
    pixels: Float[np.ndarray, "n 2"],
    start: Float[np.ndarray, " n"],
    material: MaterialMap,
    field: MeshField,
    *,
    windows: tuple[float, ...] = (COARSE, FINE, FINE, FINE),
) -> Registered:
    """Disparity of each particle from left and right patches in material coordinates.

    Args:
        left: current left image, doubled.
        right: current right image, doubled.
        tissue: tissue pixels of the left and of the right image; nothing else is compared.
        pixels: current left pixel of each particle.
        start: guessed disparity [px].
        material: maps particles to material pixels.
        field: smooth fields over the mesh.
        windows: standard deviations of the matching windows, one a step [px].
    """
    where = material.spread(pixels)
    sampled = sample_doubled(left, where[..., 0], where[..., 1])
    support = material.support & sample_mask(tissue[0], where[..., 0], where[..., 1])
    first = normalise(sampled, support, width=CONTRAST)
    slope_left = sample_doubled(2 * gradients(left)[0], where[..., 0], where[..., 1])
    slope = 2 * gradients(right)[0]

    def warp(value: Float[np.ndarray, "n 1"]) -> tuple[Normalised, Float[np.ndarray, "h w"]]:
        columns = where[..., 0] - material.spread(value)[..., 0]
        seen = support & sample_mask(tissue[1], columns, where[..., 1])
        second = normalise(sample_doubled(right, columns, where[..., 1]), seen, width=CONTRAST)
        slope_right = sample_doubled(slope, columns, where[..., 1])
        return second, -(slope_left + slope_right) / (2 * second.deviation)

    def advance(value: Float[np.ndarray, "n 1"], window: float) -> tuple[Float[np.ndarray, "n 1"], Step]:
        second, gradient = warp(value)
        step = step_along(first, second, gradient, material, window=window)
        return value + _settle(field, _shorten(step.shift), step), step

    value = start[:, None]
    for window in windows[:-1]:
        value, _ = advance(value, window)
    settled, step = advance(value, windows[-1])
    quality = match(first, warp(settled)[0], material, window=FINE)
    spread = _white_noise(quality, windows[-1]) / np.maximum(step.information, 1e-9)
    return Registered(value=settled, match=quality, spread=spread, last_step=np.abs(settled - value)[:, 0])


def sample_mask(
    mask: Bool[np.ndarray, "height width"], columns: Float[np.ndarray, "h w"], rows: Float[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """A mask at given pixels, False outside the image."""
    return cv2.remap(mask.astype(np.uint8), columns, rows, cv2.INTER_NEAREST, borderValue=0) > 0


def _shorten(shift: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
    length = np.linalg.norm(shift, axis=1, keepdims=True)
    return shift * np.minimum(1, LONGEST_STEP / np.maximum(length, 1e-9))


def _settle(field: MeshField, shift: Float[np.ndarray, "n k"], step: Step) -> Float[np.ndarray, "n k"]:
    """Shifts as measured where windows look alike and neighbours agree, filled in smoothly elsewhere."""
    known = (step.agreement > LEAST_AGREEMENT) & step.shift.any(axis=1)
    known &= field.stray(shift, known) < STRAY
    return np.where(known[:, None], shift, field.fill(shift, known))


def _white_noise(quality: Match, window: float) -> Float[np.ndarray, "n 1 1"]:
    """Variance of a windowed mean of white residuals: noise^2 / (4 pi window^2)."""
    return (quality.noise**2 / (4 * np.pi * window**2))[:, None, None]
