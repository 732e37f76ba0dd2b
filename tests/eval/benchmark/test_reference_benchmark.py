"""The reference's benchmark: what it prints."""

import json

import numpy as np
import pytest

from jiggle_mj.eval.benchmark import reference_benchmark as bench
from jiggle_mj.scenes.tissue.model import build_tissue

OUTLINE = 0.05
"""Share of vertices by which a lattice that is cut off at the outline differs from the size that was asked."""


@pytest.mark.render
def test_it_times_increments_pairs_and_an_episode():
    """On small meshes; the whole episode of the shipped scene is left to the benchmark itself."""
    small = bench.sized(60)
    metrics = bench.reference_benchmark((60, 120), log=lambda _: None, scene=small, stereo_pairs=3)
    small_one, large, exponent = (
        float(metrics[f"reference_increment_{end}"]["value"]) for end in ("n60_s", "n120_s", "exponent")
    )
    assert exponent == pytest.approx(np.log(large / small_one) / np.log(2))
    assert 3 <= float(metrics["reference_increment_n60_steps"]["value"]) < 100
    assert float(metrics["reference_episode_s"]["value"]) > 8 * small_one
    assert 0 < float(metrics["stereo_pair_s"]["value"]) < 5
    json.dumps(metrics, allow_nan=False)


def test_sizes_are_about_what_was_asked():
    for n in (300, 625):
        assert len(build_tissue(bench.sized(n), drawn=False).sheet.vertices) == pytest.approx(n, rel=OUTLINE)
