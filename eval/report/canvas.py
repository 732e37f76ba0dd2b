"""A canvas for pictures in the docs: text, lines and discs by OpenCV, drawn at twice the size and averaged."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jiggle_mj.errors import OutputError

OVERSAMPLING = 2
"""Pixels drawn along each pixel of the picture."""
SHIFT = 4
"""Binary digits of a fraction of a pixel, in which OpenCV takes coordinates."""
QUALITY = 80
"""Quality of the WebP: letters stay sharp at a third of a PNG's size."""
WEIGHT = 400
"""Weight of the letters."""


class Canvas:
    """A white picture to draw on; coordinates and sizes are in its pixels, from the upper left corner."""

    def __init__(self, width: int, height: int) -> None:
        self._image = np.full((OVERSAMPLING * height, OVERSAMPLING * width, 3), 255, np.uint8)
        self._font = cv2.FontFace("sans")

    def text(self, at: tuple[float, float], words: str, *, size: int = 13, anchor: float = 0, colour: str = "#1d2733"):
        """Write words with their base line at a place; `anchor` is the share of their width to the left of it."""
        size = OVERSAMPLING * size
        _, _, width, _ = cv2.getTextSize((1, 1), words, (0, 0), self._font, size, WEIGHT)
        corner = round(OVERSAMPLING * at[0] - anchor * width), round(OVERSAMPLING * at[1])
        cv2.putText(self._image, words, corner, _bgr(colour), self._font, size, WEIGHT)

    def line(self, points: Iterable[Sequence[float]], *, colour: str, width: float = 1.0, dash: float = 0.0) -> None:
        """Draw a line through points; with dashes and gaps of a length, if any."""
        through = np.array([*points], dtype=float).reshape(-1, 2)
        for piece in [through] if dash == 0 else _dashes(through, dash):
            fixed = np.round(piece * OVERSAMPLING * 2**SHIFT).astype(np.int32)
            thickness = max(1, round(OVERSAMPLING * width))
            cv2.polylines(self._image, [fixed], False, _bgr(colour), thickness, cv2.LINE_AA, SHIFT)

    def disc(self, at: Sequence[float], radius: float, *, colour: str | UInt8[np.ndarray, " 3"]) -> None:
        """Draw a disc; the colour is a name like #d55e00, or blue, green and red."""
        x, y = (round(OVERSAMPLING * 2**SHIFT * part) for part in at)
        bgr = _bgr(colour) if isinstance(colour, str) else tuple(int(part) for part in colour)
        cv2.circle(self._image, (x, y), round(OVERSAMPLING * 2**SHIFT * radius), bgr, -1, cv2.LINE_AA, SHIFT)

    def rectangle(self, low: tuple[float, float], high: tuple[float, float], *, colour: str) -> None:
        """Fill a rectangle."""
        (a, b), (c, d) = ((round(OVERSAMPLING * x), round(OVERSAMPLING * y)) for x, y in (low, high))
        self._image[b:d, a:c] = _bgr(colour)

    def paste(self, at: tuple[int, int], picture: UInt8[np.ndarray, "h w 3"]) -> None:
        """Put a picture of blue, green and red with its upper left corner at a place."""
        large = np.kron(picture, np.ones((OVERSAMPLING, OVERSAMPLING, 1), np.uint8))
        x, y = (OVERSAMPLING * part for part in at)
        self._image[y : y + large.shape[0], x : x + large.shape[1]] = large

    def write(self, path: Path) -> None:
        """Write the picture as WebP.

        Raises:
            OutputError: the file cannot be written.
        """
        height, width = (size // OVERSAMPLING for size in self._image.shape[:2])
        small = cv2.resize(self._image, (width, height), interpolation=cv2.INTER_AREA)
        _, data = cv2.imencode(".webp", small, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
        try:
            path.write_bytes(data.tobytes())
        except OSError as error:
            raise OutputError(f"{path} cannot be written: {error.strerror}.") from error


def _bgr(colour: str) -> tuple[int, int, int]:
    """Return blue, green and red of a colour like #d55e00."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return blue, green, red


def _dashes(points: Float[np.ndarray, "k 2"], length: float) -> list[Float[np.ndarray, "2 2"]]:
    """Return dashes of a length along a line, with gaps of the same length."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    begins = np.arange(0, along[-1], 2 * length)
    ends = np.minimum(begins + length, along[-1])
    place = [np.stack([np.interp(at, along, points[:, k]) for k in range(2)], axis=1) for at in (begins, ends)]
    return [np.stack(pair) for pair in zip(*place, strict=True)]
