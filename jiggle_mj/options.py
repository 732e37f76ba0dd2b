"""The words that scene files, settings and the command line share: sensing, filters, policies."""

from typing import Literal, get_args

Sensing = Literal["stereo", "points", "particles", "cloud"]
"""What the estimator is given: images; noisy tracked points of the tissue; noisy vertices of the reference; clouds."""
SENSING: tuple[Sensing, ...] = get_args(Sensing)
FilterName = Literal["implicit", "explicit", "adam", "nnls", "unscented"]
"""How a frame enters the belief."""
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
"""Who chooses the actions: the scene's programme; ours, free to grasp anew or not, and within two procedures; the
paper's."""
POLICIES: tuple[PolicyName, ...] = get_args(PolicyName)
PRIMITIVES: tuple[PolicyName, ...] = tuple(name for name in POLICIES if name.startswith("pmp-"))
"""The paper's policies that pull in one direction and look at nothing."""
