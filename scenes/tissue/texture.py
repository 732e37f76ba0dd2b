"""Procedural textures of tissue and bed: speckle at several scales and branching vessels, drawn from a seed.

Stereo and optical flow find detail at every scale. This is not a model of any real tissue's optics.
"""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

TISSUE_RGB = np.array([214.0, 138.0, 128.0])
"""Mean colour of the tissue [grey levels]."""
VESSEL_RGB = np.array([128.0, 30.0, 40.0])
"""Colour of the vessels [grey levels]."""
BED_RGB = np.array([62.0, 84.0, 96.0])
"""Mean colour of the bed [grey levels]; bluish, so that colour separates it from tissue."""
DESIGN_RESOLUTION = 1024
"""Texture size for which the widths below are given [px]."""
TISSUE_SCALES, HUE_SCALES, BED_SCALES = (2, 4, 8, 20, 60), (12, 40), (2, 5, 15)
"""Blur widths of the noises of tissue shade, tissue hue and bed shade [px of the design resolution]."""
SHADE_CONTRAST, BED_CONTRAST = 0.13, 0.22
"""Relative standard deviation of the shade of tissue and of bed at contrast 1."""
HUE_CONTRAST, HUE_RGB = 7, np.array([0, 1, 0.6])
"""Standard deviation of the hue at contrast 1 [grey levels], and its share in each channel."""
VESSEL_OPACITY = 0.75
"""Largest opacity of a vessel at contrast 1."""
N_TRUNKS = 9
"""Number of vessels that start at random places; each branches."""


def smooth_noise(
    rng: np.random.Generator, resolution: int, scales: tuple[float, ...]
) -> Float[np.ndarray, "resolution resolution"]:
    """Return a sum of blurred white noises, of unit variance and periodic; `scales` are blur widths [px]."""
    total = np.zeros((resolution, resolution))
    for scale in scales:
        margin = min(int(np.ceil(4 * scale)), resolution)
        white = np.pad(rng.standard_normal((resolution, resolution)), margin, mode="wrap")
        layer = cv2.GaussianBlur(white, (0, 0), scale)[margin:-margin, margin:-margin]
        total += layer / layer.std()
    return total / np.sqrt(len(scales))


def vessels(
    rng: np.random.Generator, resolution: int, n_trunks: int = N_TRUNKS
) -> Float[np.ndarray, "resolution resolution"]:
    """Return the opacity, in [0, 1], of random branching lines.

    A walker turns a little at each step, grows thinner, and now and then starts a branch with two thirds of its width.
    """
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
    """Return the RGB image of a membrane with vessels."""
    rng = np.random.default_rng([seed, 1])
    unit = resolution / DESIGN_RESOLUTION
    shade = smooth_noise(rng, resolution, tuple(scale * unit for scale in TISSUE_SCALES))
    hue = smooth_noise(rng, resolution, tuple(scale * unit for scale in HUE_SCALES))
    opacity = VESSEL_OPACITY * vessels(rng, resolution)[..., None]
    base = TISSUE_RGB * (1 + contrast * SHADE_CONTRAST * shade[..., None])
    flesh = base + contrast * HUE_CONTRAST * hue[..., None] * HUE_RGB
    image = flesh * (1 - contrast * opacity) + VESSEL_RGB * contrast * opacity
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def bed_texture(*, seed: int, resolution: int, contrast: float) -> UInt8[np.ndarray, "resolution resolution 3"]:
    """Return the RGB image of a bluish, mottled cloth."""
    rng = np.random.default_rng([seed, 2])
    unit = resolution / DESIGN_RESOLUTION
    shade = smooth_noise(rng, resolution, tuple(scale * unit for scale in BED_SCALES))
    return np.clip(np.round(BED_RGB * (1 + contrast * BED_CONTRAST * shade[..., None])), 0, 255).astype(np.uint8)
