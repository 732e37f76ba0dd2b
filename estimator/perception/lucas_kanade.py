"""Windowed Lucas-Kanade registration at the particles, on whole images at once.

Two images in the same material coordinates are compared in Gaussian windows around each particle: both are normalised
locally, residuals get robust weights, and one Gauss-Newton step (Baker & Matthews 2004,
doi:10.1023/B:VISI.0000011205.11775.fd) is solved per particle, with the mean gradient of the two images. Every
windowed sum is one Gaussian filter over the image. There is no search: the start must be within about one window.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from .config import RegistrationConfig
from .material_map import MaterialMap

MIN_GRADIENT = 1e-3
"""Smallest eigenvalue of the windowed gradient products for which a step is solved [1/px^2, of normalised images]:
below it the window has no texture along some direction."""
MIN_KNOWN_SHARE = 0.2
"""Share of a window that must be known in both images for a correlation."""
MIN_DIVISOR = 1e-6
"""Lower bound of shares and variances in a denominator, against division by zero where nothing is known."""
BLUR_CUT = 2.5
"""Half-width at which the Gaussian window is cut [standard deviations]; about 97 % of its weight lies inside."""


@dataclass(frozen=True, kw_only=True)
class Step:
    """One registration step at each particle."""

    shift: Float[np.ndarray, "n k"]
    """Shift by which the second image must be sampled further on [material px]; 0 where no step can be solved."""
    information: Float[np.ndarray, "n k k"]
    """Windowed, weighted gradient products per unit of normalised intensity [1/px^2]."""
    agreement: Float[np.ndarray, " n"]
    """Share of the window, among pixels that both images know, that matches: 0 to 1."""


@dataclass(frozen=True, kw_only=True)
class Match:
    """Quality of the match of two images at each particle."""

    noise: Float[np.ndarray, " n"]
    """Windowed, robust RMS residual of the normalised images."""
    correlation: Float[np.ndarray, " n"]
    """Windowed correlation, -1 to 1; -1 where less than a fifth of the window is known in both images."""
    share: Float[np.ndarray, " n"]
    """Share of the window that is known in both images."""


@dataclass(frozen=True, kw_only=True)
class Normalised:
    """An image with its local mean removed and its local contrast set to one."""

    image: Float[np.ndarray, "h w"]
    """Normalised grey values; 0 where unknown."""
    deviation: Float[np.ndarray, "h w"]
    """Divisor of the image: local standard deviation plus the contrast floor [grey levels]."""
    support: Float[np.ndarray, "h w"]
    """1 where the image is known, 0 elsewhere; float32."""


def normalise(
    image: Float[np.ndarray, "h w"], support: Bool[np.ndarray, "h w"], config: RegistrationConfig
) -> Normalised:
    """Return the image minus its local mean, divided by its local standard deviation.

    Mean and deviation are taken in a square `RegistrationConfig.contrast_width` px wide.
    """
    width = config.contrast_width

    def mean_around(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        return cv2.boxFilter(values, cv2.CV_32F, (width, width), borderType=cv2.BORDER_CONSTANT)

    known = support.astype(np.float32)
    share = mean_around(known) + np.float32(MIN_DIVISOR)
    clean = np.where(support, image, np.float32(0))
    mean = mean_around(clean) / share
    square = mean_around(clean * clean) / share
    deviation = np.sqrt(np.maximum(square - mean * mean, 0)) + np.float32(config.contrast_floor)
    image = np.where(support, (clean - mean) / deviation, np.float32(0))
    return Normalised(image=image, deviation=deviation, support=known)


def step_in_plane(
    first: Normalised, second: Normalised, material: MaterialMap, *, window: float, config: RegistrationConfig
) -> Step:
    """Return one step of the second image towards the first, along both axes of the material coordinates.

    `window` is the standard deviation of the matching window [px].
    """
    weight, residual = _robust(first, second, config)
    gx, gy = gradients((first.image + second.image) / 2)
    wgx, wgy = weight * gx, weight * gy
    sums = [
        material.sample(blur(product, window))
        for product in (wgx * gx, wgx * gy, wgy * gy, wgx * residual, wgy * residual)
    ]
    xx, xy, yy, rx, ry = (total.astype(float) for total in sums)
    information = np.stack([np.stack([xx, xy], axis=-1), np.stack([xy, yy], axis=-1)], axis=-2)
    trace, determinant = xx + yy, xx * yy - xy * xy
    smallest = trace / 2 - np.sqrt(np.maximum(trace**2 / 4 - determinant, 0))
    solvable = smallest > MIN_GRADIENT
    safe = np.where(solvable, determinant, 1)
    shift = np.stack([yy * rx - xy * ry, xx * ry - xy * rx], axis=-1) / safe[:, None]
    return Step(
        shift=np.where(solvable[:, None], shift, 0),
        information=information,
        agreement=_agreement(first, second, weight, material, window),
    )


def step_along(
    first: Normalised,
    second: Normalised,
    gradient: Float[np.ndarray, "h w"],
    material: MaterialMap,
    *,
    window: float,
    config: RegistrationConfig,
) -> Step:
    """Return one step along a given direction.

    `gradient` is the second image's derivative by the unknown shift, `window` the standard deviation of the matching
    window [px].
    """
    weight, residual = _robust(first, second, config)
    wg = weight * gradient
    gg, gr = (material.sample(blur(product, window)).astype(float) for product in (wg * gradient, wg * residual))
    solvable = gg > MIN_GRADIENT
    shift = np.where(solvable, gr / np.where(solvable, gg, 1), 0)
    return Step(
        shift=shift[:, None],
        information=gg[:, None, None],
        agreement=_agreement(first, second, weight, material, window),
    )


def match(
    first: Normalised, second: Normalised, material: MaterialMap, *, window: float, config: RegistrationConfig
) -> Match:
    """Return the windowed RMS residual, correlation and known share of two images at the particles.

    `window` is the standard deviation of the matching window [px].
    """
    weight, residual = _robust(first, second, config)
    both = first.support * second.support
    a, b = both * first.image, both * second.image
    products = (both, a, b, a * a, b * b, a * b, weight, weight * residual * residual)
    sums = [material.sample(blur(product, window)).astype(float) for product in products]
    share, mass = np.maximum(sums[0], MIN_DIVISOR), np.maximum(sums[6], MIN_DIVISOR)
    a, b, aa, bb, ab = (total / share for total in sums[1:6])
    spread = np.maximum(aa - a * a, MIN_DIVISOR) * np.maximum(bb - b * b, MIN_DIVISOR)
    correlation = np.where(share > MIN_KNOWN_SHARE, (ab - a * b) / np.sqrt(spread), -1.0)
    return Match(noise=np.sqrt(np.maximum(sums[7] / mass, 0)), correlation=correlation, share=sums[0])


def blur(image: Float[np.ndarray, "h w"], window: float) -> Float[np.ndarray, "h w"]:
    """Return the image after a Gaussian filter of standard deviation `window` [px], with zeros beyond the border."""
    size = 2 * int(np.ceil(BLUR_CUT * window)) + 1
    return cv2.GaussianBlur(image, (size, size), window, borderType=cv2.BORDER_CONSTANT)


def gradients(image: Float[np.ndarray, "h w"]) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Return central differences along u and v with Scharr's smoothing across [1/px]; its weights sum to 32."""
    return cv2.Scharr(image, cv2.CV_32F, 1, 0, scale=1 / 32), cv2.Scharr(image, cv2.CV_32F, 0, 1, scale=1 / 32)


def _robust(first: Normalised, second: Normalised, config: RegistrationConfig) -> tuple[np.ndarray, np.ndarray]:
    """Return Cauchy weights of the pixels, 0 where either image is unknown, and the residuals."""
    residual = first.image - second.image
    weight = first.support * second.support / (1 + (residual / np.float32(config.robust_scale)) ** 2)
    return weight, residual


def _agreement(
    first: Normalised, second: Normalised, weight: Float[np.ndarray, "h w"], material: MaterialMap, window: float
) -> Float[np.ndarray, " n"]:
    """Return the windowed weight among the known pixels; see `Step.agreement`."""
    share = material.sample(blur(first.support * second.support, window)).astype(float)
    return material.sample(blur(weight, window)) / np.maximum(share, MIN_DIVISOR)
