"""Names of options that scene files, configurations and the command line share: sensing, filters, policies."""

from typing import Literal, get_args

Sensing = Literal["stereo", "points", "particles", "cloud"]
"""What the estimator receives: stereo images; noisy tracked points of the tissue; noisy vertices of the reference
mesh; a noisy cloud of other points in each frame."""
SENSING: tuple[Sensing, ...] = get_args(Sensing)
"""Every kind of sensing."""
FilterName = Literal["implicit", "explicit", "adam", "nnls", "unscented"]
"""Filter that updates the belief with a frame."""
PolicyName = Literal[
    "corners",
    "information",
    "one-grasp",
    "detach",
    "suture",
    "sl-d",
    "lg-d",
    "lg-h",
    "pmp-up",
    "pmp-forward",
    "pmp-backward",
    "pmp-left",
    "pmp-right",
]
"""Policy that chooses the actions: the scene's programme (`corners`); ours, which may grasp anew (`information`) or not
(`one-grasp`); our two procedures (`detach`, `suture`); the paper's."""
POLICIES: tuple[PolicyName, ...] = get_args(PolicyName)
"""Every policy."""
CalibrationReference = Literal["assumed", "exact", "mujoco"]
"""What makes the data of simulation-based calibration: our own engine with the errors that the filter assumes, our own
engine without errors of forces, the reference tissue."""
PRIMITIVES: tuple[PolicyName, ...] = tuple(name for name in POLICIES if name.startswith("pmp-"))
"""The paper's policies that pull in one fixed direction, whatever is observed."""
