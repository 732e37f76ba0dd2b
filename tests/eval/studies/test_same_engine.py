"""The same-engine truth: exactly the engines' own states, noise as declared and from the seed alone, one estimate."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator import Estimator, EstimatorConfig
from jiggle_mj.estimator.physics.environment import Grip
from jiggle_mj.estimator.physics.mesh import SheetMesh
from jiggle_mj.estimator.physics.simulator import SWEEPS_PER_STEP, simulator
from jiggle_mj.estimator.physics.surrogate import surrogate
from jiggle_mj.eval.metrics.detection_metrics import agreement
from jiggle_mj.eval.studies.paper_tables import EXACT_FORCE_SD
from jiggle_mj.eval.studies.same_engine import (
    FORCE_TOLERANCE,
    LIFT_INCREMENTS,
    POINT_SD,
    SameEngine,
    same_engine,
    sheet,
)
from jiggle_mj.scenes import load_scene
from tests.support.small_scene import SCENE

ROUNDING = 1e-12
"""Difference of positions that come from the same operations [m]; coordinates are about 0.1 m."""
ASSEMBLY = 0.01
"""Share by which a force summed in another order may exceed the tolerance of the search."""
STATISTICAL = 0.05
"""Sampling error of a standard deviation and of a correlation; that of thousands of coordinates is below 0.02."""


def made(engine, seed: int = 0) -> SameEngine:
    return same_engine(SCENE, engine, seed=seed)


@pytest.mark.parametrize("engine", ["xpbd", "equilibrium"])
def test_the_truth_is_the_engines_own_state(engine):
    found = made(engine)
    mesh = SheetMesh(found.truth.rest, found.truth.faces)
    b = jnp.asarray(found.truth.frames[0].stiffness)
    frames = list(zip(found.observations, found.truth.frames, strict=True))
    assert len(frames) == 1 + 4 * (1 + LIFT_INCREMENTS)
    stiff = EstimatorConfig().grip_stiffness * found.declaration.membrane_stiffness
    closed, before = frames[1:3]
    for observation, now in (frames[2], frames[3]):
        grip = Grip.build(jnp.asarray(mesh.rest), jnp.asarray(closed[1].tip), radius=7e-3, stiffness=stiff)
        grip = eqx.tree_at(lambda g: g.tip, grip, jnp.asarray(observation.tool.position))
        assert set(observation.tool.held_tracks) == set(np.flatnonzero(grip.stiffness).tolist())
        if engine == "xpbd":
            start = before[1].positions if now.index == 3 else mesh.rest
            x = simulator(mesh, found.declaration).step(jnp.asarray(start), b, grip, sweeps=SWEEPS_PER_STEP)
            np.testing.assert_allclose(now.positions, x, atol=ROUNDING)
        else:
            x = jnp.asarray(now.positions)
            forces = surrogate(mesh, found.declaration).gradient(x, b) + grip.gradient(x[:, None])[:, 0]
            assert np.abs(forces).max() <= (1 + ASSEMBLY) * FORCE_TOLERANCE


def test_a_seed_draws_the_noise_and_nothing_else():
    first, second = made("xpbd", 0), made("xpbd", 1)
    for a, b in zip(first.truth.frames, second.truth.frames, strict=True):
        np.testing.assert_array_equal(a.positions, b.positions)
    true = np.stack([frame.positions for frame in first.truth.frames])
    noise = [np.stack([seen.points.positions for seen in made.observations]) - true for made in (first, second)]
    assert [part.std() for part in noise] == pytest.approx([POINT_SD, POINT_SD], rel=STATISTICAL)
    assert abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < STATISTICAL


def test_one_grasp_is_the_beginning_of_four():
    one, four = same_engine(SCENE, "xpbd", seed=0, grasps=1), made("xpbd")
    assert len(one.observations) == 2 + LIFT_INCREMENTS
    for a, b in zip(one.truth.frames, four.truth.frames, strict=False):
        np.testing.assert_array_equal(a.positions, b.positions)


@pytest.mark.slow
def test_our_filter_finds_the_attachments_of_its_own_engine():
    """Within one ring, with a small force error, as the data come from the estimator's own model."""
    found = made("equilibrium")
    estimator = Estimator(found.declaration, config=EstimatorConfig(force_sd=EXACT_FORCE_SD))
    for observation in found.observations:
        estimator.update(observation)
    estimator.release()
    near = agreement(estimator.detection.attached, found.truth.attached, found.truth.faces, 1)
    assert near.pcd is not None and near.pug is not None and min(near.pcd, near.pug) >= 0.95


def test_shapes_and_counts_are_the_scenes():
    """The attached vertices are those of the scene's own tissue."""
    mesh, attached = sheet(load_scene("arc"))
    assert mesh.n == 611 and attached.sum() == 52
