"""Words in the names of columns and arrays that say which points are seen, and which way round."""

import pytest

from jiggle_mj.importing.points.rating_names import marks_hidden, rates_points

SEEN = (
    "vis visibs pred_visibility isVisible VISIBILITY ptsvisible unoccluded not_occluded nonOccluded mask status conf "
    "trackStatus matchConfidence prob_seen valid2d inlier no_outlier never_lost likelihood Quality visible_mask"
).split()
HIDDEN = (
    "occluded occlusion_prob outlier_score isOutlier lost LOST_FLAG invalid notVisible not_valid invisible unseen bad "
    "pred_occlusion missing_flag masked failed dropped rejected not_seen"
).split()
NEITHER = "problem division failure_load mask_area ncc sigma device config viscosity baddeley conform x lastly".split()


@pytest.mark.parametrize("name", SEEN)
def test_names_of_ratings_that_are_large_where_a_point_is_seen(name):
    assert rates_points(name) and not marks_hidden(name)


@pytest.mark.parametrize("name", HIDDEN)
def test_names_of_ratings_that_are_large_where_a_point_is_lost(name):
    assert rates_points(name) and marks_hidden(name)


@pytest.mark.parametrize("name", NEITHER)
def test_names_that_rate_no_point(name):
    assert not rates_points(name) and not marks_hidden(name)
