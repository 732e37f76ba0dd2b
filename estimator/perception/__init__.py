"""From stereo images, tracked points or clouds to particles.

Of images: tissue mask, disparity, the estimator's own mesh, and tracks of its particles. Data flow: `rectified` ->
`tissue_mask`, `disparity` -> `sheet_mesh` -> (`material_map`, `mesh_field`) -> `flow` -> `registration` (with
`lucas_kanade`) -> `stereo_tracker`, which holds it together. `sight` is the door to all three.
"""

from jiggle_mj.estimator.perception.disparity import Disparity, SemiGlobalMatching
from jiggle_mj.estimator.perception.point_tracker import PointTracker
from jiggle_mj.estimator.perception.sight import Believed, Sight
from jiggle_mj.estimator.perception.stereo_tracker import StereoTracker
from jiggle_mj.estimator.perception.tissue_mask import TissueMask, WarmTissue
from jiggle_mj.estimator.perception.track import Track

__all__ = [
    "Believed",
    "Disparity",
    "PointTracker",
    "SemiGlobalMatching",
    "Sight",
    "StereoTracker",
    "TissueMask",
    "Track",
    "WarmTissue",
]
