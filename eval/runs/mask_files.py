"""Masks of tissue from files: one for the first frame, or one for each frame and camera."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool

from jiggle_mj.errors import MaskError, OptionError, PerceptionError, RecordingError
from jiggle_mj.estimator.perception import FrameMask, GrabCut, TissueMask
from jiggle_mj.recording.images import MAX_PIXELS
from jiggle_mj.recording.npz_arrays import MALFORMED, read_npz

SHOWN = "doubtful_mask.png"
"""File that shows what a segmentation in doubt took for tissue; not the name of a mask that a user draws."""
GRABCUT = "grabcut"
"""Name that stands for `GrabCut` in place of a file."""
WHITE = 127
"""Grey level above which a pixel of an image is tissue [of 255]."""
MAX_BYTES = 2**30
"""Largest size of the masks of a .npz [bytes]: an hour of 640 x 480 at one a second."""


@dataclass(frozen=True, kw_only=True)
class RestMask:
    """Mask of the sheet in the left image at rest; in all other images, every pixel may be tissue."""

    tissue: Bool[np.ndarray, "height width"]
    """Tissue pixels of the raw left image."""

    def at(self, index: int, side: Literal["left", "right"], *, rest: bool) -> Bool[np.ndarray, "height width"]:
        """Return the mask for the left image at rest, and all pixels for others."""
        return self.tissue if rest and side == "left" else np.ones_like(self.tissue)


@dataclass(frozen=True, kw_only=True)
class FolderMask:
    """Masks of a folder: left_000123.png and right_000123.png for frame 123; six digits, from 0."""

    folder: Path
    """The folder."""

    def at(self, index: int, side: Literal["left", "right"], *, rest: bool) -> Bool[np.ndarray, "height width"]:
        """Return the mask of an image.

        Raises:
            PerceptionError: there is no such file, or it is no image.
        """
        path = self.folder / f"{side}_{index:06}.png"
        if not path.is_file():
            raise PerceptionError(f"{path} is missing; the folder must hold a mask of every frame and camera.")
        return read_mask(path)


@dataclass(frozen=True, kw_only=True)
class ArrayMask:
    """Masks in arrays `left` and `right`, one a frame."""

    left: Bool[np.ndarray, "frames height width"]
    """Tissue pixels of the raw left images."""
    right: Bool[np.ndarray, "frames height width"]
    """Tissue pixels of the raw right images."""

    def at(self, index: int, side: Literal["left", "right"], *, rest: bool) -> Bool[np.ndarray, "height width"]:
        """Return the mask of an image.

        Raises:
            PerceptionError: the array has fewer frames.
        """
        masks = self.left if side == "left" else self.right
        if index >= len(masks):
            raise PerceptionError(f"the array '{side}' of the masks has {len(masks)} frames, and frame {index} came.")
        return masks[index]


def mask_named(name: str) -> TissueMask | FrameMask:
    """Return the mask that the command line names: `grabcut`, a folder, an image, a .npy or a .npz.

    Raises:
        OptionError: it is none of these, or cannot be read.
    """
    path = Path(name)
    if name == GRABCUT:
        return GrabCut()
    if path.is_dir():
        if not any(path.glob("left_*.png")):
            raise OptionError(f"--mask {name}: the folder must hold left_000000.png, right_000000.png and so on.")
        return FolderMask(folder=path)
    if not path.is_file():
        raise OptionError(f"--mask {name}: no such file; give an image, a .npy, a .npz, a folder, or {GRABCUT}.")
    try:
        return _arrays(path) if path.suffix in (".npy", ".npz") else RestMask(tissue=read_mask(path))
    except (PerceptionError, RecordingError, *MALFORMED) as failure:
        raise OptionError(f"--mask {name} cannot be read: {failure}") from failure


@contextmanager
def mask_shown(folder: Path) -> Iterator[None]:
    """Write what a segmentation in doubt took for tissue to FOLDER/doubtful_mask.png, and name it in the error.

    Raises:
        PerceptionError: the segmentation is in doubt.
    """
    try:
        yield
    except MaskError as doubt:
        path = folder / SHOWN
        try:
            folder.mkdir(parents=True, exist_ok=True)
            path.write_bytes(cv2.imencode(".png", np.where(doubt.mask, 255, 0).astype(np.uint8))[1].tobytes())
        except OSError:
            raise doubt from None
        raise PerceptionError(f"{doubt} What was taken for tissue is white in {path}.") from doubt


def read_mask(path: Path) -> Bool[np.ndarray, "height width"]:
    """Return the pixels of an image that are brighter than half.

    Raises:
        PerceptionError: it is no image, cannot be read, or has more than `MAX_PIXELS`.
    """
    try:
        content = np.frombuffer(path.read_bytes(), np.uint8)
        image = cv2.imdecode(content, cv2.IMREAD_GRAYSCALE) if len(content) else None
    except OSError as failure:
        raise PerceptionError(f"{path} cannot be read: {failure.strerror}.") from failure
    except cv2.error:  # more pixels than OpenCV reads
        image = None
    if image is not None and image.size > MAX_PIXELS:
        raise PerceptionError(f"{path} has {image.size} pixels; at most {MAX_PIXELS} are read.")
    if image is None:
        raise PerceptionError(f"{path} is no image that OpenCV reads; give a PNG, white where tissue is.")
    return image > WHITE


def _arrays(path: Path) -> FrameMask:
    """Return the masks of a .npy (height, width) or of a .npz with `left` and `right` (frames, height, width)."""
    if path.suffix == ".npy":
        array = np.load(path, allow_pickle=False, mmap_mode="r")
        if not isinstance(array, np.ndarray) or array.ndim != 2 or array.size > MAX_PIXELS:
            shape = getattr(array, "shape", "none")
            raise ValueError(f"the array has the shape {shape}; it must be (height, width) of at most {MAX_PIXELS}.")
        return RestMask(tissue=np.asarray(array > 0))
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"it has more than {MAX_BYTES} bytes: give a folder of images.")
    arrays = read_npz(path.read_bytes(), limit=MAX_BYTES)
    if missing := {"left", "right"} - set(arrays):
        raise ValueError(f"it lacks the array '{min(missing)}'; left and right (frames, height, width) are needed.")
    left, right = (arrays[name] > 0 for name in ("left", "right"))
    if left.ndim != 3 or right.ndim != 3:
        raise ValueError(f"left and right have the shapes {left.shape} and {right.shape}; (frames, height, width) are.")
    return ArrayMask(left=left, right=right)
