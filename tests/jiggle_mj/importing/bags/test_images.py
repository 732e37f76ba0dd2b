from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from jiggle_mj.errors import RecordingError
from jiggle_mj.importing.bags.images import depth_image, rgb_image

FLAT = {"r": 200, "g": 120, "b": 40}


def message(encoding: str, pixels: np.ndarray, **changes) -> SimpleNamespace:
    rows = np.ascontiguousarray(pixels)
    values = {
        "height": rows.shape[0],
        "width": rows.shape[1],
        "encoding": encoding,
        "is_bigendian": 0,
        "step": rows[0].nbytes,
        "data": rows.view(np.uint8).ravel(),
    }
    return SimpleNamespace(**(values | changes))


def picture() -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, (6, 8, 3), dtype=np.uint8)


@pytest.mark.parametrize(("encoding", "order"), [("rgb8", [0, 1, 2]), ("bgr8", [2, 1, 0]), ("8UC3", [2, 1, 0])])
def test_colours_come_in_the_right_order(encoding: str, order: list[int]):
    np.testing.assert_array_equal(rgb_image(message(encoding, picture()[..., order])), picture())


@pytest.mark.parametrize(("encoding", "order"), [("rgba8", [0, 1, 2]), ("bgra8", [2, 1, 0])])
def test_a_fourth_channel_is_dropped(encoding: str, order: list[int]):
    four = np.concatenate([picture()[..., order], np.full((6, 8, 1), 9, np.uint8)], axis=2)
    np.testing.assert_array_equal(rgb_image(message(encoding, four)), picture())


@pytest.mark.parametrize("encoding", ("mono8", "8UC1"))
def test_grey_is_three_equal_channels(encoding: str):
    grey = picture()[..., 0]
    np.testing.assert_array_equal(rgb_image(message(encoding, grey)), np.repeat(grey[..., None], 3, axis=2))


@pytest.mark.parametrize("pattern", ("rggb", "bggr", "gbrg", "grbg"))
@pytest.mark.parametrize("depth", (8, 16))
def test_a_bayer_pattern_gives_the_flat_colour_that_it_came_from(pattern: str, depth: int):
    """The pattern's name gives the colours of the first two pixels of the first two rows."""
    mosaic = np.zeros((8, 10), np.uint8)
    for place, colour in enumerate(pattern):
        mosaic[place // 2 :: 2, place % 2 :: 2] = FLAT[colour]
    deep = mosaic if depth == 8 else mosaic.astype("<u2") << 8
    image = rgb_image(message(f"bayer_{pattern}{depth}", deep))
    np.testing.assert_array_equal(image[2:-2, 2:-2], np.broadcast_to([200, 120, 40], (4, 6, 3)))


@pytest.mark.parametrize("order", ("<", ">"))
def test_sixteen_bits_are_read_in_the_order_of_the_header(order: str):
    grey = np.random.default_rng(1).integers(0, 2**16, (4, 5)).astype(np.uint16)
    image = rgb_image(message("mono16", grey.astype(f"{order}u2"), is_bigendian=order == ">"))
    np.testing.assert_array_equal(image[..., 0], grey >> 8)


@pytest.mark.parametrize(("encoding", "channels"), [("16UC3", 3), ("bgr16", 3), ("16UC4", 4)])
def test_sixteen_bits_without_a_name_for_their_colours_are_bgr_as_in_opencv(encoding: str, channels: int):
    deep = np.random.default_rng(1).integers(0, 2**16, (4, 5, channels)).astype("<u2")
    np.testing.assert_array_equal(rgb_image(message(encoding, deep)), deep[..., 2::-1] >> 8)


def test_padding_at_the_end_of_rows_is_dropped():
    """The last row may lack its padding."""
    padded = np.concatenate([picture().reshape(6, 24), np.full((6, 5), 77, np.uint8)], axis=1)
    data = padded.ravel()
    for end in (len(data), len(data) - 5):
        same = message("rgb8", picture(), step=29, data=data[:end])
        np.testing.assert_array_equal(rgb_image(same), picture())


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"encoding": "jpeg2000"}, "encoding 'jpeg2000'; rgb8"),
        ({"height": 7}, "need more"),
        ({"step": 3}, "need more"),
        ({"height": 2**31, "width": 2**31}, "are read"),
        ({"width": 0}, "are read"),
    ],
)
def test_an_image_that_cannot_be_is_named(changes: dict, why: str):
    with pytest.raises(RecordingError, match=why):
        rgb_image(message(**{"encoding": "rgb8", "pixels": picture()} | changes))


def test_twelve_bits_in_sixteen_are_not_read_as_black():
    with pytest.raises(RecordingError, match="at most 4000"):
        rgb_image(message("mono16", np.full((4, 4), 4000, "<u2")))


def test_depth_is_in_metres_and_zero_is_unseen():
    millimetres = np.array([[0, 250], [1000, 2]], "<u2")
    np.testing.assert_array_equal(depth_image(message("16UC1", millimetres)), [[np.nan, 0.25], [1.0, 0.002]])
    metres = np.array([[np.nan, 0.25], [np.inf, 0.5]], "<f4")
    np.testing.assert_array_equal(depth_image(message("32FC1", metres)), [[np.nan, 0.25], [np.nan, 0.5]])
    with pytest.raises(RecordingError, match="depth is read as"):
        depth_image(message("rgb8", picture()))


@pytest.mark.parametrize("pattern", ("rggb", "grbg"))
def test_a_compressed_mosaic_is_demosaiced_and_a_compressed_colour_is_not(pattern: str):
    mosaic = np.zeros((8, 10), np.uint8)
    for place, colour in enumerate(pattern):
        mosaic[place // 2 :: 2, place % 2 :: 2] = FLAT[colour]
    packed = SimpleNamespace(format=f"bayer_{pattern}8; png compressed ", data=cv2.imencode(".png", mosaic)[1].ravel())
    np.testing.assert_array_equal(rgb_image(packed)[3, 4], [200, 120, 40])
    colour = np.full((8, 10, 3), [40, 120, 200], np.uint8)
    packed = SimpleNamespace(
        format=f"bayer_{pattern}8; png compressed bgr8", data=cv2.imencode(".png", colour)[1].ravel()
    )
    np.testing.assert_array_equal(rgb_image(packed)[3, 4], [200, 120, 40])
