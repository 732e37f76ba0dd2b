"""The paper's policies: one grasp, held from beginning to end, moved by one of its controllers.

They predict the tissue with the paper's simulator. It has the stiffness of the particles that are detected as attached,
and none elsewhere: the mean of a vague belief is a small stiffness everywhere, which no tissue has.
"""

from abc import abstractmethod
from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jiggle_mj.actions import Action, Move
from jiggle_mj.limits import Limits

from ..blas import one_thread
from ..estimator import Estimator
from ..physics.mesh import SheetMesh
from ..physics.simulator import simulator
from ..physics.xpbd import XPBD
from .controllers import (
    N_SAMPLES,
    PRIMITIVES,
    Samples,
    Scales,
    Situation,
    displacement_loss,
    entropy_loss,
    large_step,
    local_step,
    truncated_step,
)
from .policy import STEP, Policy
from .workspace import Workspace

OBSERVATION_SD = 2e-4
"""Standard deviation of an observed coordinate in LG-H's entropy [m]."""
MIN_STEP = 1e-5
"""A step shorter than this ends the policy, because no step lowers the loss [m]."""


class Primitive(Policy):
    """PMP: pull in one direction, without an estimate."""

    def __init__(self, name: str) -> None:
        """Choose the direction by its name in `PRIMITIVES`."""
        super().__init__()
        self._direction = np.array(PRIMITIVES[name])

    def plan(self, estimator: Estimator) -> tuple[Action, str] | str:
        """See `Policy.plan`."""
        return Move(to=_tip(estimator) + STEP * self._direction), "the primitive goes on"


class Controlled(Policy):
    """Base of LG-H, LG-D and SL-D, which share simulator, situation and scales."""

    def __init__(self, limits: Limits, *, seed: int) -> None:
        """Keep to the limits; `seed` is of the samples."""
        super().__init__()
        self._limits, self._key = limits, jax.random.key(seed)
        self._simulator: XPBD | None = None

    def plan(self, estimator: Estimator) -> tuple[Action, str] | str:
        """See `Policy.plan`."""
        with jax.enable_x64(True), one_thread():
            if self._simulator is None:
                sheet = estimator.sheet
                self._simulator = simulator(SheetMesh(sheet.rest, sheet.faces), estimator.declaration)
                self._scales = self._scaled(estimator)
            situation = self._situation(estimator)
            to = np.asarray(self.choose(self._simulator, situation, Workspace.around(estimator, self._limits)))
        if not np.isfinite(to).all():
            return "the simulator has no finite prediction"
        if np.linalg.norm(to - np.asarray(situation.tip)) < MIN_STEP:
            return "no step lowers the loss"
        return Move(to=to), "the controller's step"

    @abstractmethod
    def choose(self, simulator: XPBD, situation: Situation, workspace: Workspace) -> Float[Array, " 3"]:
        """Return where the tip goes [m]."""

    def _situation(self, estimator: Estimator) -> Situation:
        hold, detection, k = estimator.hold, estimator.detection, estimator.declaration.membrane_stiffness
        if hold is None:
            raise ValueError("the paper's controllers move a grasp: close the jaws first.")
        return Situation(
            x=jnp.asarray(estimator.positions),
            tip=jnp.asarray(_tip(estimator)),
            length=jnp.asarray(np.linalg.norm(hold.closed_at - hold.tip, axis=1)),
            stiffness=jnp.where(jnp.asarray(hold.held), estimator.config.grip_stiffness * k, 0.0),
            b=jnp.asarray(np.where(detection.attached, detection.stiffness, 0.0)),
            covariance=jnp.asarray(_covariance(estimator)),
        )

    def _scaled(self, estimator: Estimator) -> Scales:
        rest, covariance = jnp.asarray(estimator.sheet.rest), jnp.asarray(_covariance(estimator))
        return Scales.at_prior(rest, covariance, energy=self._limits.energy, noise=OBSERVATION_SD)


class Local(Controlled):
    """LG-H or LG-D: one step of descent on a loss from the tip."""

    def __init__(self, loss: Callable, limits: Limits, *, seed: int) -> None:
        """Descend `entropy_loss` or `displacement_loss`."""
        super().__init__(limits, seed=seed)
        self._loss = loss

    def choose(self, simulator: XPBD, situation: Situation, workspace: Workspace) -> Float[Array, " 3"]:
        """See `Controlled.choose`; the gradient alone keeps to the workspace, as in the paper."""
        return _local(self._loss, simulator, situation, self._scales)


class SampledController(Controlled):
    """SL-D: descend L_D from many samples of the workspace, and step towards the best."""

    def __init__(self, limits: Limits, *, seed: int) -> None:
        """Keep to the limits; `seed` is of the samples."""
        super().__init__(limits, seed=seed)
        self._samples: Samples | None = None

    def choose(self, simulator: XPBD, situation: Situation, workspace: Workspace) -> Float[Array, " 3"]:
        """See `Controlled.choose`."""
        low, high = jnp.asarray(workspace.low), jnp.asarray(workspace.high)
        self._key, first, key = jax.random.split(self._key, 3)
        if self._samples is None:
            drawn = jax.random.uniform(first, (N_SAMPLES, 3), low.dtype, low[None], high[None])
            self._samples = Samples(tips=drawn, loss=jnp.full(N_SAMPLES, jnp.inf))
        self._samples = _large(simulator, situation, self._scales, low, high, key, self._samples)
        return truncated_step(self._samples, situation.tip, longest=STEP)


def _tip(estimator: Estimator) -> Float[np.ndarray, " 3"]:
    if estimator.tool is None:
        raise ValueError("the tool has not been seen yet: show the estimator an observation first.")
    return estimator.tool.position


def _covariance(estimator: Estimator) -> Float[np.ndarray, "n n"]:
    """Return the covariance of b [N^2/m^2]; for a bounded stiffness as if b were linear in it, with the slope at 0.

    The true slope grows without limit towards a weld, which would dominate the objective.
    """
    belief = estimator.belief
    return belief.covariance if belief.reference is None else belief.reference**2 * belief.covariance


@eqx.filter_jit
def _local(loss: Callable, simulator: XPBD, situation: Situation, scales: Scales) -> Float[Array, " 3"]:
    return local_step(loss(simulator, situation, scales), situation.tip, longest=STEP)


@eqx.filter_jit
def _large(
    simulator: XPBD,
    situation: Situation,
    scales: Scales,
    low: Float[Array, " 3"],
    high: Float[Array, " 3"],
    key: PRNGKeyArray,
    previous: Samples,
) -> Samples:
    return large_step(displacement_loss(simulator, situation, scales), low, high, key, previous)


PAPER: dict[str, Callable[..., Policy]] = {
    "sl-d": SampledController,
    "lg-d": partial(Local, displacement_loss),
    "lg-h": partial(Local, entropy_loss),
}
"""The paper's policies by name; each takes the limits and a seed."""
