"""A declared sheet with the effects that the declaration names: what close-loop found, as a model to estimate with."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jiggle_mj.errors import OptionError
from jiggle_mj.likely_name import did_you_mean
from jiggle_mj.observation import Declaration

from ..physics.energy import SheetEnergy
from ..physics.mesh import SheetMesh
from . import LIBRARY
from .effect import Effect, with_effects
from .sheet_model import FrameContext, SheetModel, View, centred, nominal_energy

PARTS = ("energy", "tool", "view", "force_factor")
"""Parts of a model that an effect may change."""
PROBE_STRETCH = 1.5
"""Factor by which the sheet is larger than at rest in the frame that shows what an effect changes: beyond every limit
from which on something yields."""
PROBE_TIMES = (1e6, 1e6 + 0.2, 1e6 + 0.3)
"""Times of the tool's reports in that frame, the last one its own [s]: later than any drift begins."""
PROBE_DISPLACEMENTS = (0.0, 0.03, 0.1)
"""Displacement along `PROBE_DIRECTION` that these report [m]."""
PROBE_DIRECTION = (0.31, -0.55, 0.77)
"""Direction of the tool in that frame, along no axis of a rotation that anybody would give."""


class CorrectedModel(eqx.Module):
    """The model of each frame of a declared sheet with its declared effects."""

    energy: SheetEnergy
    """Energy of the declared sheet without effects, with the terms that effects use."""
    view: View
    """View without effects."""
    theta: Float[Array, " p"]
    """Parameters of all effects, one effect after the other."""
    effects: tuple[Effect, ...] = eqx.field(static=True)
    """Declared effects, which act in this order."""

    @classmethod
    def build(cls, mesh: SheetMesh, declaration: Declaration) -> "CorrectedModel":
        """Return the model of a mesh.

        Raises:
            OptionError: an effect cannot be used, or has nothing to act on in this sheet.
        """
        declared = declared_effects(declaration)
        model = cls(
            energy=nominal_energy(mesh, declaration),
            view=centred(mesh),
            theta=jnp.concatenate([jnp.asarray(theta) for theta in declared.values()]),
            effects=tuple(effect for effect in LIBRARY if effect.name in declared),
        )
        for effect in model.effects:
            if declared[effect.name].any() and not any(model.changes(effect, part) for part in PARTS):
                raise OptionError(
                    f"Declaration.effects: {effect.name} has nothing to act on in this sheet; leave it out."
                )
        return model

    @eqx.filter_jit
    def model(self, context: FrameContext, tool: Float[Array, " 3"]) -> SheetModel:
        """Return the model of one frame; `tool` is the reported displacement [m]."""
        plain = SheetModel(energy=self.energy, tool=tool, view=self.view, time=context.time)
        return with_effects(plain, self.effects, self.theta, context)

    @property
    def at_rest(self) -> SheetEnergy:
        """Return the energy with the effects as they act on the sheet at rest."""
        return self.model(resting(self.energy.rest), jnp.zeros(3)).energy

    @property
    def force_factor(self) -> float:
        """Return the factor on all stiffnesses that the effects declare."""
        return float(self.model(resting(self.energy.rest), jnp.zeros(3)).force_factor)

    def that_change(self, part: str) -> list[str]:
        """Return the names of the effects that change one of the model's `PARTS`."""
        return [effect.name for effect in self.effects if self.changes(effect, part)]

    def changes(self, effect: Effect, part: str) -> bool:
        """Return whether one of the effects changes one of the model's `PARTS`, in a frame of a lift."""
        start = sum(one.size for one in self.effects[: self.effects.index(effect)])
        context = _probe(self.energy.rest)
        tool = context.reports[-1]
        plain = SheetModel(energy=self.energy, tool=tool, view=self.view, time=context.time)
        changed = effect.acts(plain, self.theta[start : start + effect.size], context)
        leaves = (jax.tree.leaves(getattr(model, part)) for model in (plain, changed))
        return any(not np.array_equal(a, b) for a, b in zip(*leaves, strict=True))


def declared_effects(declaration: Declaration) -> dict[str, Float[np.ndarray, " _p"]]:
    """Return all parameters of each declared effect, those of all sites, in the order in which the effects act.

    Raises:
        OptionError: there is no such effect or site, or its values are of another number or sign.
    """
    names = {effect.name: effect for effect in LIBRARY}
    found: dict[str, Float[np.ndarray, " _p"]] = {}
    for key, values in declaration.effects.items():
        name, _, site = key.partition(".")
        where, effect = f"Declaration.effects: {key}", names.get(name)
        if effect is None:
            raise OptionError(f"{where} is no effect of the library{did_you_mean(name, names)}")
        n = len(effect.prior_sd)
        if len(values) != n:
            units = ", ".join(unit or "1" for unit in effect.units)
            raise OptionError(f"{where} needs {n} values [{units}]; got {len(values)}.")
        if effect.non_negative and min(values) < 0:
            raise OptionError(f"{where} must not be negative; got {list(values)}.")
        if effect.hanging and not declaration.hangs:
            raise OptionError(f"{where} applies only to a sheet with weight and no bed under it; leave it out.")
        theta = found.setdefault(name, np.zeros(effect.size))
        theta.reshape(effect.sites, n)[_site(effect, site, where)] = values
    return {effect.name: found[effect.name] for effect in LIBRARY if effect.name in found}


def _site(effect: Effect, text: str, where: str) -> int:
    """Return the number of an effect's site.

    Raises:
        OptionError: there is no such site.
    """
    if effect.sites == 1 and not text:
        return 0
    if effect.sites == 1:
        raise OptionError(f"{where}: {effect.name} has no sites; write {effect.name}.")
    if text not in map(str, range(effect.sites)):
        raise OptionError(
            f"{where}: {effect.name} is at one of {effect.sites} sites; write {effect.name}.SITE with a number from 0 "
            f"to {effect.sites - 1}."
        )
    return int(text)


def resting(rest: Float[Array, "n 3"], time: float = 0.0) -> FrameContext:
    """Return the context of a sheet that lies at rest with open jaws, at a time [s]."""
    return _context(rest, rest, times=jnp.asarray([time]), displacements=jnp.zeros((1, 3)))


def _probe(rest: Float[Array, "n 3"]) -> FrameContext:
    """Return the context of a frame in which everything moves, so that each effect shows."""
    displacements = jnp.outer(jnp.asarray(PROBE_DISPLACEMENTS), jnp.asarray(PROBE_DIRECTION))
    moving = _context(rest, PROBE_STRETCH * rest, times=jnp.asarray(PROBE_TIMES), displacements=displacements)
    return eqx.tree_at(lambda context: context.before, moving, rest)


def _context(
    rest: Float[Array, "n 3"], x: Float[Array, "n 3"], *, times: Float[Array, " r"], displacements: Float[Array, "r 3"]
) -> FrameContext:
    """Return the context of a frame with the sheet at x [m], at the last of some reports of the tool."""
    gap = jnp.asarray(1.0)
    return FrameContext(
        rest=rest,
        time=times[-1],
        gap=gap,
        earlier_gap=gap,
        closed=times[-1] - times[0],
        now=x,
        before=x,
        earlier=x,
        report_times=times,
        reports=displacements,
        past=x[None],
        began=times[:1],
        ended=times[-1:],
    )
