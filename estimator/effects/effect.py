"""What an effect is: a small addition to the sheet's model, with a few parameters that are 0 where it is absent."""

from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Array, Float

from .sheet_model import FrameContext, SheetModel

Acts = Callable[[SheetModel, Float[Array, " p"], FrameContext], SheetModel]
"""The model of one frame with the effect in it, for parameters and what may be known of the frame; differentiable."""


@dataclass(frozen=True, kw_only=True)
class Effect:
    """One addition to the model.

    Raises:
        ValueError: a name, unit or prior that is none.
    """

    name: str
    acts: Acts
    units: tuple[str, ...]
    """Of each parameter, "" for a pure number."""
    prior_sd: tuple[float, ...]
    """Standard deviation of each parameter before anything is seen, in its unit."""
    sites: int = 1
    """At how many places, or in how many directions, it may be, at one of them alone; `acts` takes the parameters of
    all of them, one site after the other."""
    initial_guesses: tuple[tuple[float, ...], ...] = ()
    """Parameters from which a fit may begin, for an effect that shows little of itself in its derivatives at 0."""
    source: str
    """Where the prior's scale comes from."""
    confounded_with: tuple[str, ...] = ()
    """Effects that often look like it, and attachments that do."""
    non_negative: bool = False
    """Whether parameters below 0 make no sense."""
    history_dependent: bool = False
    """Whether it depends on where the sheet is in the frame itself (`FrameContext.past`): predicted until it stays."""
    hanging: bool = False
    """Whether only a sheet with weight and no bed under it may have it."""
    sensing: bool = False
    """Whether it is of the tool, the camera or the tracker, so that it holds for one session alone."""

    def __post_init__(self) -> None:
        """Check what a user may have typed."""
        if not self.name.replace("_", "").isalnum():
            raise ValueError(f"Effect.name must be of letters, digits and underscores; got {self.name!r}.")
        if len(self.units) != len(self.prior_sd) or not self.prior_sd:
            raise ValueError(
                f"Effect {self.name}: units and prior_sd need one entry for each parameter; got {len(self.units)} and "
                f"{len(self.prior_sd)}."
            )
        if any(len(one) != len(self.prior_sd) for one in self.initial_guesses):
            raise ValueError(
                f"Effect {self.name}: each of initial_guesses needs {len(self.prior_sd)} parameters; got "
                f"{self.initial_guesses}."
            )
        if not all(sd > 0 for sd in self.prior_sd):
            raise ValueError(f"Effect {self.name}: prior_sd must be above 0; got {self.prior_sd}.")

    @property
    def size(self) -> int:
        """How many parameters there are at all sites."""
        return self.sites * len(self.prior_sd)
