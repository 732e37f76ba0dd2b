"""Fits that are kept and begun from again, of lifts by our own engine, against the loop's own."""

import dataclasses

import jax
import numpy as np
import pytest

from jiggle_mj.errors import OutputError
from jiggle_mj.estimator.attribution.evidence import log_model_evidence
from jiggle_mj.estimator.attribution.joint_evidence import joint_evidence
from jiggle_mj.estimator.attribution.joint_fits import fit_sets, with_fixed
from jiggle_mj.estimator.attribution.kept_fits import KeptLoop
from jiggle_mj.estimator.attribution.scores import parameters_sd
from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.eval.runs.kept_files import FITS, read_fits, write_fits
from tests.support.lifted_recording import SMALL_LIBRARY

GRAVITY = (("gravity", 0),)
CONVERGED = 2.0
"""Difference of log evidences of two fits of one hypothesis [nat]: a fit ends where a step gains less."""


@pytest.fixture(scope="module")
def kept(light, tmp_path_factory) -> KeptLoop:
    """The closed loop as it is read again from its file."""
    closed, _, _ = light
    path = tmp_path_factory.mktemp("kept") / FITS
    with jax.enable_x64(True), one_thread():
        write_fits(path, KeptLoop.of(closed))
    return read_fits(path)


def test_a_file_holds_every_hypothesis_as_it_was(light, kept):
    closed, _, dataset = light
    with jax.enable_x64(True), one_thread():
        direct = KeptLoop.of(closed)
    assert [one.effects for one in kept.fits] == [one.effects for one in direct.fits]
    assert kept.prior.sites == direct.prior.sites and kept.scores == direct.scores
    assert kept.prior.of_tissue.keys() == direct.prior.of_tissue.keys()
    assert ("gravity", 0) in kept.scores and ("tool_scale", 0) not in kept.scores
    for one, other in zip(kept.fits, direct.fits, strict=True):
        assert dataclasses.replace(one.recorded, information=other.recorded.information) == other.recorded
        for field in dataclasses.fields(one.recorded.information):
            mine, theirs = (getattr(each.recorded.information, field.name) for each in (one, other))
            np.testing.assert_array_equal(mine, theirs)
        for end in ("assumed", "likeliest"):
            np.testing.assert_array_equal(getattr(one, end).states, getattr(other, end).states)
            assert getattr(one, end).scales == getattr(other, end).scales
    np.testing.assert_array_equal(kept.rest, dataset.estimator.sheet.rest)
    assert kept.n_parts == len(dataset.parts[0])


def test_a_hypothesis_without_finite_evidence_is_not_kept(light):
    closed, _, _ = light
    lost = [(dataclasses.replace(one, log_evidence=-np.inf), share) for one, share in closed.hypotheses]
    with jax.enable_x64(True), one_thread():
        assert [one.effects for one in KeptLoop.of(dataclasses.replace(closed, hypotheses=lost)).fits] == [()]


def test_a_restored_fit_has_the_evidence_that_it_had(light, kept):
    closed, _, dataset = light
    with jax.enable_x64(True), one_thread():
        for one, (hypothesis, _) in zip(kept.fits, closed.hypotheses, strict=True):
            restored = one.restored(closed.problem, closed.problem.frames(dataset.parts[0])).likeliest
            # the errors of the fit were rescaled, those of the restored one are built anew: they round otherwise
            assert restored.log_likelihood == pytest.approx(hypothesis.fitted.log_likelihood, rel=1e-10)
            assert log_model_evidence(restored) == pytest.approx(hypothesis.log_evidence, rel=1e-9)


def test_what_a_fit_says_of_its_parameters_is_its_posterior(light, kept):
    closed, _, _ = light
    one = next(one for one in kept.fits if one.recorded.shared == GRAVITY)
    hypothesis = next(one for one, _ in closed.hypotheses if one.names == ("gravity",))
    alone = joint_evidence([one.recorded.information], kept.prior.together(GRAVITY))
    with jax.enable_x64(True), one_thread():
        np.testing.assert_allclose(alone.sd, parameters_sd(hypothesis.fitted), rtol=1e-6)
    np.testing.assert_allclose(alone.theta, hypothesis.theta(hypothesis.added[0]), rtol=1e-9)
    assert alone.log_evidence == pytest.approx(hypothesis.log_evidence, rel=1e-12)


def test_a_set_that_another_recording_found_is_fitted_from_what_is_declared(light, kept):
    """The search found gravity by itself; begun from another size, without a search, it has as much evidence."""
    _, _, dataset = light
    declared = dataclasses.replace(kept, fits=[one for one in kept.fits if not one.effects])
    lines = []
    with jax.enable_x64(True), one_thread():
        (found,) = fit_sets(
            dataset, SMALL_LIBRARY, declared, [GRAVITY], {("gravity", 0): np.array([0.0, 0.0, 0.6])}, lines.append
        )
    own = next(one for one in kept.fits if one.effects == GRAVITY).recorded.information
    assert found.recorded.shared == GRAVITY and not found.recorded.own
    assert found.recorded.information.log_evidence > own.log_evidence - CONVERGED
    np.testing.assert_allclose(found.recorded.information.theta[2], own.theta[2], atol=0.05)
    assert lines[0].startswith("gravity: ln Z ")


def test_with_its_own_size_a_recording_is_predicted_as_before_and_with_another_worse(light, kept):
    _, found, dataset = light
    one = next(one for one in kept.fits if one.recorded.shared == GRAVITY)
    theta = one.recorded.information.theta
    with jax.enable_x64(True), one_thread():
        same = with_fixed(dataset, SMALL_LIBRARY, one, theta, lambda _: None)
        other = with_fixed(dataset, SMALL_LIBRARY, one, np.zeros(3), lambda _: None)
    assert same.shared == GRAVITY and not same.own and not same.theta.size
    assert same.rms is not None and other.rms is not None
    assert same.rms < 0.7 * found["held_out"]["before_rms_m"]
    assert other.rms > 1.4 * same.rms  # what is declared, with the attachments that fit it from here


def test_a_damaged_file_is_refused_with_what_to_do(tmp_path):
    (tmp_path / FITS).write_bytes(b"torn")
    with pytest.raises(OutputError, match=r"fits\.npz cannot be read .*delete its folder, and it is made anew"):
        read_fits(tmp_path / FITS)
