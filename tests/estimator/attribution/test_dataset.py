"""Datasets of frames with closed jaws: their noise and their times."""

import dataclasses

import numpy as np
import pytest

from jiggle_mj.estimator import Estimator
from jiggle_mj.estimator.attribution.dataset import assumed, collect_dataset, stated
from jiggle_mj.observation import DeclaredMesh
from tests.support.lifted_recording import N_STILL, NOISE, observed
from tests.support.small_sheet import DECLARATION, sheet


def test_without_still_frames_the_noise_is_assumed():
    observations = [one for one in observed(1.0) if one.tool.closed][:6]
    rest = dataclasses.replace(observations[0], tool=dataclasses.replace(observations[0].tool, closed=False, grasp=0))
    rest = dataclasses.replace(rest, points=observed(1.0)[0].points)
    dataset = collect_dataset(DECLARATION, None, [rest, *observations])
    assert dataset.noise == assumed(NOISE)


def test_points_that_state_noise_which_neighbours_share_have_it_and_others_a_part_of_it():
    points = observed(1.0)[0].points
    found = stated(dataclasses.replace(points, sd=5e-4, smooth_sd=4e-4, smooth_length=0.01))
    assert (found.smooth_sd, found.length, found.frames) == (4e-4, 0.01, 0)
    assert found.total_sd == pytest.approx(5e-4)
    assert stated(points) == assumed(points.sd)


def test_time_starts_at_the_rest_shape():
    """It is the mean of the frames before the first grasp; the first frame if the mesh is declared, or none is open."""
    observations = observed(1.0)
    still, (first, second) = observations[:N_STILL], observations[N_STILL : N_STILL + 2]
    estimator = Estimator(DECLARATION, None)
    assert all(estimator.update(one) is None for one in still)
    assert estimator.rest_time == np.mean([one.time for one in still])
    began = dataclasses.replace(first, index=N_STILL - 1, time=first.time - 10**9, points=still[0].points)
    mesh = DeclaredMesh(vertices=sheet().rest, faces=sheet().faces, track_id=still[0].points.track_id)
    frames = collect_dataset(dataclasses.replace(DECLARATION, mesh=mesh), None, [began, first, second]).frames
    np.testing.assert_allclose([one.time for one in frames][-2:], [1.0, 1.25])
