"""Held-out predictions without a model."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.attribution.held_out import rms
from jiggle_mj.estimator.attribution.trivial_predictions import trivial_predictions
from tests.support.small_sheet import sheet

ERROR = 5e-4
"""Length of the error of each position [m]."""


def test_baselines_of_particles_that_move_a_share_of_the_tools_displacement(light):
    """Each particle moves its share exactly, with an error of half a millimetre in the last part."""
    rest, share = sheet().rest, np.random.default_rng(0).uniform(size=(len(sheet().rest), 1))
    last = light[2].frames[-1].part
    frames = [
        dataclasses.replace(
            one,
            frame=dataclasses.replace(
                one.frame, y=jnp.asarray(rest + share * np.asarray(one.frame.displacement) + error)
            ),
        )
        for one in light[2].frames
        for error in (ERROR * (one.part == last and bool(np.any(one.frame.displacement))) / np.sqrt(3),)
    ]
    of_part = [one for one in frames if one.part == last]
    moved = np.mean([bool(np.any(one.frame.displacement)) for one in of_part])
    found = {name: rms(np.concatenate(every)) for name, every in trivial_predictions(frames, last).items()}
    assert found["in_proportion"] == pytest.approx(ERROR * np.sqrt(moved))
    free = ~np.asarray(of_part[0].frame.held)
    displacement = np.concatenate([(np.asarray(one.frame.y) - rest)[free] for one in of_part])
    assert found["unmoved"] == pytest.approx(np.sqrt(np.mean(np.sum(displacement**2, axis=1))))
    before = [one for one in frames if one.part != last][-1].frame
    both = free & ~np.asarray(before.held)
    changed = np.concatenate([(np.asarray(one.frame.y) - np.asarray(before.y))[both] for one in of_part])
    assert found["last_frame"] == pytest.approx(np.sqrt(np.mean(np.sum(changed**2, axis=1))))
