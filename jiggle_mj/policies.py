"""Who chooses what the tool does: the names, for scene files and the command line."""

from typing import Literal, get_args

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
"""The scene's programme; ours, free to grasp anew or not, and within two procedures; the paper's."""
POLICIES: tuple[PolicyName, ...] = get_args(PolicyName)
PRIMITIVES: tuple[PolicyName, ...] = tuple(name for name in POLICIES if name.startswith("pmp-"))
"""The paper's that pull one way and look at nothing."""
