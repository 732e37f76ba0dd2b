"""The interface of all filters: rules of update without state, over a state that they take and give back."""

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jiggle_mj.actions import Cut, Suture
from jiggle_mj.options import FilterName

from ..belief.attachment_belief import AttachmentBelief
from ..belief.gaussian_belief import GaussianBelief
from ..belief.topology import Change, meant_by
from ..physics.energy import SheetEnergy
from .evidence import Evidence
from .force_balance import ForceBalance
from .force_fit import ForceFit
from .noise import Noise
from .posterior_summary import PosteriorSummary, Update, prior_summary

Region = Bool[np.ndarray, " n"]


class FilterState(eqx.Module):
    """All that a filter keeps from frame to frame: a pytree, never changed in place."""

    summary: PosteriorSummary
    """The latest finite posterior."""
    release_convergence: Int[Array, ""]
    """Code of the `Convergence` of the last refinement at a release or identification."""
    changes: tuple[Change, ...]
    """Cuts and sutures so far, of filters that compare whether they worked."""
    key: PRNGKeyArray
    """Source of all draws. It is used as it is and never advanced, so that the same frames give the same answer however
    often samples are drawn in between."""


State = TypeVar("State", bound=FilterState)


class Filter(eqx.Module, Generic[State]):
    """A rule of update for one sheet."""

    @property
    @abstractmethod
    def name(self) -> FilterName:
        """What the settings call the filter."""

    @property
    def matches_clouds(self) -> bool:
        """Whether the filter matches a cloud without identities to its own state, or needs positions."""
        return False

    @abstractmethod
    def init(self, key: PRNGKeyArray) -> State:
        """Return the state before the first frame.

        Args:
            key: source of all draws.
        """

    @abstractmethod
    def update(self, state: State, evidence: Evidence, start: Float[Array, "n 3"]) -> tuple[State, Update]:
        """Take one frame into the state.

        Args:
            state: after the frames before.
            evidence: what was measured.
            start: where a search for the particles' positions may begin [m].

        Returns:
            The state and the outcome. If no finite positions and stiffnesses explain the frame, the state is as if the
            frame had not been there, and `Update.explains_the_frame` is False.
        """

    @abstractmethod
    def change(self, state: State, event: Cut | Suture, *, region: Region, index: int) -> State:
        """Take a cut or suture into the state: what was seen of its region before is no evidence any more.

        Args:
            state: after the frames before, released.
            event: what was done.
            region: particles that it was meant for.
            index: of the first observation after it.
        """

    def noise(self, state: State) -> Noise | None:
        """Return the factors on the assumed noise variances; None where they are not learned."""
        return None

    def resample(self, state: State) -> State:
        """Redraw the belief by a few samples between two frames; unchanged by a filter that does not sample."""
        return state

    def release(self, state: State, *, thorough: bool = True) -> tuple[State, PosteriorSummary | None]:
        """Take note that the jaws have opened.

        Args:
            state: after the last frame of the grasp.
            thorough: whether to learn the noise and draw many samples, which takes seconds.

        Returns:
            The state, and the posterior after all grasps together; None where the release changes nothing. A posterior
            that is not finite is returned, but the state keeps the one before.
        """
        return state, None

    def force(self, state: State) -> ForceFit | None:
        """Return the measured forces of the tool beside the predicted ones; None where none is measured or used."""
        return None

    def by_forces(self, purpose: str) -> "ForceBalanceFilter[Any]":
        """Return this filter as one that linearises the balance of forces.

        Args:
            purpose: what is asked of it, such as "predicts pulls", for the message.

        Raises:
            ValueError: it is none.
        """
        raise ValueError(f"only the filter 'implicit' {purpose}; this one is {self.name!r}.")


class ForceBalanceFilter(Filter[State]):
    """A filter over bounded stiffnesses that linearises the balance of forces, and keeps the frames to do it again."""

    @property
    def matches_clouds(self) -> bool:
        """Whether the filter matches a cloud without identities to its own state."""
        return True

    @abstractmethod
    def balance(self, state: State) -> ForceBalance:
        """Return the balance of forces, with the learned noise."""

    @abstractmethod
    def belief(self, state: State) -> AttachmentBelief:
        """Return the latest belief over the attachments."""

    @abstractmethod
    def shared_noise(self, state: State) -> Noise:
        """Return further factors on the variances, for what the frames of all grasps estimate together."""

    @abstractmethod
    def frames(self, state: State) -> Iterator[tuple[Evidence, Float[Array, "n 3"]]]:
        """Yield the evidence, with the learned noise, and the positions [m] of every frame since the last change."""

    @abstractmethod
    def refit(self, state: State, energy: SheetEnergy) -> tuple[State, PosteriorSummary]:
        """Linearise all frames since the last change again with another energy of the sheet; learn the noise anew."""

    @abstractmethod
    def log_bayes_factor(self, state: State, change: Change) -> float | None:
        """Return the log Bayes factor of 'the change worked' against 'nothing changed' [nat].

        From the frames after this change and before the next; None if there is none.
        """

    def by_forces(self, purpose: str) -> "ForceBalanceFilter[Any]":
        """Return this filter, which linearises the balance of forces."""
        return self


class GaussianFilter(Filter[State]):
    """A filter with a Gaussian belief over the stiffnesses themselves."""

    prior: GaussianBelief
    """Belief before the first frame."""
    prior_sd: float
    """Standard deviation of each stiffness before the first frame [N/m]; also the least after a cut or suture."""

    def init_summary(self) -> PosteriorSummary:
        """Return the posterior before the first frame."""
        return prior_summary(self.prior, len(self.prior.shift))

    def change(self, state: State, event: Cut | Suture, *, region: Region, index: int) -> State:
        """See `Filter.change`: the paper's prediction step, b + delta_b with noise of covariance W in the region.

        The mean moves to the intended stiffness, and the standard deviation is that stiffness or the prior's, whichever
        is larger.
        """
        belief = state.summary.belief
        assert isinstance(belief, GaussianBelief)
        intended = meant_by(event)
        shift = jnp.where(region, intended - belief.mean(), 0.0)
        sd = max(self.prior_sd, intended)
        belief = belief.predict(shift, jnp.where(region, sd**2, 0.0))
        summary = replace(state.summary, belief=belief, b=belief.non_negative_mean())
        return self.forget(replace(state, summary=summary))

    def forget(self, state: State) -> State:
        """Return the state without the frames kept for later updates; most filters keep none."""
        return state
