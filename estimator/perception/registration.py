"""Registration of the current images, warped back to the first one through the mesh.

`MaterialRegistration` registers the left image to the first left image, so errors do not accumulate.
`refine_disparity` matches the current left and right images in the same material coordinates, so a slanted sheet is
matched like a level one.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from .config import RegistrationConfig
from .lucas_kanade import Match, Normalised, Step, gradients, match, normalise, step_along, step_in_plane
from .material_map import MaterialMap
from .mesh_field import MeshField
from .resampling import sample_doubled, sample_mask

FINE_STEPS = 3
"""Steps with the fine window; the last one tells whether the registration has converged."""
MIN_DIVISOR = 1e-9
"""Lower bound of lengths and information in a denominator, against division by zero."""


@dataclass(frozen=True, kw_only=True)
class Registered:
    """Result of a registration at each particle."""

    value: Float[np.ndarray, "n k"]
    """Current pixel (k = 2) or disparity (k = 1) [px]."""
    match: Match
    """Quality of the match after the last step."""
    spread: Float[np.ndarray, "n k k"]
    """Covariance for residuals of this size that are independent from pixel to pixel [px^2]."""
    last_step: Float[np.ndarray, " n"]
    """Length of the last step [px]: not small where the steps did not converge."""


class MaterialRegistration:
    """Registration of left images to the first one."""

    def __init__(
        self,
        first: Float[np.ndarray, "height width"],
        material: MaterialMap,
        field: MeshField,
        config: RegistrationConfig | None = None,
    ):
        self._material, self._field, self._config = material, field, config or RegistrationConfig()
        self._template = normalise(first[material.region], material.support, self._config)

    def refine(
        self,
        fine: Float[np.ndarray, "doubled_height doubled_width"],
        tissue: Bool[np.ndarray, "height width"],
        start: Float[np.ndarray, "n 2"],
        *,
        windows: tuple[float, ...],
    ) -> Registered:
        """Return the current pixel of each particle, after one step for each window.

        Args:
            fine: current left image, doubled.
            tissue: its tissue pixels; no others are compared.
            start: initial guess of each particle's pixel [px].
            windows: standard deviations of the matching windows, one for each step, coarse ones first [px].
        """
        value = start
        for window in windows[:-1]:
            value, _ = self._advance(fine, tissue, value, window)
        jacobian = self._field.jacobian(value)
        last, step = self._advance(fine, tissue, value, windows[-1])
        warped = self._warp(fine, tissue, last)
        information = np.linalg.pinv(step.information, hermitian=True)
        window = self._config.fine_window
        quality = match(self._template, warped, self._material, window=window, config=self._config)
        spread = _white_noise(quality, windows[-1]) * (jacobian @ information @ jacobian.transpose(0, 2, 1))
        return Registered(value=last, match=quality, spread=spread, last_step=np.linalg.norm(last - value, axis=1))

    def _advance(
        self,
        fine: Float[np.ndarray, "doubled_height doubled_width"],
        tissue: Bool[np.ndarray, "height width"],
        value: Float[np.ndarray, "n 2"],
        window: float,
    ) -> tuple[Float[np.ndarray, "n 2"], Step]:
        """Return the pixels after one step, and the step."""
        warped = self._warp(fine, tissue, value)
        step = step_in_plane(self._template, warped, self._material, window=window, config=self._config)
        shift = np.einsum("nij,nj->ni", self._field.jacobian(value), _shorten(step.shift, self._config))
        return value + _regularised(self._field, shift, step, self._config), step

    def _warp(
        self,
        fine: Float[np.ndarray, "doubled_height doubled_width"],
        tissue: Bool[np.ndarray, "height width"],
        value: Float[np.ndarray, "n 2"],
    ) -> Normalised:
        """Return the current image in the material coordinates of the first one."""
        pixels = self._material.spread(value)
        warped = sample_doubled(fine, pixels[..., 0], pixels[..., 1])
        seen = sample_mask(tissue, pixels[..., 0], pixels[..., 1])
        return normalise(warped, self._material.support & seen, self._config)


def refine_disparity(
    left: Float[np.ndarray, "doubled_height doubled_width"],
    right: Float[np.ndarray, "doubled_height doubled_width"],
    tissue: tuple[Bool[np.ndarray, "height width"], Bool[np.ndarray, "height width"]],
    pixels: Float[np.ndarray, "n 2"],
    start: Float[np.ndarray, " n"],
    material: MaterialMap,
    field: MeshField,
    *,
    config: RegistrationConfig | None = None,
) -> Registered:
    """Return the disparity of each particle from left and right patches in material coordinates.

    Args:
        left: current left image, doubled.
        right: current right image, doubled.
        tissue: tissue pixels of the left and of the right image; no others are compared.
        pixels: current left pixel of each particle [px].
        start: initial guess of the disparity [px].
        material: map from particles to material pixels.
        field: smooth fields over the mesh.
        config: windows and thresholds; the defaults if None.
    """
    config = config or RegistrationConfig()
    windows = (config.coarse_window, *FINE_STEPS * (config.fine_window,))
    where = material.spread(pixels)
    sampled = sample_doubled(left, where[..., 0], where[..., 1])
    support = material.support & sample_mask(tissue[0], where[..., 0], where[..., 1])
    first = normalise(sampled, support, config)
    gradient_left = sample_doubled(2 * gradients(left)[0], where[..., 0], where[..., 1])
    gradient_right = 2 * gradients(right)[0]

    def warp(value: Float[np.ndarray, "n 1"]) -> tuple[Normalised, Float[np.ndarray, "h w"]]:
        columns = where[..., 0] - material.spread(value)[..., 0]
        seen = support & sample_mask(tissue[1], columns, where[..., 1])
        second = normalise(sample_doubled(right, columns, where[..., 1]), seen, config)
        there = sample_doubled(gradient_right, columns, where[..., 1])
        return second, -(gradient_left + there) / (2 * second.deviation)

    def advance(value: Float[np.ndarray, "n 1"], window: float) -> tuple[Float[np.ndarray, "n 1"], Step]:
        second, gradient = warp(value)
        step = step_along(first, second, gradient, material, window=window, config=config)
        return value + _regularised(field, _shorten(step.shift, config), step, config), step

    value = start[:, None]
    for window in windows[:-1]:
        value, _ = advance(value, window)
    last, step = advance(value, windows[-1])
    quality = match(first, warp(last)[0], material, window=config.fine_window, config=config)
    spread = _white_noise(quality, windows[-1]) / np.maximum(step.information, MIN_DIVISOR)
    return Registered(value=last, match=quality, spread=spread, last_step=np.abs(last - value)[:, 0])


def _shorten(shift: Float[np.ndarray, "n k"], config: RegistrationConfig) -> Float[np.ndarray, "n k"]:
    """Return shifts cut to the longest step."""
    length = np.linalg.norm(shift, axis=1, keepdims=True)
    return shift * np.minimum(1, config.max_step / np.maximum(length, MIN_DIVISOR))


def _regularised(
    field: MeshField, shift: Float[np.ndarray, "n k"], step: Step, config: RegistrationConfig
) -> Float[np.ndarray, "n k"]:
    """Return shifts as measured where windows match and neighbours agree, and a smooth fill elsewhere."""
    known = (step.agreement > config.min_agreement) & step.shift.any(axis=1)
    return field.repaired(shift, known, max_stray=config.max_step_stray)[0]


def _white_noise(quality: Match, window: float) -> Float[np.ndarray, "n 1 1"]:
    """Return the variance of a windowed mean of white residuals, noise^2 / (4 pi window^2)."""
    return (quality.noise**2 / (4 * np.pi * window**2))[:, None, None]
