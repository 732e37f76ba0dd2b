"""The actions of a run: the scene's own programme, or those of a policy that looks at the estimate."""

from collections.abc import Callable, Iterator
from functools import cache, partial
from itertools import chain, takewhile
from typing import TYPE_CHECKING

from jiggle_mj.actions import Action
from jiggle_mj.errors import OptionError
from jiggle_mj.estimator import Estimator, EstimatorConfig
from jiggle_mj.estimator.planning.information_policy import InformationPolicy
from jiggle_mj.estimator.planning.paper_policies import PAPER, Primitive
from jiggle_mj.estimator.planning.policy import Policy
from jiggle_mj.estimator.planning.procedures import Detach, ProcedurePolicy, Sew
from jiggle_mj.estimator.planning.tool_kinematics import ToolKinematics
from jiggle_mj.options import POLICIES, PRIMITIVES

from ..metrics.result_file import Json

if TYPE_CHECKING:
    from jiggle_mj.scenes import Scene

MAX_STEPS = 40
"""Most actions of a policy if no number is given."""
MAX_PROCEDURE_STEPS = 400
"""Most actions of a policy that cuts or sews: it looks again after each act."""
LARGEST_STEPS = 100_000
"""Largest number that can be given: at a second an action, more than a day."""


def policy_named(name: str | None, scene: "Scene", *, seed: int) -> Policy | None:
    """Return a fresh policy; None for the scene's programme.

    Args:
        name: one of `POLICIES`; None for the scene's own.
        scene: gives the limits and the jaws.
        seed: of the policy's samples.

    Raises:
        OptionError: no such policy.
    """
    name, limits = scene.programme.policy if name is None else name, scene.limits.limits()
    if name not in POLICIES:
        raise OptionError(f"policy = {name!r}: must be one of {', '.join(POLICIES)}.")
    if name == "corners":
        return None
    if name in PAPER:
        return PAPER[name](limits, seed=seed)
    if name in PRIMITIVES:
        return Primitive(name.removeprefix("pmp-"))
    information = partial(InformationPolicy, limits, radius=scene.tweezer.radius, seed=seed, tweezer=_tweezer())
    if name == "information":
        return information()
    if name == "one-grasp":
        return information(regrasps=False)
    if name == "detach":
        return Detach(information)
    plan = scene.procedure
    return Sew(information, length=plan.suture_length, width=plan.suture_width, stiffness=plan.suture_stiffness)


@cache
def _tweezer() -> ToolKinematics:
    from jiggle_mj.scenes.tissue.model import TWEEZER

    return ToolKinematics.read(TWEEZER.read_text(encoding="utf-8"))


def check_policy_fits(policy: Policy, config: EstimatorConfig) -> None:
    """Check that a policy can read the belief of the filter.

    Raises:
        OptionError: it predicts pulls, and the filter is not the one that can.
    """
    if isinstance(policy, InformationPolicy | ProcedurePolicy) and config.filter != "implicit":
        raise OptionError(
            f"information, one-grasp, detach and suture plan with the filter 'implicit'; got {config.filter!r}. "
            "Leave --estimator out, or choose a policy of the paper."
        )


def actions(
    scene: "Scene",
    policy: Policy | None,
    estimator: Estimator,
    steps: int | None = None,
    *,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[Action]:
    """Yield what the tool does, in order, until `stop` is true.

    A policy that does not choose its grasps gets the scene's first grasp.
    """
    from jiggle_mj.scenes.scene.programme import programme

    first = programme(scene) if policy is None else _opening(scene, policy)
    first = takewhile(lambda _: not stop(), first)
    if policy is None:
        return first
    return chain(first, policy.actions(estimator, steps=_max_steps(policy, steps), stop=stop))


def acts(policy: Policy | None, estimator: Estimator) -> Json | None:
    """Return the procedure's part of result.json: each cut or suture with the log Bayes factor that it worked.

    Returns:
        None where the policy is no procedure.
    """
    if not isinstance(policy, ProcedurePolicy):
        return None
    seen: list[object] = [
        {
            "frame": change.index,
            "kind": type(change.event).__name__.lower(),
            "log_bayes_factor": estimator.change_log_bayes_factor(change),
        }
        for change in estimator.changes
    ]
    return {"name": policy.name, "cycles": len(seen), "success": None, "acts": seen}


def most_actions(scene: "Scene", name: str | None, steps: int | None = None) -> int:
    """Return the largest number of actions of a run, for progress."""
    from jiggle_mj.scenes.scene.programme import programme

    policy = policy_named(name, scene, seed=0)
    if policy is None:
        return sum(1 for _ in programme(scene))
    return _max_steps(policy, steps) + sum(1 for _ in _opening(scene, policy))


def _max_steps(policy: Policy, steps: int | None) -> int:
    if steps is not None and steps < 1:
        raise OptionError(f"steps = {steps}: must be at least 1.")
    if steps is not None and steps > LARGEST_STEPS:
        raise OptionError(f"steps = {steps}: must be at most {LARGEST_STEPS}.")
    return steps or (MAX_PROCEDURE_STEPS if isinstance(policy, ProcedurePolicy) else MAX_STEPS)


def _opening(scene: "Scene", policy: Policy) -> Iterator[Action]:
    from jiggle_mj.scenes.scene.programme import opening, still

    if isinstance(policy, InformationPolicy):
        return still(scene) if policy.regrasps else opening(scene, height=0.0)
    return still(scene) if isinstance(policy, ProcedurePolicy) else opening(scene)
