"""Frames in which what is held is seen in another shape are told from those that noise, a turn or a shift changes."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jiggle_mj.estimator.attribution.closed_frames import ClosedFrame, Timed
from jiggle_mj.estimator.attribution.held_shape import another_shape

ROW = np.stack([np.linspace(-0.1, 0.1, 7), np.zeros(7), np.zeros(7)], axis=1)
SD = 1e-3
FIELDS = np.full((7, 1), 5e-3)
"""Noise that all points share, which changes no shape [m]."""
COUNT = 40


def frame(y: np.ndarray, *, held: int = 7) -> Timed:
    one = ClosedFrame(
        y=jnp.asarray(y),
        visible=jnp.ones(7, bool),
        precision=jnp.zeros((7, 3, 3)),
        held=jnp.arange(7) < held,
        force_unknown=jnp.ones(7, bool),
        rotated=jnp.asarray(ROW),
        way=jnp.zeros(3),
        by_points=jnp.asarray(False),
        held_sd=jnp.zeros(()),
    )
    return Timed(frame=one, index=0, grasp=0, part=0, time=0.0, closed=0.0, state=y, reports=())


def series(mistaken: dict[int, np.ndarray], *, held: int = 7) -> list[Timed]:
    """Noisy frames, each turned and moved elsewhere; some with another shape."""
    draw = np.random.default_rng(0)
    turns, moves = Rotation.random(COUNT, rng=draw), draw.normal(size=(COUNT, 3))
    noise = SD * draw.normal(size=(COUNT, 7, 3))
    seen = [turns[k].apply(mistaken.get(k, ROW)) + moves[k] + noise[k] for k in range(COUNT)]
    return [frame(y, held=held) for y in seen]


@pytest.mark.parametrize(
    ("shape", "found"),
    [(ROW, []), (1.02 * ROW, []), (0.8 * ROW, [7, 30]), (ROW + [[0, 0.04, 0]] * (np.arange(7) == 6)[:, None], [7, 30])],
    ids=["as it was", "wider by its noise", "narrower", "one end elsewhere"],
)
def test_another_shape_is_found_and_a_turn_or_noise_is_none(shape, found):
    assert another_shape(series({7: shape, 30: shape}), SD, FIELDS) == found


def test_a_hold_of_a_few_points_or_one_that_often_changes_says_nothing():
    narrow = 0.5 * ROW
    assert another_shape(series({7: narrow}, held=3), SD, FIELDS) == []
    assert another_shape(series(dict.fromkeys(range(5), narrow)), SD, FIELDS) == []
    assert another_shape(series(dict.fromkeys(range(4), narrow)), SD, FIELDS) == [0, 1, 2, 3]
