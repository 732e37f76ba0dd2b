"""Definition of an effect: a small addition to the sheet's model, with parameters that are 0 where it is absent.

To add an effect to the library:

1. Choose the file: `mechanical.py` if it depends on the current shape alone, `history_dependent.py` if it depends on
   earlier shapes, `yielding.py` if it stays once a limit is passed, `foundation.py` if it is of what is under the
   sheet, `sensing.py` if it is of the tool, the camera or the tracker.
2. Write a function `acts(model, theta, context)` that returns a changed `SheetModel`. `theta` are the parameters, and
   `context` holds what may be known of the frame. Change an existing term of the energy with `model.term(Kind)`,
   `equinox.tree_at` and `model.with_term`; or `model.tool` (the tool's displacement), `model.view` (how positions are
   observed), `model.energy.rest` (the anchors). Keep all shapes and types. It must be differentiable, and change
   nothing at theta = 0.
3. Only if no term of the energy can express it, add one to `terms.py`, with zero energy by default, and to
   `sheet_model.nominal_energy`.
4. Add an `Effect` with this function to the tuple at the end of the file. Say where the scale of `prior_sd` comes from.
   List in `confounded_with` the effects that look similar, and add the new one to their lists.
5. Add its row to docs/EFFECTS.md. tests/estimator/effects/test_effects.py then checks the value at 0 and the
   derivatives of every effect in the library. Add a test against a closed form there.

A user can add an effect without touching the library: pass `(*LIBRARY, mine)` to `close_loop`. It is checked by
`attribution.user_effects.check_effects` before any fit.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from jaxtyping import Array, Float

from .sheet_model import FrameContext, SheetModel

Acts = Callable[[SheetModel, Float[Array, " p"], FrameContext], SheetModel]
"""Function that returns one frame's model with the effect in it, from the model without, the parameters and the frame's
context; differentiable."""


@dataclass(frozen=True, kw_only=True)
class Effect:
    """One addition to the model.

    Raises:
        ValueError: the name, the units, the prior or an initial guess is not valid.
    """

    name: str
    """Name in reports and files: ASCII letters, digits and underscores."""
    acts: Acts
    """Function that adds the effect to a frame's model."""
    units: tuple[str, ...]
    """Unit of each parameter, "" for a pure number."""
    prior_sd: tuple[float, ...]
    """Prior standard deviation of each parameter, in its unit; the prior mean is 0."""
    sites: int = 1
    """Number of places, directions or scales that the effect may have; it has one of them. `acts` takes the parameters
    of all sites, one site after the other."""
    site_prior_sd: tuple[tuple[float, ...], ...] = ()
    """Prior standard deviations at each site where they differ; then `prior_sd` are those at the first."""
    initial_guesses: tuple[tuple[float, ...], ...] = ()
    """Parameters from which a fit may start as well, for an effect whose derivatives at 0 show little of it."""
    source: str
    """Where the scale of the prior comes from."""
    confounded_with: tuple[str, ...] = ()
    """Effects that often look like it; "attachments" if those do."""
    non_negative: bool = False
    """Whether negative parameters are excluded."""
    history_dependent: bool = False
    """Whether it depends on the frame's own state through `FrameContext.past` or `now`. Such a frame is predicted
    repeatedly until its state converges."""
    hanging: bool = False
    """Whether it applies only to a sheet with weight and no bed under it."""
    sensing: bool = False
    """Whether it is of the tool, the camera or the tracker; its size then holds for one session alone."""
    needs_force: bool = False
    """Whether it shows in a measured force of the tool alone."""
    needs_later_reports: bool = False
    """Whether it needs what the tool reports after the frame, which an estimate does not have yet."""

    def __post_init__(self) -> None:
        """Check what a user may have given."""
        if not (self.name.isascii() and self.name.replace("_", "").isalnum()):
            raise ValueError(f"Effect.name must be of ASCII letters, digits and underscores; got {self.name!r}.")
        if len(self.units) != len(self.prior_sd) or not self.prior_sd:
            raise ValueError(
                f"Effect {self.name}: units and prior_sd need one entry for each parameter; got {len(self.units)} and "
                f"{len(self.prior_sd)}."
            )
        if any(len(guess) != len(self.prior_sd) for guess in self.initial_guesses):
            raise ValueError(
                f"Effect {self.name}: each of initial_guesses needs {len(self.prior_sd)} parameters; got "
                f"{self.initial_guesses}."
            )
        if not all(sd > 0 for sd in self.prior_sd):
            raise ValueError(f"Effect {self.name}: prior_sd must be above 0; got {self.prior_sd}.")
        if self.site_prior_sd and (
            len(self.site_prior_sd) != self.sites
            or self.site_prior_sd[0] != self.prior_sd
            or any(len(sd) != len(self.prior_sd) or min(sd) <= 0 for sd in self.site_prior_sd)
        ):
            raise ValueError(
                f"Effect {self.name}: site_prior_sd needs {len(self.prior_sd)} numbers above 0 for each of "
                f"{self.sites} sites, first those of prior_sd; got {self.site_prior_sd}."
            )

    @property
    def size(self) -> int:
        """Return the number of parameters, those of all sites together."""
        return self.sites * len(self.prior_sd)

    @property
    def prior_sds(self) -> tuple[tuple[float, ...], ...]:
        """Return the prior standard deviations of the parameters at each site."""
        return self.site_prior_sd or (self.prior_sd,) * self.sites


def with_effects(
    model: SheetModel, effects: Iterable[Effect], theta: Float[Array, " p"], context: FrameContext
) -> SheetModel:
    """Return the model after all effects have acted on it in turn; theta holds their parameters one after the other."""
    start = 0
    for effect in effects:
        model = effect.acts(model, theta[start : start + effect.size], context)
        start += effect.size
    return model
