"""The problem that effects are fitted to: the sheet, its frames, the noise, and the priors."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from ..belief.attachment_belief import AttachmentBelief
from ..belief.prior import prior_belief
from ..effects import LIBRARY
from ..effects.corrected_model import declared_effects
from ..effects.effect import Effect
from ..effects.force_scale import FORCE_SCALE
from ..effects.frame_history import FrameHistory
from ..effects.sheet_model import centred, nominal_energy
from ..filter_builder import force_balance
from ..physics.mesh import SheetMesh
from .dataset import Dataset
from .grasped_frames import Timed
from .noise_scales import NoiseScales
from .persistence import Persistence
from .sheet import PredictedSheet

NUISANCE = {
    "stretch": (0.05,),
    "bending": (0.3,),
    "friction": (0.05,),
    "material_damping": (0.03,),
    "image_latency": (0.02,),
    "surface_height": (5e-4,),
    "force_scale": (0.05,),
}
"""Nuisance parameters, which may differ a little from 0 in any sheet: prior standard deviations in the effects'
units."""
FORCE_VARIANCE = 0.012
"""Share of the filter's force variance that remains once smooth force fields hold what is the same in all frames of a
grasp. Measured: the likeliest on recordings of the reference with nothing undeclared."""
AMPLITUDE = 0.365
"""Assumed sd of the smooth force fields [assumed force errors]; the likeliest on the same recordings."""
SHEET_STRENGTH = 1e9
"""Attached neighbours that the whole sheet is worth [particles]; see `PriorConfig.sheet_strength`. Here all attachments
resemble each other, as they did when the limits of the decisions were chosen."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Everything that a fit needs besides its start."""

    sheet: PredictedSheet
    """Sheet with all effects of the library."""
    history: FrameHistory[Timed]
    """All frames."""
    prior: AttachmentBelief
    """Prior of the attachments."""
    assumed_noise: Float[np.ndarray, "n modes"]
    """Fields of the smooth noise of observed positions, of the assumed size [m]."""
    prior_sd: Float[np.ndarray, " p"]
    """Prior standard deviations of all the library's parameters as effects."""
    own: np.ndarray
    """Nuisance parameters, which are free in all fits."""
    own_sd: Float[np.ndarray, " own"]
    """Prior standard deviations of the nuisance parameters."""
    force_sd: Float[Array, ""]
    """Assumed tau of the force errors where forces of `force_level` meet; see `ForceBalance` [N]."""
    scales: NoiseScales = field(default_factory=NoiseScales)
    """Sizes of the errors."""

    @property
    def assumed_scales(self) -> NoiseScales:
        """Return the sizes of the errors as they are assumed."""
        pull, noise = (None if one is None else 1.0 for one in (self.scales.pull, self.scales.noise))
        return NoiseScales(pull=pull, noise=noise)

    def with_force(self, frames: Iterable[int]) -> int:
        """Return the number of some frames in which the force of the tool was measured."""
        pulls = (self.history.frames[k].frame.pull for k in frames)
        return sum(pull is not None and float(pull.weight) > 0 for pull in pulls)

    @property
    def amplitude(self) -> float:
        """Return the standard deviation of the smooth force fields [force errors]."""
        return AMPLITUDE * (self.scales.fields / self.scales.force) ** 0.5

    @property
    def noise(self) -> Float[np.ndarray, "n modes"]:
        """Return the fields of the smooth noise of observed positions [m]."""
        return self.assumed_noise * self.scales.smooth**0.5

    def earlier(self, k: int, frames: Iterable[int]) -> list[int]:
        """Return those of some frames that are before frame k in its grasp, the last one first."""
        grasp = self.history.frames[k].grasp
        return sorted((j for j in frames if j < k and self.history.frames[j].grasp == grasp), reverse=True)

    def last_seen(self, k: int, frames: Iterable[int]) -> Int[np.ndarray, " n"]:
        """Return the last of some frames before frame k in its grasp that observed each particle; -1 if none did.

        For particles that frame k does not observe itself, it is the last of those frames.
        """
        timed, earlier = self.history.frames, self.earlier(k, frames)
        last = np.where(timed[k].counted, -1, earlier[0] if earlier else -1)
        for j in earlier:
            last = np.where((last < 0) & timed[j].counted, j, last)
            if (last >= 0).all():
                break
        return last

    def frames_since(self, k: int, last: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
        """Return the number of frames of the recording from others to frame k; from rest, its begin, for -1."""
        index = np.append([one.index for one in self.history.frames], 0)
        return np.maximum(index[k] - index[last], 1)

    def steps(self, k: int, frames: Iterable[int]) -> tuple[int, ...]:
        """Return the steps from one frame of a grasp to the next, from the last of some frames before k, or rest, to k.

        Each is a number of frames of the recording.
        """
        timed, earlier = self.history.frames, self.earlier(k, frames)
        if earlier:
            return (1,) * (timed[k].index - timed[earlier[0]].index)
        first = min(one.index for one in timed if one.grasp == timed[k].grasp)
        return (max(first, 1),) + (1,) * (timed[k].index - max(first, 1))

    def persistence(self, k: int, frames: Iterable[int]) -> Persistence:
        """Return how the errors of frame k follow those of some frames before it."""
        frames = list(frames)
        since = self.frames_since(k, self.last_seen(k, frames))
        return Persistence.of(self.scales.autocorrelation, self.scales.noise or 1.0, since, self.steps(k, frames))

    @classmethod
    def build(cls, dataset: Dataset, library: tuple[Effect, ...]) -> "Problem":
        """Return the problem for a recording and the effects that the model may lack; declared ones are among them."""
        estimator = dataset.estimator
        mesh = SheetMesh(estimator.sheet.rest, estimator.sheet.faces)
        energy, config = nominal_energy(mesh, estimator.declaration), estimator.config
        balance = force_balance(mesh, energy, estimator.declaration, config).inflated(FORCE_VARIANCE)
        declared, names = declared_effects(estimator.declaration), {effect.name for effect in library}
        forced = dataset.frames[0].frame.pull is not None
        needed = declared.keys() | {effect.name for effect in FORCE_SCALE}
        library = (*library, *(effect for effect in LIBRARY if effect.name in needed - names))
        library = tuple(effect for effect in library if estimator.declaration.hangs or not effect.hanging)
        library = tuple(effect for effect in library if forced or not effect.needs_force)
        declared = {one.name: declared[one.name] for one in library if one.name in declared}
        sheet = PredictedSheet(balance=balance, view=centred(mesh), library=library, declared=declared)
        alike = replace(config.prior, sheet_strength=SHEET_STRENGTH)
        own = {name: sd for name, sd in NUISANCE.items() if any(effect.name == name for effect in library)}
        return cls(
            sheet=sheet,
            history=FrameHistory(dataset.frames, mesh.rest),
            prior=prior_belief(mesh, reference=float(balance.reference), config=alike, belief=config.belief),
            assumed_noise=dataset.fields,
            prior_sd=np.concatenate([np.ravel(effect.prior_sds) for effect in library]),
            own=np.concatenate([[], *(sheet.place(name) for name in own)]).astype(int),
            own_sd=np.concatenate([[], *(np.asarray(sd) for sd in own.values())]),
            force_sd=balance.force_sd,
            scales=NoiseScales(pull=1.0 if forced else None, noise=None if dataset.noise.frames else 1.0),
        )

    def with_scales(self, scales: NoiseScales) -> "Problem":
        """Return the problem with other sizes of the errors."""
        sd = self.force_sd * scales.force**0.5
        return replace(self, sheet=eqx.tree_at(lambda one: one.balance.force_sd, self.sheet, sd), scales=scales)

    def with_frames(self, frames: list[Timed]) -> "Problem":
        """Return the problem with other frames."""
        return replace(self, history=FrameHistory(frames, np.asarray(self.history.rest)))

    def frames(self, parts: Iterable[int]) -> list[int]:
        """Return the frames of some parts."""
        return [k for k, one in enumerate(self.history.frames) if one.part in set(parts)]

    def up_to(self, frames: Iterable[int]) -> list[int]:
        """Return some frames and those before them in their grasps, on which they may depend."""
        last = {grasp: max(those) for grasp, those in self.history.by(lambda one: one.grasp, frames).items()}
        return [k for k, one in enumerate(self.history.frames) if k <= last.get(one.grasp, -1)]

    def by_part(self, frames: Iterable[int]) -> dict[int, list[int]]:
        """Return frames grouped by part."""
        return self.history.by(lambda one: one.part, frames)

    def by_grasp(self, frames: Iterable[int]) -> dict[int, list[int]]:
        """Return frames grouped by grasp."""
        return self.history.by(lambda one: one.grasp, frames)

    def free(self, named: np.ndarray) -> np.ndarray:
        """Return the indices of named parameters, then of the other nuisance parameters."""
        return np.concatenate([named, [k for k in self.own if k not in named]]).astype(int)

    def sd(self, named: np.ndarray) -> Float[np.ndarray, " free"]:
        """Return the prior standard deviations of the parameters `free(named)`."""
        narrow = [sd for k, sd in zip(self.own, self.own_sd, strict=True) if k not in named]
        return np.concatenate([self.prior_sd[named], narrow])

    def lower_bounds(self, free: np.ndarray) -> Float[np.ndarray, " free"]:
        """Return the lower bound of each parameter, below 0 by what is declared."""
        lowest = np.concatenate([np.full(one.size, 0.0 if one.non_negative else -np.inf) for one in self.sheet.library])
        for name, declared in self.sheet.declared.items():
            lowest[self.sheet.place(name)] -= np.asarray(declared)
        return lowest[free]

    def bounded(
        self, free: np.ndarray, values: Float[np.ndarray, " free"], largest: Float[np.ndarray, " free"]
    ) -> Float[np.ndarray, " free"]:
        """Return values of parameters, none below its lower bound or of a size above `largest`."""
        return np.clip(values, np.maximum(self.lower_bounds(free), -largest), largest)


@dataclass(frozen=True, kw_only=True)
class Point:
    """Parameters of a fit with the predicted states."""

    theta: Float[np.ndarray, " p"]
    """All parameters of the library."""
    s: Float[np.ndarray, " n"]
    """Bounded stiffnesses."""
    states: Float[np.ndarray, "frames n 3"]
    """Predicted states [m]."""
    seen: Float[np.ndarray, "frames n 3"]
    """Predicted observations [m]; NaN in frames that were not predicted."""
