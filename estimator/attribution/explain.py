"""Explain the evidence of the likeliest hypotheses: the frames and particles on which it rests.

The difference of the log evidences of a hypothesis and of the declared model is split exactly: over frames, what the
frames of a grasp share, the priors of the sizes of errors, and the rest, which belongs to parameters and attachments
(their priors, and how well they are known). Each of the two has its own sizes of errors. A frame's part is split over
its particles and what these share; see `likelihood_split`.
"""

from typing import Any

import numpy as np

from ..parallel_map import parallel_map
from .close_loop import Closed
from .hypotheses import Hypothesis
from .likelihood_split import LikelihoodSplit, likelihood_split

N_EXPLAINED = 3
"""Largest number of hypotheses that are explained, the likeliest that were fitted to all frames."""


def explanation(closed: Closed) -> list[dict[str, Any]]:
    """Return the split of the evidence of the likeliest hypotheses with effects, over the declared model.

    Returns:
        For each hypothesis its effects, and log_bayes_factor over the declared model. This is the sum of: `nat` of each
        of `frames`; grasps_nat, of smooth force fields and of the tool's offsets; error_sizes_nat, of their prior; and
        parameters_nat. The sum of particles_nat and shared_nat is that of the frames.
    """
    declared = closed.declared
    ranked = [one for one in closed.fitted_to_all if one.added and np.isfinite(one.log_evidence)][:N_EXPLAINED]
    splits = parallel_map(lambda k: likelihood_split([declared, *ranked][k].fitted), range(len(ranked) + 1))
    return [_explained(one, declared, splits[k], splits[0]) for k, one in enumerate(ranked, 1)]


def _explained(
    one: Hypothesis, declared: Hypothesis, after: LikelihoodSplit, before: LikelihoodSplit
) -> dict[str, Any]:
    fitted, base, frames = one.fitted, declared.fitted, one.fitted.problem.history.frames
    factor = one.log_evidence - declared.log_evidence
    sizes = fitted.problem.scales.log_prior() - base.problem.scales.log_prior()
    return {
        "effects": list(one.names),
        "log_bayes_factor": factor,
        "frames": [
            {
                "index": frames[k].index,
                "grasp": frames[k].grasp,
                "time_s": frames[k].time,
                "displacement_m": float(np.linalg.norm(frames[k].frame.displacement)),
                "nat": float(nat),
            }
            for k, nat in zip(fitted.weights, after.frames - before.frames, strict=True)
        ],
        "particles_nat": (after.particles - before.particles).sum(axis=0).tolist(),
        "shared_nat": float((after.shared - before.shared).sum()),
        "grasps_nat": after.grasps - before.grasps,
        "error_sizes_nat": sizes,
        "parameters_nat": factor - sizes - (fitted.log_likelihood - base.log_likelihood),
    }
