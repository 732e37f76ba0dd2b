"""Disturbances of the images: noise, blur, unequal exposure, smoke, highlights, a thick tool, blood."""

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
"""Colour of smoke [grey levels]."""
SMOKE_GRID = 64
"""Side of the small image from which the smoke is enlarged [px]."""
SMOKE_SCALE = 10
"""Side of that image over the blur width of the smoke's clouds."""
SMOKE_CONTRAST = 0.5
"""Relative standard deviation of the smoke's opacity."""
SMOKE_DISPARITY = 1 / 16
"""Disparity of smoke over the image's width: about twice that of tissue in the default camera."""
BLOOD_RGB = np.array([58.0, 10.0, 12.0])
"""Colour of blood [grey levels]."""
BLOOD_SCALE = 25
"""Texture's width over the blur width of the field that draws the patches."""
TISSUE_SHARE, BLOOD_SHARE = 0.15, 0.85
"""Shares of tissue and blood in the colour of a patch."""


@dataclass(frozen=True, kw_only=True)
class ImageDisturbance(SensingDisturbance[Observer]):
    """A disturbance that only rendered images show."""

    needs: ClassVar[tuple[str, ...]] = ("stereo",)


@dataclass(frozen=True, kw_only=True)
class ImageNoise(ImageDisturbance):
    """A noisier camera."""

    magnitude: float = number(10.0, unit="grey levels", at_least=0, at_most=100)
    """Standard deviation of white noise in addition to the scene's [grey levels]."""

    def begin(self, observer: Observer) -> None:
        """Add white noise to both images."""
        observer.faults.image_effects.append(lambda pair, rng: add_image_noise(pair, sd=self.magnitude, rng=rng))


@dataclass(frozen=True, kw_only=True)
class Blur(ImageDisturbance):
    """A camera out of focus."""

    magnitude: float = number(2.0, unit="px", above=0, at_most=50)
    """Standard deviation of the Gaussian blur [px]."""

    def begin(self, observer: Observer) -> None:
        """Blur both images."""
        observer.faults.image_effects.append(
            lambda pair, _: _apply_to_both(pair, lambda image: cv2.GaussianBlur(image, (0, 0), self.magnitude))
        )


@dataclass(frozen=True, kw_only=True)
class Exposure(ImageDisturbance):
    """The right camera has another exposure than the left one."""

    magnitude: float = number(0.7, above=0, at_most=10)
    """Right over left exposure."""

    def begin(self, observer: Observer) -> None:
        """Scale the right image."""
        observer.faults.image_effects.append(
            lambda pair, _: StereoPair(left=pair.left, right=_to_uint8(pair.right * self.magnitude))
        )


@dataclass(frozen=True, kw_only=True)
class Haze(ImageDisturbance):
    """Smoke in front of the camera."""

    magnitude: float = number(0.4, at_least=0, at_most=1)
    """Mean share of the light that the smoke replaces."""

    def begin(self, observer: Observer) -> None:
        """Add new clouds in each frame, nearer than the tissue, so with a larger disparity."""

        def add_haze(pair: StereoPair, rng: np.random.Generator) -> StereoPair:
            height, width = pair.left.shape[:2]
            disparity = round(width * SMOKE_DISPARITY)
            clouds = cv2.resize(smooth_noise(rng, SMOKE_GRID, (SMOKE_GRID / SMOKE_SCALE,)), (width + disparity, height))
            return StereoPair(
                left=_add_smoke(pair.left, self.magnitude, clouds[:, :width]),
                right=_add_smoke(pair.right, self.magnitude, clouds[:, disparity:]),
            )

        observer.faults.image_effects.append(add_haze)


@dataclass(frozen=True, kw_only=True)
class Specular(ImageDisturbance):
    """Wet tissue reflects the lamp, differently into each camera."""

    magnitude: float = number(0.8, at_least=0, at_most=1)
    """Strength of the highlights."""

    def begin(self, observer: Observer) -> None:
        """Switch on the highlights."""
        observer.set_gloss(self.magnitude)


@dataclass(frozen=True, kw_only=True)
class ToolOcclusion(ImageDisturbance):
    """A thick tool hides what is behind it."""

    magnitude: float = number(4.0, at_least=1, at_most=20)
    """Factor on the thickness of shaft and jaws."""

    def begin(self, observer: Observer) -> None:
        """Thicken the drawn tool; it has no contacts."""
        model = observer.simulation.model
        tool = [i for i in range(model.ngeom) if model.geom(i).name.startswith("tweezer/")]
        model.geom_size[tool, 0] *= self.magnitude


@dataclass(frozen=True, kw_only=True)
class DarkPatches(ImageDisturbance):
    """Blood on the tissue hides its texture."""

    magnitude: float = number(0.15, at_least=0, at_most=0.9)
    """Share of the sheet that is covered."""
    seed: int = integer(0, at_least=0, at_most=2**32 - 1)
    """Seed of the patches."""

    def begin(self, observer: Observer) -> None:
        """Paint patches over the texture."""
        model = observer.simulation.model
        texture = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXTURE, "tissue")
        first, width = model.tex_adr[texture], int(model.tex_width[texture])
        picture = model.tex_data[first : first + 3 * width**2].reshape(width, width, 3)
        field = smooth_noise(np.random.default_rng(self.seed), width, (width / BLOOD_SCALE,))
        patches = field > np.quantile(field, 1 - self.magnitude)
        picture[patches] = _to_uint8(TISSUE_SHARE * picture[patches] + BLOOD_SHARE * BLOOD_RGB)
        observer.redraw()


def _apply_to_both(pair: StereoPair, change: Callable[[Image], Image]) -> StereoPair:
    return StereoPair(left=change(pair.left), right=change(pair.right))


def _to_uint8(levels: Float[np.ndarray, "..."]) -> np.ndarray:
    return np.clip(np.round(levels), 0, 255).astype(np.uint8)


def _add_smoke(image: Image, amount: float, clouds: Float[np.ndarray, "height width"]) -> Image:
    share = np.clip(amount * (1 + SMOKE_CONTRAST * clouds), 0, 1)[..., None]
    return _to_uint8((1 - share) * image + share * SMOKE_RGB)
