"""The settings of perception: refused ranges, and that each tracker uses its own part."""

import numpy as np
import pytest

from jiggle_mj.errors import PerceptionError
from jiggle_mj.estimator.perception import Perception, PerceptionConfig
from jiggle_mj.estimator.perception.config import (
    CloudTrackerConfig,
    PointTrackerConfig,
    RegistrationConfig,
    SheetMeshConfig,
    StereoTrackerConfig,
)
from jiggle_mj.observation import Declaration, MeasuredPoints, Observation
from tests.support.perception_plane import PlaneSheet, camera, stereo, tool
from tests.support.small_sheet import SPACING, sheet


def observed(**seen) -> Observation:
    """One frame at rest."""
    return Observation(index=0, time=0, tool=tool(), **seen)


def perception(config: PerceptionConfig, *, with_camera: bool = False) -> Perception:
    return Perception(
        Declaration(),
        camera() if with_camera else None,
        spacing=SPACING,
        mask=None,
        disparity=None,
        config=config,
    )


@pytest.mark.parametrize(
    ("config", "field", "value", "message"),
    [
        (RegistrationConfig, "fine_window", 0.0, "fine_window must be above 0 and finite; got 0.0"),
        (RegistrationConfig, "min_correlation", 1.5, "min_correlation must lie between 0 and 1; got 1.5"),
        (RegistrationConfig, "contrast_width", 26, "contrast_width must be odd; got 26"),
        (SheetMeshConfig, "min_particles", 0, "min_particles must be above 0 and finite; got 0"),
        (SheetMeshConfig, "min_matched", -0.1, "min_matched must lie between 0 and 1; got -0.1"),
        (StereoTrackerConfig, "lateral_sd", float("nan"), "lateral_sd must be above 0 and finite; got nan"),
        (StereoTrackerConfig, "min_found", 2, "min_found must lie between 0 and 1; got 2"),
        (PointTrackerConfig, "outlier_ratio", -1.0, "outlier_ratio must be above 0 and finite; got -1.0"),
        (CloudTrackerConfig, "sweeps", 0, "sweeps must be above 0 and finite; got 0"),
    ],
)
def test_settings_out_of_range_are_refused_by_name(config, field, value, message):
    with pytest.raises(ValueError, match=f"{config.__name__}.{message}"):
        config(**{field: value})


def test_points_use_their_part():
    """A sheet of 81 points is too small where 100 are asked for."""
    points = MeasuredPoints(positions=sheet().rest, track_id=np.arange(sheet().n), sd=2e-4)
    seen = perception(PerceptionConfig(points=PointTrackerConfig(min_points=100)))
    seen.look_at_rest(observed(points=points))
    with pytest.raises(PerceptionError, match=r"81 points are seen .* a sheet needs 100"):
        seen.sheet()


def test_clouds_use_their_part():
    """The same sheet without identities."""
    seen = perception(PerceptionConfig(clouds=CloudTrackerConfig(min_points=100)))
    seen.look_at_rest(observed(points=MeasuredPoints(positions=sheet().rest, sd=2e-4)))
    with pytest.raises(PerceptionError, match="have 81 points at most; a sheet needs 100"):
        seen.sheet()


@pytest.mark.parametrize(
    ("stereo_config", "message"),
    [
        (StereoTrackerConfig(min_brightness=255.0), "left image is black"),
        (StereoTrackerConfig(mesh=SheetMeshConfig(min_sheet=10**6)), "at least 1000000 are needed"),
        (StereoTrackerConfig(mesh=SheetMeshConfig(min_particles=10**4)), "at least 10000 are needed"),
        (StereoTrackerConfig(registration=RegistrationConfig(min_correlation=1.0)), "agree on 0% of the particles"),
    ],
)
def test_images_use_their_part_and_its_parts(stereo_config, message):
    """A pair that the defaults accept is skipped under settings that no pair can meet."""
    images = observed(images=stereo(PlaneSheet()))
    assert perception(PerceptionConfig(), with_camera=True).look_at_rest(images) is None
    reason = perception(PerceptionConfig(stereo=stereo_config), with_camera=True).look_at_rest(images)
    assert reason is not None and message in reason
