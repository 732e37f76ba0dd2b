"""Procedural looks of tissue and bed: speckle at several scales and branching vessels, drawn from a seed.

Made so that stereo and optical flow find detail at every scale; not a model of any real tissue's optics.
"""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

TISSUE_RGB = np.array([214.0, 138.0, 128.0])
VESSEL_RGB = np.array([128.0, 30.0, 40.0])
BED_RGB = np.array([62.0, 84.0, 96.0])


def smooth_noise(
    rng: np.random.Generator, resolution: int, scales: tuple[float, ...]
) -> Float[np.ndarray, "resolution resolution"]:
    """Sum of blurred white noises, of unit variance and without seams; `scales` are blur widths in texture pixels."""
    total = np.zeros((resolution, resolution))
    for scale in scales:
        margin = min(int(np.ceil(4 * scale)), resolution)
        white = np.pad(rng.standard_normal((resolution, resolution)), margin, mode="wrap")
        layer = cv2.GaussianBlur(white, (0, 0), scale)[margin:-margin, margin:-margin]
        total += layer / layer.std()
    return total / np.sqrt(len(scales))


def vessels(rng: np.random.Generator, resolution: int, n_trunks: int = 9) -> Float[np.ndarray, "resolution resolution"]:
    """Opacity in [0, 1] of wandering, branching lines."""
    canvas = np.zeros((resolution, resolution), dtype=np.uint8)
    size = float(resolution)
    walkers = [
        (rng.uniform(0, size, 2), rng.uniform(0, 2 * np.pi), rng.uniform(5, 9) * size / 1024) for _ in range(n_trunks)
    ]
    while walkers:
        position, heading, width = walkers.pop()
        for _ in range(int(rng.integers(40, 90))):
            heading += rng.normal(0, 0.22)
            ahead = position + size / 110 * np.array([np.cos(heading), np.sin(heading)])
            ends = [tuple(int(v) for v in np.round(p * 16)) for p in (position, ahead)]
            cv2.line(canvas, ends[0], ends[1], 255, max(round(width), 1), cv2.LINE_AA, 4)
            position, width = ahead, width * 0.985
            if width > 1.8 * size / 1024 and rng.uniform() < 0.07:
                walkers.append((position, heading + rng.choice([-1, 1]) * rng.uniform(0.5, 1.0), width * 0.65))
    return cv2.GaussianBlur(canvas.astype(np.float64) / 255, (0, 0), size / 900)


def tissue_texture(*, seed: int, resolution: int, contrast: float) -> UInt8[np.ndarray, "resolution resolution 3"]:
    """RGB of a membrane with vessels."""
    rng = np.random.default_rng([seed, 1])
    unit = resolution / 1024
    shade = smooth_noise(rng, resolution, (2 * unit, 4 * unit, 8 * unit, 20 * unit, 60 * unit))
    hue = smooth_noise(rng, resolution, (12 * unit, 40 * unit))
    opacity = 0.75 * vessels(rng, resolution)[..., None]
    flesh = TISSUE_RGB * (1 + contrast * 0.13 * shade[..., None]) + contrast * 7 * hue[..., None] * np.array(
        [0, 1, 0.6]
    )
    image = flesh * (1 - contrast * opacity) + VESSEL_RGB * contrast * opacity
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def bed_texture(*, seed: int, resolution: int, contrast: float) -> UInt8[np.ndarray, "resolution resolution 3"]:
    """RGB of a bluish, mottled cloth."""
    rng = np.random.default_rng([seed, 2])
    unit = resolution / 1024
    shade = smooth_noise(rng, resolution, (2 * unit, 5 * unit, 15 * unit))
    return np.clip(np.round(BED_RGB * (1 + contrast * 0.22 * shade[..., None])), 0, 255).astype(np.uint8)
