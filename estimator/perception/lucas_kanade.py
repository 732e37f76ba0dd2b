"""Windowed Lucas-Kanade registration at the particles, on whole images at once.

Two images that were warped into the same material coordinates are compared in Gaussian windows around each particle:
both are normalised locally, residuals are weighted down robustly, and one Gauss-Newton step (Baker & Matthews 2004,
doi:10.1023/B:VISI.0000011205.11775.fd) is solved per particle, with the mean gradient of the two images. Every
windowed sum is one Gaussian filter over the image. Does not search: the start must be within about one window width.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from .material_map import MaterialMap

CONTRAST_FLOOR = 1.5
"""Grey levels of 255 added to the local standard deviation, so that noise on a bare patch is not made texture."""
ROBUST_SCALE = 0.5
"""Residual, in local standard deviations, at which a pixel counts half."""
LEAST_GRADIENT = 1e-3
"""Smallest eigenvalue of the windowed gradient products that is solved [1/px^2, of normalised images]."""

LEAST_SHARE = 0.2
"""Share of a window that must be known in both images."""


@dataclass(frozen=True, kw_only=True)
class Step:
    """One registration step at each particle."""

    shift: Float[np.ndarray, "n k"]
    """By how much the second image must be sampled further on [material px]; 0 where nothing can be solved."""
    information: Float[np.ndarray, "n k k"]
    """Windowed, weighted gradient products per unit of normalised intensity [1/px^2]."""
    agreement: Float[np.ndarray, " n"]
    """Share of the window, of what both images know, that looks alike: 0 to 1."""


@dataclass(frozen=True, kw_only=True)
class Match:
    """How well two images agree at each particle."""

    noise: Float[np.ndarray, " n"]
    """Windowed, robust RMS residual, of normalised images."""
    correlation: Float[np.ndarray, " n"]
    """Windowed correlation, -1 to 1; -1 where less than a fifth of the window is known in both images."""
    share: Float[np.ndarray, " n"]
    """Share of the window that is known in both images."""


@dataclass(frozen=True, kw_only=True)
class Normalised:
    """An image with its local mean removed and its local contrast set to one."""

    image: Float[np.ndarray, "h w"]
    deviation: Float[np.ndarray, "h w"]
    """What the image was divided by [grey levels]."""
    support: Float[np.ndarray, "h w"]
    """1 where the image is known, 0 elsewhere; float32."""


def normalise(image: Float[np.ndarray, "h w"], support: Bool[np.ndarray, "h w"], *, width: int) -> Normalised:
    """Take off the local mean and divide by the local standard deviation, in a square `width` px wide."""

    def mean_around(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        return cv2.boxFilter(values, cv2.CV_32F, (width, width), borderType=cv2.BORDER_CONSTANT)

    known = support.astype(np.float32)
    share = mean_around(known) + np.float32(1e-6)
    clean = np.where(support, image, np.float32(0))
    mean = mean_around(clean) / share
    square = mean_around(clean * clean) / share
    deviation = np.sqrt(np.maximum(square - mean * mean, 0)) + np.float32(CONTRAST_FLOOR)
    image = np.where(support, (clean - mean) / deviation, np.float32(0))
    return Normalised(image=image, deviation=deviation, support=known)


def step_in_plane(first: Normalised, second: Normalised, material: MaterialMap, *, window: float) -> Step:
    """One step of the second image towards the first, along both axes of the material coordinates."""
    weight, residual = _weight(first, second)
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
    solvable = smallest > LEAST_GRADIENT
    safe = np.where(solvable, determinant, 1)
    shift = np.stack([yy * rx - xy * ry, xx * ry - xy * rx], axis=-1) / safe[:, None]
    return Step(
        shift=np.where(solvable[:, None], shift, 0),
        information=information,
        agreement=_agreement(first, second, weight, material, window),
    )


def step_along(
    first: Normalised, second: Normalised, gradient: Float[np.ndarray, "h w"], material: MaterialMap, *, window: float
) -> Step:
    """One step along a given direction: `gradient` is the second image's derivative by the sought shift."""
    weight, residual = _weight(first, second)
    wg = weight * gradient
    gg, gr = (material.sample(blur(product, window)).astype(float) for product in (wg * gradient, wg * residual))
    solvable = gg > LEAST_GRADIENT
    shift = np.where(solvable, gr / np.where(solvable, gg, 1), 0)
    return Step(
        shift=shift[:, None],
        information=gg[:, None, None],
        agreement=_agreement(first, second, weight, material, window),
    )


def match(first: Normalised, second: Normalised, material: MaterialMap, *, window: float) -> Match:
    """Windowed RMS residual and correlation of two images at the particles."""
    weight, residual = _weight(first, second)
    both = first.support * second.support
    a, b = both * first.image, both * second.image
    products = (both, a, b, a * a, b * b, a * b, weight, weight * residual * residual)
    sums = [material.sample(blur(product, window)).astype(float) for product in products]
    share, mass = np.maximum(sums[0], 1e-6), np.maximum(sums[6], 1e-6)
    a, b, aa, bb, ab = (total / share for total in sums[1:6])
    spread = np.maximum(aa - a * a, 1e-6) * np.maximum(bb - b * b, 1e-6)
    correlation = np.where(share > LEAST_SHARE, (ab - a * b) / np.sqrt(spread), -1.0)
    return Match(noise=np.sqrt(np.maximum(sums[7] / mass, 0)), correlation=correlation, share=sums[0])


def blur(image: Float[np.ndarray, "h w"], window: float) -> Float[np.ndarray, "h w"]:
    """Gaussian filter with zeros beyond the border, cut at 2.5 standard deviations."""
    size = 2 * int(np.ceil(2.5 * window)) + 1
    return cv2.GaussianBlur(image, (size, size), window, borderType=cv2.BORDER_CONSTANT)


def gradients(image: Float[np.ndarray, "h w"]) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Central differences along u and v [1/px], Scharr's smoothing across."""
    return cv2.Scharr(image, cv2.CV_32F, 1, 0, scale=1 / 32), cv2.Scharr(image, cv2.CV_32F, 0, 1, scale=1 / 32)


def _weight(first: Normalised, second: Normalised) -> tuple[np.ndarray, np.ndarray]:
    residual = first.image - second.image
    weight = first.support * second.support / (1 + (residual / np.float32(ROBUST_SCALE)) ** 2)
    return weight, residual


def _agreement(
    first: Normalised, second: Normalised, weight: Float[np.ndarray, "h w"], material: MaterialMap, window: float
) -> Float[np.ndarray, " n"]:
    share = material.sample(blur(first.support * second.support, window)).astype(float)
    return material.sample(blur(weight, window)) / np.maximum(share, 1e-6)
