"""Disturbances of the images: noise, blur, gloss, smoke, blood, a thick tool in the way, cameras exposed unequally."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import cv2
import mujoco
import numpy as np
from jaxtyping import Float

from jiggle_mj.observation import StereoPair

from ..scene.disturbance import SensingDisturbance
from ..scene.section import integer, number
from ..sensing.observer import Image, Observer
from ..sensing.points import add_image_noise
from ..tissue.texture import smooth_noise

SMOKE_RGB = np.array([205.0, 205.0, 210.0])
BLOOD_RGB = np.array([58.0, 10.0, 12.0])
SMOKE_GRID = 64
"""Pixels of the picture from which the smoke is enlarged."""
SMOKE_DISPARITY = 1 / 16
"""Of the image's width: about twice that of tissue in the default camera."""


@dataclass(frozen=True, kw_only=True)
class OfImages(SensingDisturbance[Observer]):
    """What only rendered images show."""

    needs: ClassVar[tuple[str, ...]] = ("stereo",)


@dataclass(frozen=True, kw_only=True)
class ImageNoise(OfImages):
    """A noisier camera."""

    magnitude: float = number(10.0, unit="grey levels", at_least=0, at_most=100)
    """Standard deviation of white noise on top of the scene's."""

    def begin(self, observer: Observer) -> None:
        """Add it."""
        observer.faults.images.append(lambda pair, rng: add_image_noise(pair, sd=self.magnitude, rng=rng))


@dataclass(frozen=True, kw_only=True)
class Blur(OfImages):
    """A camera out of focus."""

    magnitude: float = number(2.0, unit="px", above=0, at_most=50)
    """Standard deviation of the Gaussian."""

    def begin(self, observer: Observer) -> None:
        """Blur both images."""
        observer.faults.images.append(
            lambda pair, _: _each(pair, lambda image: cv2.GaussianBlur(image, (0, 0), self.magnitude))
        )


@dataclass(frozen=True, kw_only=True)
class Exposure(OfImages):
    """The right camera is exposed otherwise than the left one."""

    magnitude: float = number(0.7, above=0, at_most=10)
    """Right over left."""

    def begin(self, observer: Observer) -> None:
        """Scale the right image."""
        observer.faults.images.append(
            lambda pair, _: StereoPair(left=pair.left, right=_whole(pair.right * self.magnitude))
        )


@dataclass(frozen=True, kw_only=True)
class Haze(OfImages):
    """Smoke before the camera."""

    magnitude: float = number(0.4, at_least=0, at_most=1)
    """How much of the light it replaces on average."""

    def begin(self, observer: Observer) -> None:
        """Other clouds in each frame, nearer to the cameras than the tissue, so further apart in the two images."""

        def hazed(pair: StereoPair, rng: np.random.Generator) -> StereoPair:
            height, width = pair.left.shape[:2]
            apart = round(width * SMOKE_DISPARITY)
            clouds = cv2.resize(smooth_noise(rng, SMOKE_GRID, (SMOKE_GRID / 10,)), (width + apart, height))
            return StereoPair(
                left=_smoky(pair.left, self.magnitude, clouds[:, :width]),
                right=_smoky(pair.right, self.magnitude, clouds[:, apart:]),
            )

        observer.faults.images.append(hazed)


@dataclass(frozen=True, kw_only=True)
class Specular(OfImages):
    """Wet tissue that reflects the lamp, differently into each camera."""

    magnitude: float = number(0.8, at_least=0, at_most=1)
    """Strength of the highlights."""

    def begin(self, observer: Observer) -> None:
        """Gloss on the tissue."""
        observer.gloss(self.magnitude)


@dataclass(frozen=True, kw_only=True)
class ToolOcclusion(OfImages):
    """A thick tool hides what is behind it."""

    magnitude: float = number(4.0, at_least=1, at_most=20)
    """Times the thickness of shaft and jaws."""

    def begin(self, observer: Observer) -> None:
        """Thicken what is drawn; the tool touches nothing."""
        model = observer.simulation.model
        tool = [i for i in range(model.ngeom) if model.geom(i).name.startswith("tweezer/")]
        model.geom_size[tool, 0] *= self.magnitude


@dataclass(frozen=True, kw_only=True)
class DarkPatches(OfImages):
    """Blood on the tissue, which hides its texture."""

    magnitude: float = number(0.15, at_least=0, at_most=0.9)
    """Share of the sheet."""
    seed: int = integer(0, at_least=0, at_most=2**32 - 1)
    """Draws the patches."""

    def begin(self, observer: Observer) -> None:
        """Paint over the texture."""
        model = observer.simulation.model
        texture = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXTURE, "tissue")
        first, width = model.tex_adr[texture], int(model.tex_width[texture])
        picture = model.tex_data[first : first + 3 * width**2].reshape(width, width, 3)
        field = smooth_noise(np.random.default_rng(self.seed), width, (width / 25,))
        patches = field > np.quantile(field, 1 - self.magnitude)
        picture[patches] = _whole(0.15 * picture[patches] + 0.85 * BLOOD_RGB)
        observer.redraw()


def _each(pair: StereoPair, change: "Callable[[Image], Image]") -> StereoPair:
    return StereoPair(left=change(pair.left), right=change(pair.right))


def _whole(levels: Float[np.ndarray, "..."]) -> np.ndarray:
    return np.clip(np.round(levels), 0, 255).astype(np.uint8)


def _smoky(image: "Image", amount: float, clouds: Float[np.ndarray, "height width"]) -> "Image":
    share = np.clip(amount * (1 + 0.5 * clouds), 0, 1)[..., None]
    return _whole((1 - share) * image + share * SMOKE_RGB)
