"""What a loop is closed over: the sheet, its frames, the noise, and what is believed beforehand."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..belief.attachment_belief import AttachmentBelief
from ..belief.prior import prior_belief
from ..effects.effect import Effect
from ..effects.sheet_model import centred, nominal_energy
from ..filters.build import force_balance
from ..physics.mesh import SheetMesh
from .closed_frames import FrameHistory
from .dataset import Dataset
from .sheet import PredictedSheet

NUISANCE = {
    "stretch": (0.05,),
    "bending": (0.3,),
    "friction": (0.05,),
    "material_damping": (0.03,),
    "image_latency": (0.02,),
    "surface_height": (5e-4,),
}
"""What may be a little off in any sheet, and is no effect: standard deviations in the effects' units."""
FORCE_VARIANCE = 0.04
"""Share of the filter's force variance that is left when what is the same in all frames of a grasp goes to smooth force
fields: the likeliest on recordings of the reference with nothing undeclared in them."""
AMPLITUDE = 0.2
"""Of those fields, in units of the force error; the likeliest on the same."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """What is fitted to."""

    sheet: PredictedSheet
    history: FrameHistory
    prior: AttachmentBelief
    noise: Float[np.ndarray, "n modes"]
    """Smooth fields of what is seen [m]."""
    prior_sd: Float[np.ndarray, " p"]
    """Of all the library's parameters, where they are an effect's."""
    own: np.ndarray
    """Parameters that are free in any case."""
    own_sd: Float[np.ndarray, " own"]
    amplitude: float = AMPLITUDE

    @classmethod
    def build(cls, dataset: Dataset, library: tuple[Effect, ...]) -> "Problem":
        """For a recording and what the model may lack."""
        estimator = dataset.estimator
        mesh = SheetMesh(estimator.sheet.rest, estimator.sheet.faces)
        energy = nominal_energy(mesh, estimator.declaration)
        balance = force_balance(mesh, energy, estimator.declaration, estimator.config).inflated(FORCE_VARIANCE)
        library = tuple(effect for effect in library if estimator.declaration.hangs or not effect.hanging)
        sheet = PredictedSheet(balance=balance, view=centred(mesh), library=library)
        own = {name: sd for name, sd in NUISANCE.items() if any(effect.name == name for effect in library)}
        return cls(
            sheet=sheet,
            history=FrameHistory(dataset.frames, mesh.rest),
            prior=prior_belief(mesh, reference=float(balance.reference)),
            noise=dataset.fields,
            prior_sd=np.concatenate([np.tile(effect.prior_sd, effect.sites) for effect in library]),
            own=np.concatenate([[], *(sheet.place(name) for name in own)]).astype(int),
            own_sd=np.concatenate([[], *(np.asarray(sd) for sd in own.values())]),
        )

    def widened(self, variance: float, amplitude: float) -> "Problem":
        """With that many times the variance of the forces, and smooth fields of another amplitude."""
        sheet = eqx.tree_at(lambda one: one.balance, self.sheet, self.sheet.balance.inflated(variance))
        return replace(self, sheet=sheet, amplitude=amplitude)

    def frames(self, parts: Iterable[int]) -> list[int]:
        """Frames of some parts."""
        return [k for k, one in enumerate(self.history.frames) if one.part in set(parts)]

    def by_part(self, frames: Iterable[int]) -> dict[int, list[int]]:
        """Frames sorted by part."""
        return self.history.by(lambda one: one.part, frames)

    def free(self, named: np.ndarray) -> np.ndarray:
        """Named parameters, and the sheet's own."""
        return np.concatenate([named, [k for k in self.own if k not in named]]).astype(int)

    def sd(self, named: np.ndarray) -> Float[np.ndarray, " free"]:
        """Prior standard deviations of `free`."""
        narrow = [sd for k, sd in zip(self.own, self.own_sd, strict=True) if k not in named]
        return np.concatenate([self.prior_sd[named], narrow])

    def least(self, free: np.ndarray) -> Float[np.ndarray, " free"]:
        """The least that each may be."""
        lowest = [np.full(one.size, 0.0 if one.non_negative else -np.inf) for one in self.sheet.library]
        return np.concatenate(lowest)[free]


@dataclass(frozen=True, kw_only=True)
class Point:
    """Where a fit is."""

    theta: Float[np.ndarray, " p"]
    s: Float[np.ndarray, " n"]
    """Bounded stiffnesses."""
    states: Float[np.ndarray, "frames n 3"]
    """As predicted [m]."""
    seen: Float[np.ndarray, "frames n 3"]
    """The same as the camera shows it; NaN in frames that were not predicted."""
