"""From stereo images to particles: tissue mask, disparity, the estimator's own mesh, and tracks of its particles.

Data flow: `rectified` -> `tissue_mask`, `disparity` -> `sheet_mesh` -> (`material_map`, `mesh_field`) -> `flow` ->
`registration` (with `lucas_kanade`) -> `stereo_tracker`, which holds it together.
"""

from jiggle_mj.estimator.perception.disparity import Disparity, SemiGlobalMatching
from jiggle_mj.estimator.perception.stereo_tracker import StereoTracker, Track
from jiggle_mj.estimator.perception.tissue_mask import TissueMask, WarmTissue

__all__ = ["Disparity", "SemiGlobalMatching", "StereoTracker", "TissueMask", "Track", "WarmTissue"]
