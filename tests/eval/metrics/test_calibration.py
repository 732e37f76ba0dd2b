"""NEES, coverage and the expected calibration error against examples worked by hand and against sampling."""

import numpy as np
import pytest

from jiggle_mj.estimate import Belief
from jiggle_mj.eval.metrics.calibration import (
    calibration,
    coverage,
    expected_calibration_error,
    nees_per_dof,
    reliability,
)

CORRELATED = np.array([[2.0, 1.0], [1.0, 2.0]])


def test_nees_of_a_correlated_pair_by_hand():
    """Error (1, 0), Sigma^-1 = [[2, -1], [-1, 2]]/3: e^T Sigma^-1 e = 2/3, over two degrees of freedom 1/3."""
    belief = Belief(mean=np.array([1.0, 5.0]), covariance=CORRELATED)
    assert nees_per_dof(belief, np.array([0.0, 5.0])) == pytest.approx(1 / 3)


def test_nees_marginalises_what_has_no_true_number():
    """With the second particle welded only the first counts: 1^2 / 2."""
    belief = Belief(mean=np.array([1.0, 5.0]), covariance=CORRELATED)
    assert nees_per_dof(belief, np.array([0.0, np.inf])) == pytest.approx(1 / 2)
    assert nees_per_dof(belief, np.array([np.nan, np.inf])) is None
    assert coverage(belief, np.array([np.nan, np.inf])) is None


def test_a_calibrated_belief_has_unit_nees_and_covers_nine_in_ten():
    """Truths drawn from the belief itself: n NEES/dof ~ chi-square_n, and coverage is binomial(n, 0.9).

    n = 400 over 25 draws: the standard error of the mean NEES/dof is sqrt(2/10000) = 0.0142 and that of the coverage
    below 0.02 even for correlated particles; four of each are allowed.
    """
    nees_error, coverage_error = 4 * 0.0142, 4 * 0.02
    rng = np.random.default_rng(0)
    n, draws = 400, 25
    root = np.eye(n) * 0.3 + 0.02 * rng.standard_normal((n, n))
    belief = Belief(mean=rng.standard_normal(n), covariance=root @ root.T)
    truths = belief.mean + rng.standard_normal((draws, n)) @ root.T
    assert np.mean([nees_per_dof(belief, truth) for truth in truths]) == pytest.approx(1, abs=nees_error)
    assert np.mean([coverage(belief, truth) for truth in truths]) == pytest.approx(0.9, abs=coverage_error)


def test_coverage_by_hand():
    """sd 1, so the half width is 1.6449: errors 1.6 and 1.7 are inside and outside."""
    belief = Belief(mean=np.array([1.6, 1.7]), covariance=np.eye(2))
    assert coverage(belief, np.zeros(2)) == 0.5
    assert coverage(belief, np.zeros(2), among=np.array([True, False])) == 1
    assert coverage(belief, np.zeros(2), among=np.zeros(2, bool)) is None


def test_expected_calibration_error_by_hand():
    """Bin [0.8, 0.9): two at 0.85, one attached, |0.5 - 0.85| over 2 of 4; bin [0, 0.1): two at 0, |0| over 2 of 4."""
    probability, attached = np.array([0.85, 0.85, 0.0, 0.0]), np.array([True, False, False, False])
    assert expected_calibration_error(probability, attached) == pytest.approx(0.175)
    assert expected_calibration_error(np.array([1.0, 0.0]), np.array([True, False])) == 0


def test_reliability_lists_the_bins_that_hold_a_particle():
    """Those of 0.85 and 0.81 share one, of which half are attached; a certainty falls into the last."""
    bins = reliability(np.array([0.85, 0.81, 0.02, 1.0]), np.array([True, False, False, True]))
    assert [(each.low, each.high, each.count, each.attached) for each in bins] == [
        (0, 0.1, 1, 0),
        (0.8, 0.9, 2, 0.5),
        (0.9, 1, 1, 1),
    ]
    assert [each.predicted for each in bins] == pytest.approx([0.02, 0.83, 1.0])


def test_no_probabilities_no_calibration_error():
    belief = Belief(mean=np.zeros(2), covariance=np.eye(2))
    assert calibration(belief, np.zeros(2), np.zeros(2, bool)).ece is None
    assert calibration(belief, np.zeros(2), np.zeros(2, bool), probability=np.full(2, 0.1)).ece == pytest.approx(0.1)


def test_an_indefinite_covariance_is_refused():
    belief = Belief(mean=np.zeros(2), covariance=np.array([[1.0, 2.0], [2.0, 1.0]]))
    with pytest.raises(ValueError, match="not positive definite"):
        nees_per_dof(belief, np.zeros(2))
