"""The remainder without a name, against draws of its own process."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.attribution.grasped_frames import ClosedFrame, Timed
from jiggle_mj.estimator.attribution.remainder import (
    TERMS,
    FittedRemainder,
    Observed,
    minus_log_posterior,
    predicted_remainder,
    remainder,
)
from tests.support.compiled_programs import batched_lapack_calls

FRAMES, PARTICLES, FITTED = 24, 60, 16
NOISE = 1e-4
"""Standard deviation of a coordinate's noise [m]."""
SDS = {"offset": 1e-3, "share": 2e-3, "drift": 2e-3, "walk": 1.5e-3, "white": 3e-4}
"""Standard deviation of each part of the process where it is drawn [m]."""
COVERAGE = (0.84, 0.95)
"""Shares of 90 % intervals that hold: 0.90, with three standard deviations of 60 independent particles."""


def frames(*, seen: np.ndarray | None = None) -> list[Timed]:
    """Return frames of one grasp, in which the tool goes out by 10 mm and half of the way back."""
    pulled = 1e-2 * np.interp(np.arange(FRAMES), [0, 15, FRAMES - 1], [0, 1, 0.5])
    sideways = 2e-3 * np.sin(np.arange(FRAMES))
    seen = np.ones((FRAMES, PARTICLES), bool) if seen is None else seen
    return [timed(k, np.array([0.0, sideways[k], pulled[k]]), seen[k]) for k in range(FRAMES)]


def timed(k: int, displacement: np.ndarray, seen: np.ndarray, grasp: int = 0) -> Timed:
    """Return a frame of which the tool's displacement [m], the time and the observed particles matter."""
    zeros, nothing = jnp.zeros((PARTICLES, 3)), jnp.zeros(PARTICLES, bool)
    frame = ClosedFrame(
        y=zeros,
        visible=jnp.asarray(seen),
        precision=jnp.broadcast_to(jnp.eye(3), (PARTICLES, 3, 3)),
        held=nothing,
        force_unknown=nothing,
        rotated=zeros,
        displacement=jnp.asarray(displacement),
        by_points=jnp.asarray(False),
        held_sd=jnp.asarray(0.0),
    )
    part, rest = int(k >= FITTED), np.zeros((PARTICLES, 3))
    return Timed(frame=frame, index=k, grasp=grasp, part=part, time=1.0 + k, closed=1.0 + k, state=rest, reports=())


def drawn(terms: tuple[str, ...], seed: int) -> np.ndarray:
    """Return residuals [m] of a process with some of its parts, and of a walk by sums of independent steps."""
    rng, every = np.random.default_rng(seed), frames()
    u = np.array([np.asarray(one.frame.displacement) for one in every])
    u, time = u / np.linalg.norm(u, axis=1).max(), np.array([one.time for one in every])
    steps = rng.normal(size=(FRAMES, PARTICLES, 3)) * np.sqrt(np.diff(time, prepend=0.0))[:, None, None]
    parts = {
        "offset": np.broadcast_to(rng.normal(size=(PARTICLES, 3)), steps.shape),
        "share": np.einsum("kd,ndc->knc", u, rng.normal(size=(PARTICLES, 3, 3))),
        "drift": (time / time[-1])[:, None, None] * rng.normal(size=(PARTICLES, 3)),
        "walk": np.cumsum(steps, axis=0) / np.sqrt(time[-1]),
        "white": rng.normal(size=steps.shape),
    }
    return np.sum([SDS[name] * parts[name] for name in terms], axis=0) + NOISE * rng.normal(size=steps.shape)


def fit_to(residual: np.ndarray, *, seen: np.ndarray | None = None) -> FittedRemainder:
    """Return the remainder by the first frames of residuals."""
    with jax.enable_x64(True):
        fitted, noise = np.arange(FRAMES) < FITTED, np.full((FRAMES, PARTICLES), NOISE**2)
        return remainder(frames(seen=seen), residual, fitted, noise=noise)


