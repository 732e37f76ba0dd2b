"""The check of points at rest, as an estimate makes it in its first frames, without a filter."""

from collections.abc import Iterable

import jax

from jiggle_mj.observation import Declaration, Observation

from .config import EstimatorConfig
from .perception import Perception
from .tracked_sheet import unfolded


def check_rest(observations: Iterable[Observation], declaration: Declaration) -> None:
    """Refuse points or clouds that show no sheet at rest, before an estimate with the default settings does.

    Args:
        observations: of a recording without images; read until the jaws close.
        declaration: of the tissue.

    Raises:
        PerceptionError: too few points.
        MeshError: the points are several sheets, or a folded one.
    """
    config = EstimatorConfig()
    perception = Perception(
        declaration, None, spacing=config.spacing, config=config.perception, mask=None, disparity=None
    )
    for observation in observations:
        perception.look_at_rest(observation)
        if observation.tool.closed or observation.events:
            break
    with jax.enable_x64(True):
        unfolded(perception.sheet())
