"""A strip whose attachment is out of view is suspected there: the declared mesh extends beyond the measured points."""

import json

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.belief.prior import PriorConfig
from jiggle_mj.estimator.physics.energy import SheetEnergy
from jiggle_mj.estimator.physics.environment import Grip
from jiggle_mj.estimator.physics.surrogate import surrogate
from jiggle_mj.eval.runs.experiment import run_estimator
from jiggle_mj.eval.runs.scoring import score_directory
from jiggle_mj.importing.folder import import_folder
from jiggle_mj.observation import Declaration
from jiggle_mj.recording.estimate import read_estimate
from tests.support.small_sheet import equilateral, jittered, search

STRIP = jittered(equilateral(16, 5, 4e-3), 0.1)
FREE = Declaration(gravity=(0.0, 0.0, 0.0), bed=False)
LEFT, RIGHT = STRIP.rest[:, 0].min(), STRIP.rest[:, 0].max()
HOLD = LEFT + 9e-3
"""Particles to the left of this are attached [m]."""
VIEW = LEFT + 18e-3
"""Particles to the right of this are measured [m]."""
GRIP = RIGHT - 5e-3
"""Particles to the right of this are held [m]."""
STEP = 1e-3
"""Length of a step of the tool [m]."""

TOML = f"""
name = "strip"
unit = "m"
period = 1.0
noise_sd = 5e-5
[points]
files = ["pull_*.xyz"]
[mesh.extend]
axis = [1.0, 0.0, 0.0]
begin = {LEFT}
end = {RIGHT}
spacing = 4e-3
held_beyond = {GRIP}
[grasp]
start = [{RIGHT}, 0.0, 0.0]
direction = [1.0, 0.0, 0.0]
step = {STEP}
[truth]
attached_beyond = {HOLD}
[declaration]
gravity = [0.0, 0.0, 0.0]
bed = false
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder of five steps of 1 mm by the estimator's own engine; the left 18 mm are never seen."""
    where = tmp_path_factory.mktemp("strip")
    grip = Grip.build(jnp.asarray(STRIP.rest), jnp.array([RIGHT, 0, 0]), radius=RIGHT - GRIP + 8e-3, stiffness=100.0)
    energy = surrogate(STRIP, FREE)
    b, x, rng = jnp.asarray(3.0 * (STRIP.rest[:, 0] < HOLD)), jnp.asarray(STRIP.rest), np.random.default_rng(0)
    seen = STRIP.rest[:, 0] > VIEW
    for step in range(6):
        moved = eqx.tree_at(lambda g: g.tip, grip, jnp.array([RIGHT + step * STEP, 0, 0]))
        found = search(SheetEnergy.build(STRIP.rest, (*energy.terms, moved), energy.layout), b, x)
        assert found.converged
        x = found.x
        noise = 5e-5 * rng.normal(size=(seen.sum(), 3))
        np.savetxt(where / f"pull_{step}.xyz", np.asarray(x)[seen] + noise)
    (where / "recording.toml").write_text(TOML)
    return where


@pytest.mark.slow
def test_the_hold_is_suspected_where_nothing_is_seen_and_nowhere_else(folder, tmp_path):
    """Five frames show that the strip is attached beyond the view, not where: P(attached) is spread there.

    No particle more than three spacings inside the view is reported, and what was seen is suspected less than before.
    """
    summary = import_folder(folder, None, tmp_path / "strip.mcap")
    run_estimator(tmp_path / "strip.mcap", tmp_path / "out")
    found = read_estimate(tmp_path / "out" / "estimate.mcap")
    x, probability = found.sheet.rest[:, 0], found.detection.score
    assert x.min() < LEFT + 2e-3 and summary.n_held > 0
    assert not np.isfinite(found.estimates[-1].observed[x < VIEW - 1e-3]).any()
    seen = (x > VIEW + 3 * 4e-3) & ~found.estimates[-1].held
    assert not found.detection.attached[seen].any() and probability[seen].mean() < PriorConfig().probability
    assert probability[x < VIEW].mean() > 4 * probability[seen].mean()
    assert probability[x < VIEW].sum() > 2.5
    assert summary.truth is not None and summary.n_attached
    score_directory(tmp_path / "out", summary.truth)
    figures = json.loads((tmp_path / "out" / "result.json").read_text())
    assert figures["detection"]["n_attached"] == summary.n_attached