@pytest.mark.parametrize("terms", [TERMS, ("share", "white"), ("walk",), ("drift", "white")])
def test_intervals_of_later_frames_hold_and_the_mean_is_better_than_none(terms):
    residual = drawn(terms, seed=3)
    found = fit_to(residual)
    error = (residual - found.mean)[FITTED:]
    held = np.abs(error) <= 1.645 * np.sqrt(found.variance[FITTED:, :, None])
    assert COVERAGE[0] <= held.mean() <= COVERAGE[1]
    assert np.mean(error**2) < 0.7 * np.mean(residual[FITTED:] ** 2)


def test_the_variances_are_found():
    """Shares of 180 matrices' columns say the standard deviation to 1 / sqrt(2 * 180 * 3) = 3 %."""
    found = fit_to(drawn(("share", "white"), seed=5))
    assert found.variances["share"] ** 0.5 == pytest.approx(SDS["share"], rel=0.15)
    assert found.variances["white"] ** 0.5 == pytest.approx(SDS["white"], rel=0.15)
    assert max(found.variances[name] for name in ("offset", "drift", "walk")) < 0.05 * found.variances["share"]


def test_with_a_walk_alone_the_last_frame_stays():
    """The noise is a fifth of a step, so that the last frame counts almost alone."""
    residual = drawn(("walk",), seed=7)
    mean = fit_to(residual).mean[FITTED:]
    assert np.abs(mean - residual[FITTED - 1]).max() < 3 * NOISE


def test_particles_that_err_more_have_wider_intervals():
    residual = drawn(("walk",), seed=9)
    residual[:, :10] *= 8
    found = fit_to(residual)
    wide, narrow = (np.sqrt(found.variance[FITTED:, which].mean()) for which in (slice(0, 10), slice(10, None)))
    assert wide > 3 * narrow


def test_what_is_not_observed_or_not_fitted_does_not_count():
    residual, seen = drawn(TERMS, seed=11), np.random.default_rng(0).uniform(size=(FRAMES, PARTICLES)) > 0.2
    other = np.where(seen[:, :, None], residual, np.nan)
    other[FITTED:] = 1.0
    found, same = fit_to(residual, seen=seen), fit_to(other, seen=seen)
    np.testing.assert_array_equal(found.mean, same.mean)
    np.testing.assert_array_equal(found.variance, same.variance)
    mean, variance = found.of(frames(seen=seen), 1)
    assert len(mean) == len(variance) == seen[FITTED:].sum()
    np.testing.assert_array_equal(mean, found.mean[FITTED:][seen[FITTED:]])


def test_another_grasp_has_no_mean_and_intervals_that_hold():
    """Both grasps are draws of the same process, of which the first alone is fitted to."""
    residual = np.concatenate([drawn(TERMS, seed=13), drawn(TERMS, seed=14)])
    first, noise = frames(), np.full((2 * FRAMES, PARTICLES), NOISE**2)
    second = [
        timed(k, np.asarray(one.frame.displacement), np.ones(PARTICLES, bool), grasp=1) for k, one in enumerate(first)
    ]
    with jax.enable_x64(True):
        found = remainder([*first, *second], residual, np.arange(2 * FRAMES) < FRAMES, noise=noise)
    assert (found.mean[FRAMES:] == 0).all()
    held = np.abs(residual[FRAMES:]) <= 1.645 * np.sqrt(found.variance[FRAMES:, :, None])
    assert COVERAGE[0] - 0.06 <= held.mean() <= COVERAGE[1] + 0.03


def test_without_an_observed_residual_there_is_none():
    with pytest.raises(ValueError, match="observed in a frame that was fitted to"):
        fit_to(drawn(TERMS, seed=0), seen=np.zeros((FRAMES, PARTICLES), bool))


def test_lapack_gets_one_matrix_at_a_time():
    """Batches of matrices may wait for each other forever; see `map_rows`."""
    terms, known = jnp.ones((len(TERMS), FRAMES, FRAMES)), jnp.arange(FITTED)
    observed = Observed(
        residual=jnp.zeros((PARTICLES, FRAMES, 3)),
        seen=jnp.ones((PARTICLES, FRAMES), bool),
        noise=jnp.ones((PARTICLES, FRAMES)),
    )
    parameters = jnp.zeros(len(TERMS) + 1)
    assert not batched_lapack_calls(jax.grad(minus_log_posterior), parameters, terms, observed)
    assert not batched_lapack_calls(predicted_remainder, parameters, terms, known, observed)
