"""Detect frames in which what is held has another shape, and not those with noise, a rotation or a shift alone."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jiggle_mj.estimator.attribution.grasped_frames import ClosedFrame, Timed
from jiggle_mj.estimator.attribution.held_shape import another_shape

ROW = np.stack([np.linspace(-0.1, 0.1, 7), np.zeros(7), np.zeros(7)], axis=1)
SD = 1e-3
"""Standard deviation of the white noise [m]."""
FIELDS = np.full((7, 1), 5e-3)
"""Field of smooth noise that all points share, which changes no shape [m]."""
N_FRAMES = 40


def frame(y: np.ndarray, *, held: int = 7) -> Timed:
    """Return a frame with points at y, the first of which are held."""
    closed = ClosedFrame(
        y=jnp.asarray(y),
        visible=jnp.ones(7, bool),
        precision=jnp.zeros((7, 3, 3)),
        held=jnp.arange(7) < held,
        force_unknown=jnp.ones(7, bool),
        rotated=jnp.asarray(ROW),
        displacement=jnp.zeros(3),
        by_points=jnp.asarray(False),
        held_sd=jnp.zeros(()),
    )
    return Timed(frame=closed, index=0, grasp=0, part=0, time=0.0, closed=0.0, state=y, reports=())


def series(mistaken: dict[int, np.ndarray], *, held: int = 7) -> list[Timed]:
    """Return noisy frames, each rotated and shifted; some of them with another shape."""
    draw = np.random.default_rng(0)
    rotations, shifts = Rotation.random(N_FRAMES, rng=draw), draw.normal(size=(N_FRAMES, 3))
    noise = SD * draw.normal(size=(N_FRAMES, 7, 3))
    positions = [rotations[k].apply(mistaken.get(k, ROW)) + shifts[k] + noise[k] for k in range(N_FRAMES)]
    return [frame(y, held=held) for y in positions]


@pytest.mark.parametrize(
    ("shape", "found"),
    [(ROW, []), (1.02 * ROW, []), (0.8 * ROW, [7, 30]), (ROW + [[0, 0.04, 0]] * (np.arange(7) == 6)[:, None], [7, 30])],
    ids=["as it was", "wider within its noise", "narrower", "one end elsewhere"],
)
def test_another_shape_is_detected_and_a_rotation_or_noise_is_not(shape, found):
    assert another_shape(series({7: shape, 30: shape}), SD, FIELDS) == found


def test_a_grip_on_few_points_or_one_that_often_changes_is_not_used():
    narrow = 0.5 * ROW
    assert another_shape(series({7: narrow}, held=3), SD, FIELDS) == []
    assert another_shape(series(dict.fromkeys(range(5), narrow)), SD, FIELDS) == []
    assert another_shape(series(dict.fromkeys(range(4), narrow)), SD, FIELDS) == [0, 1, 2, 3]
