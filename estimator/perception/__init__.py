"""Perception: measurements of the particles from stereo images, tracked points or clouds.

`perception` selects the tracker of a recording: `stereo_tracker`, `point_tracker` or `cloud_tracker`. Data flow of
images: `rectified` -> `tissue_mask`, `disparity` -> `sheet_mesh` -> (`material_map`, `mesh_field`) -> `flow` ->
`registration` (with `lucas_kanade`), in the order of `stereo_tracker`. `config` holds the settings.
"""

from .config import PerceptionConfig
from .disparity import Disparity, SemiGlobalMatching
from .grab_cut import GrabCut
from .perception import Perception, SimulatorInput
from .point_tracker import PointTracker
from .stereo_tracker import StereoTracker
from .tissue_mask import FrameMask, TissueMask, WarmTissue
from .track import Track

__all__ = [
    "Disparity",
    "FrameMask",
    "GrabCut",
    "Perception",
    "PerceptionConfig",
    "PointTracker",
    "SemiGlobalMatching",
    "SimulatorInput",
    "StereoTracker",
    "TissueMask",
    "Track",
    "WarmTissue",
]
