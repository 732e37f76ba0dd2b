"""Masks of tissue from files: one for the first frame, or one for each frame and camera."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool

from jiggle_mj.errors import MaskError, OptionError, PerceptionError
from jiggle_mj.estimator.perception import FrameMask, GrabCut, TissueMask

SHOWN = "mask.png"
"""File that shows what a segmentation in doubt took for tissue."""
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
    except (PerceptionError, OSError, ValueError, KeyError, MemoryError, EOFError) as failure:
        raise OptionError(f"--mask {name} cannot be read: {failure}") from failure


@contextmanager
def mask_shown(folder: Path) -> Iterator[None]:
    """Write what a segmentation in doubt took for tissue to FOLDER/mask.png, and name it in the error.

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
        PerceptionError: it is no image.
    """
    content = np.frombuffer(path.read_bytes(), np.uint8)
    image = cv2.imdecode(content, cv2.IMREAD_GRAYSCALE) if len(content) else None
    if image is None:
        raise PerceptionError(f"{path} is no image that OpenCV reads; give a PNG, white where tissue is.")
    return image > WHITE


def _arrays(path: Path) -> FrameMask:
    """Return the masks of a .npy (height, width) or of a .npz with `left` and `right` (frames, height, width)."""
    loaded = np.load(path, allow_pickle=False, mmap_mode="r")
    if isinstance(loaded, np.ndarray):
        if loaded.ndim != 2:
            raise ValueError(f"the array has the shape {loaded.shape}; it must be (height, width).")
        return RestMask(tissue=np.asarray(loaded) > 0)
    with loaded:
        sizes = [entry.file_size for entry in loaded.zip.infolist()] if loaded.zip is not None else []
        if sum(sizes) > MAX_BYTES:
            raise ValueError(f"it holds {sum(sizes)} bytes; at most {MAX_BYTES} are read: give a folder of images.")
        if missing := {"left", "right"} - set(loaded.files):
            raise ValueError(f"it lacks the array '{min(missing)}'; left and right (frames, height, width) are needed.")
        left, right = (np.asarray(loaded[name]) > 0 for name in ("left", "right"))
    if left.ndim != 3 or right.ndim != 3:
        raise ValueError(f"left and right have the shapes {left.shape} and {right.shape}; (frames, height, width) are.")
    return ArrayMask(left=left, right=right)
