from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from jiggle_mj.camera import CameraCalibration
from jiggle_mj.errors import RecordingError
from jiggle_mj.importing.bags.clouds import cloud_points, depth_points
from jiggle_mj.importing.bags.settings import DepthSettings
from tests.support.robot_bags import POINT_TYPES, points_table


def cloud(table: np.ndarray, **changes) -> SimpleNamespace:
    fields = [
        SimpleNamespace(name=name, offset=offset, datatype=POINT_TYPES[dtype.str[1:]], count=1)
        for name, (dtype, offset, *_) in table.dtype.fields.items()
    ]
    values = {
        "height": 1,
        "width": len(table),
        "fields": fields,
        "is_bigendian": False,
        "point_step": table.dtype.itemsize,
        "row_step": table.nbytes,
        "data": np.frombuffer(table.tobytes(), np.uint8),
    }
    return SimpleNamespace(**(values | changes))


def test_fields_in_any_order_with_padding_and_mixed_types():
    positions, track = cloud_points(cloud(points_table(3)), None)
    np.testing.assert_array_equal(positions, [[0, 0.5, 0.25], [1, 0.5, 0.25], [2, 0.5, 0.25]])
    np.testing.assert_array_equal(track, [12, 11, 10])


def test_big_endian_and_padded_rows():
    table = np.zeros((2, 3), [("x", ">f4"), ("y", ">f4"), ("z", ">f8"), ("id", ">i2")])
    table["x"], table["id"] = np.arange(6).reshape(2, 3), np.arange(6).reshape(2, 3)
    rows = np.concatenate([table.view(np.uint8).reshape(2, -1), np.full((2, 7), 9, np.uint8)], axis=1)
    message = cloud(table[0], height=2, width=3, is_bigendian=True, row_step=rows.shape[1], data=rows.ravel())
    positions, track = cloud_points(message, None)
    np.testing.assert_array_equal(positions[:, 0], np.arange(6))
    np.testing.assert_array_equal(track, np.arange(6))


def test_unseen_points_are_kept_with_their_number_and_dropped_without():
    table = points_table(3)
    table["y"][1] = np.inf
    positions, track = cloud_points(cloud(table), None)
    assert np.isnan(positions[1]).all() and len(track) == 3
    bare = np.zeros(3, [("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    bare["x"][1] = np.nan
    positions, track = cloud_points(cloud(bare), None)
    assert len(positions) == 2 and track is None


@pytest.mark.parametrize(
    ("changes", "id_field", "why"),
    [
        ({}, "label", "lacks the fields label; it has"),
        ({"data": np.zeros(7, np.uint8)}, None, "need more"),
        ({"point_step": 8}, None, "outside its points"),
        ({"width": 0}, None, "empty cloud"),
        ({"fields": []}, None, "lacks the fields x, y, z"),
        ({"fields": 2 * [SimpleNamespace(name="x", offset=0, datatype=7, count=1)]}, None, "with one name: x, x"),
    ],
)
def test_a_cloud_that_cannot_be_is_named(changes: dict, id_field: str | None, why: str):
    with pytest.raises(RecordingError, match=why):
        cloud_points(cloud(points_table(), **changes), id_field)


def test_numbers_must_be_whole_and_different():
    table = points_table(3)
    table["id"] = 4
    with pytest.raises(RecordingError, match="same number in 'id' more than once"):
        cloud_points(cloud(table), None)
    with pytest.raises(RecordingError, match="not whole numbers"):
        cloud_points(cloud(np.array([(0.0, 0.0, 0.0, 0.5)], [(n, "<f4") for n in ("x", "y", "z", "id")])), None)


def depth_message(metres: np.ndarray, encoding: str = "32FC1") -> SimpleNamespace:
    pixels = metres.astype("<f4") if encoding == "32FC1" else np.round(1e3 * metres).astype("<u2")
    return SimpleNamespace(
        height=len(metres),
        width=metres.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=pixels[0].nbytes,
        data=pixels.view(np.uint8).ravel(),
    )


def calibration() -> CameraCalibration:
    K = np.array([[100.0, 0, 15.5], [0, 100, 11.5], [0, 0, 1]])
    return CameraCalibration(width=32, height=24, K=K, P=np.hstack([K, np.zeros((3, 1))]))


@pytest.mark.parametrize("encoding", ("32FC1", "16UC1"))
def test_a_depth_image_of_a_plane_is_that_plane(encoding: str):
    """Every pixel at z = 0.25 m; x = (u - cx) z / fx: from -38.75 to 38.75 mm."""
    points = depth_points(depth_message(np.full((24, 32), 0.25), encoding), calibration(), DepthSettings(spacing=1e-4))
    assert len(points) == 24 * 32
    np.testing.assert_allclose(points[:, 2], 0.25, rtol=1e-7)  # float32
    np.testing.assert_allclose([points[:, 0].min(), points[:, 0].max()], [-0.03875, 0.03875], rtol=1e-6)


def test_range_mask_and_spacing_cut_the_cloud(tmp_path):
    depth = np.full((24, 32), 0.25)
    depth[:, 16:] = 0.9
    depth[0, 0] = np.nan
    near = depth_points(depth_message(depth), calibration(), DepthSettings(far=0.5, spacing=1e-4))
    assert len(near) == 24 * 16 - 1
    mask = np.zeros((24, 32), np.uint8)
    mask[4:8, 4:10] = 255
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    settings = DepthSettings(mask=tmp_path / "mask.png", spacing=1e-4)
    assert len(depth_points(depth_message(depth), calibration(), settings)) == 24
    coarse = depth_points(depth_message(depth), calibration(), DepthSettings(far=0.5, spacing=0.01))
    assert 10 < len(coarse) < 40
    for changed, why in (
        (DepthSettings(far=0.1), "no pixel with a depth"),
        (DepthSettings(mask=tmp_path / "no.png"), "mask of 32x24"),
    ):
        with pytest.raises(RecordingError, match=why):
            depth_points(depth_message(depth), calibration(), changed)
