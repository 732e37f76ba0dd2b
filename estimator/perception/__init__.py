"""From stereo images, tracked points or clouds to particles.

Of images: tissue mask, disparity, the estimator's own mesh, and tracks of its particles. Data flow: `rectified` ->
`tissue_mask`, `disparity` -> `sheet_mesh` -> (`material_map`, `mesh_field`) -> `flow` -> `registration` (with
`lucas_kanade`) -> `stereo_tracker`, which holds it together. `sight` is the door to all three.
"""

from .disparity import Disparity, SemiGlobalMatching
from .perception import Believed, Perception
from .point_tracker import PointTracker
from .stereo_tracker import StereoTracker
from .tissue_mask import TissueMask, WarmTissue
from .track import Track

__all__ = [
    "Believed",
    "Disparity",
    "Perception",
    "PointTracker",
    "SemiGlobalMatching",
    "StereoTracker",
    "TissueMask",
    "Track",
    "WarmTissue",
]
