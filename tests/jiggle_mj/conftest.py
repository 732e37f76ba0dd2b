"""A small scene and its recordings, which the tests of series, cluster and command line share."""

import pytest

from jiggle_mj.episode import observe
from jiggle_mj.scenes import Reference, load_scene, programme
from tests.support.series import COUNT, contents, write_scene


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    """The scene of `tests.support.series`."""
    return load_scene(write_scene(tmp_path_factory.mktemp("scene")))


@pytest.fixture(scope="session")
def one_by_one(scene, tmp_path_factory):
    """File name to bytes of recordings made by `observe` alone, as `jiggle-mj record` without --count does."""
    folder = tmp_path_factory.mktemp("one_by_one")
    for seed in range(COUNT):
        with Reference(scene, seed=seed, sensing="particles") as reference:
            for _ in observe(reference, programme(scene), folder / f"{seed:06d}.mcap", seed=seed):
                pass
    return contents(folder)
