"""Where each material point is now: the current images, warped back to the first one through the mesh, and refined.

`MaterialRegistration` follows the left image against the first left image, so nothing drifts; `refine_disparity`
matches the current left and right images in the same material coordinates, so a slanted sheet is no trouble.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from jiggle_mj.estimator.perception.lucas_kanade import (
    Match,
    Normalised,
    gradients,
    match,
    normalise,
    step_along,
    step_in_plane,
)
from jiggle_mj.estimator.perception.material_map import MaterialMap
from jiggle_mj.estimator.perception.mesh_field import MeshField

FINE = 4.0
"""Standard deviation of the matching window [px]."""
COARSE = 8.0
"""The same, for the first steps."""
CONTRAST = 8.0
"""Standard deviation of the window in which brightness and contrast are evened out [px]."""
LONGEST_STEP = 3.0
"""Steps are cut to this length [px]."""
STRAY = 1.0
"""A step that differs by more than this from its neighbours' median is replaced by theirs [px]."""
LEAST_CORRELATION = 0.6
"""Below this a particle is not seen."""


@dataclass(frozen=True, kw_only=True)
class Registered:
    """Outcome of a registration at each particle."""

    value: Float[np.ndarray, "n k"]
    """Current pixel (k = 2) or disparity (k = 1) [px]."""
    match: Match
    spread: Float[np.ndarray, "n k k"]
    """Covariance that white image noise of the residual's size would give [px^2]."""
    last_step: Float[np.ndarray, " n"]
    """Length of the last step [px]: not small where the steps did not settle."""


class MaterialRegistration:
    """Registers left images against the first one."""

    def __init__(self, first: Float[np.ndarray, "height width"], material: MaterialMap, field: MeshField):
        self._material, self._field = material, field
        self._template = normalise(first[material.region], material.support, window=CONTRAST)

    def refine(
        self,
        grey: Float[np.ndarray, "height width"],
        start: Float[np.ndarray, "n 2"],
        *,
        windows: tuple[float, ...],
    ) -> Registered:
        """One step for each window, coarse ones first.

        Args:
            grey: current left image.
            start: guessed current pixel of each particle.
            windows: standard deviations of the matching windows, one a step [px].
        """
        value = start
        for window in windows:
            warped = self._warp(grey, value)
            step = step_in_plane(self._template, warped, self._material, window=window)
            jacobian = self._field.jacobian(value)
            shift = np.einsum("nij,nj->ni", jacobian, _shorten(step.shift))
            seen = match(self._template, warped, self._material, window=window).correlation > 0.3
            shift = _settle(self._field, shift, seen & step.shift.any(axis=1))
            value = value + shift
        warped = self._warp(grey, value)
        information = np.linalg.pinv(step.information, hermitian=True)
        quality = match(self._template, warped, self._material, window=FINE)
        spread = _white_noise(quality, windows[-1]) * (jacobian @ information @ jacobian.transpose(0, 2, 1))
        return Registered(value=value, match=quality, spread=spread, last_step=np.linalg.norm(shift, axis=1))

    def _warp(self, grey: Float[np.ndarray, "height width"], value: Float[np.ndarray, "n 2"]) -> Normalised:
        where = self._material.spread(value)
        warped, inside = sample_inside(grey, where[..., 0], where[..., 1])
        return normalise(warped, self._material.support & inside, window=CONTRAST)


def refine_disparity(
    left: Float[np.ndarray, "height width"],
    right: Float[np.ndarray, "height width"],
    pixels: Float[np.ndarray, "n 2"],
    start: Float[np.ndarray, " n"],
    material: MaterialMap,
    field: MeshField,
    *,
    windows: tuple[float, ...] = (COARSE, FINE, FINE, FINE),
) -> Registered:
    """Disparity of each particle from left and right patches in material coordinates.

    Args:
        left: current left image.
        right: current right image.
        pixels: current left pixel of each particle.
        start: guessed disparity [px].
        material: maps particles to material pixels.
        field: smooth fields over the mesh.
        windows: standard deviations of the matching windows, one a step [px].
    """
    where = material.spread(pixels)
    sampled, inside = sample_inside(left, where[..., 0], where[..., 1])
    first = normalise(sampled, material.support & inside, window=CONTRAST)
    slope_left, _ = sample_inside(gradients(left)[0], where[..., 0], where[..., 1])
    slope = gradients(right)[0]

    def warp(value: Float[np.ndarray, "n 1"]) -> tuple[Normalised, Float[np.ndarray, "h w"]]:
        columns = where[..., 0] - material.spread(value)[..., 0]
        sampled, inside = sample_inside(right, columns, where[..., 1])
        second = normalise(sampled, material.support & inside, window=CONTRAST)
        slope_right, _ = sample_inside(slope, columns, where[..., 1])
        return second, -(slope_left + slope_right) / (2 * second.deviation)

    value = start[:, None]
    for window in windows:
        second, gradient = warp(value)
        step = step_along(first, second, gradient, material, window=window)
        seen = match(first, second, material, window=window).correlation > 0.3
        shift = _settle(field, _shorten(step.shift), seen & step.shift.any(axis=1))
        value = value + shift
    quality = match(first, warp(value)[0], material, window=FINE)
    spread = _white_noise(quality, windows[-1]) / np.maximum(step.information, 1e-9)
    return Registered(value=value, match=quality, spread=spread, last_step=np.abs(shift[:, 0]))


def sample_inside(
    image: Float[np.ndarray, "height width"], columns: Float[np.ndarray, "h w"], rows: Float[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """An image at given pixels, bicubic, and which of them lie inside it."""
    height, width = image.shape
    inside = (columns >= 0) & (columns <= width - 1) & (rows >= 0) & (rows <= height - 1)
    return cv2.remap(image, columns, rows, cv2.INTER_CUBIC), inside


def _shorten(shift: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
    length = np.linalg.norm(shift, axis=1, keepdims=True)
    return shift * np.minimum(1, LONGEST_STEP / np.maximum(length, 1e-9))


def _settle(
    field: MeshField, shift: Float[np.ndarray, "n k"], known: Bool[np.ndarray, " n"]
) -> Float[np.ndarray, "n k"]:
    """Steps as measured where they agree with their neighbours', filled in smoothly elsewhere."""
    known = known & (field.stray(shift, known) < STRAY)
    filled = field.fill(shift, known)
    return np.where(known[:, None], shift, filled)


def _white_noise(quality: Match, window: float) -> Float[np.ndarray, "n 1 1"]:
    """Variance of a windowed mean of white residuals: noise^2 / (4 pi window^2)."""
    return (quality.noise**2 / (4 * np.pi * window**2))[:, None, None]
