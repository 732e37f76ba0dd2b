"""Collect a recording's frames with closed jaws, with the estimator's states and the noise."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jiggle_mj.camera import StereoCamera
from jiggle_mj.errors import PerceptionError
from jiggle_mj.estimate import Detection, Estimate
from jiggle_mj.observation import Declaration, MeasuredPoints, Observation, ToolReport

from ..config import EstimatorConfig
from ..estimator import Estimator
from ..filters.evidence import MeasuredPull
from ..force_sensor import ForceSensor
from ..perception import FrameMask, TissueMask
from ..perception.still_noise import StillNoise, measure
from .grasped_frames import ClosedFrame, Timed
from .held_shape import another_shape
from .tool_pull import frame_pulls

ASSUMED_SD = 2e-4
"""Standard deviation of the white noise, where neither still frames nor the recording give it [m]."""
ASSUMED_SHARE = 0.2
"""Standard deviation of the smooth noise that is new in each frame, over that of the white noise, where there are no
still frames. What neighbours share stays for the most part, as a drift. Of 0.2 and 1, the likelier on `skin_1013`."""
ASSUMED_LENGTH = 1.2e-2
"""Range of the smooth noise where there are no still frames [m]."""
ASSUMED_EXPONENT = 1.0
"""Exponent of its covariance, which has power at all shorter ranges too: how far a tracker errs alike is not known."""
MAX_RESTING_DISPLACEMENT = 1e-3
"""Reported displacement of the tool since the jaws closed up to which the sheet counts as still [m]."""
OPEN_ALONE = "the force of the tool was measured with open jaws alone, where nothing pulls."
"""Why forces are not used that no frame with closed jaws has."""
N_PARTS = 3
"""Parts into which a single grasp is divided; the last one chooses no effect."""


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """Everything that effects are fitted to."""

    estimator: Estimator
    """The estimator after the recording."""
    frames: list[Timed]
    """Frames with closed jaws, in the order of time."""
    noise: StillNoise
    """Noise of observed positions."""
    fields: Float[np.ndarray, "n modes"]
    """Fields of the noise's smooth part [m]; the frames' precisions hold the rest."""
    detection: Detection
    """Detection with the declared model alone."""
    left_out: tuple[int, ...]
    """Indices of excluded frames, in which what is held is observed in another shape than when the jaws closed."""
    force_doubt: str | None = None
    """Why the measured force of the tool is not used; None where it is, or none was measured."""

    @property
    def stiffness_factor(self) -> float:
        """Return the factor by which a measured force makes the filter's stiffnesses larger than the declared one."""
        check = self.estimator.force_check
        return 1.0 if check is None or check.stiffness_factor is None else check.stiffness_factor

    @property
    def parts(self) -> tuple[set[int], int | None]:
        """Return the parts that effects are chosen by, and the last one, which chooses none; None if it is the only."""
        parts = list(dict.fromkeys(timed.part for timed in self.frames))
        spare = parts[-1] if len(parts) > 1 else None
        return set(parts) - {spare}, spare


def collect_dataset(
    declaration: Declaration,
    camera: StereoCamera | None,
    observations: Iterable[Observation],
    *,
    config: EstimatorConfig | None = None,
    mask: TissueMask | FrameMask | None = None,
    on_frame: Callable[[Observation, Estimate | None], None] = lambda observation, found: None,
) -> Dataset:
    """Run the estimator over a recording and return its frames with closed jaws.

    Args:
        declaration: of the sheet.
        camera: None for tracked points.
        observations: all of the recording.
        mask: see `Estimator`.
        config: of the estimator; its refinement is set to "end".
        on_frame: called after each frame.

    Raises:
        PerceptionError: no frame with closed jaws could be used.
    """
    config = replace(config or EstimatorConfig(), refinement="end")
    estimator, frames, noise = Estimator(declaration, camera, config=config, mask=mask), [], assumed(ASSUMED_SD)
    still: list[MeasuredPoints] = []
    resting: dict[int, list[MeasuredPoints]] = {}
    pulls, sensor, reported = list[MeasuredPull | None](), ForceSensor(), False
    grasp, closed = -1, 0
    for observation in observations:
        found = estimator.update(observation)
        pull, reported = sensor.look(observation), reported or observation.force is not None
        on_frame(observation, found)
        if observation.points is not None:
            noise = stated(observation.points)
        if found is None:
            if not frames and observation.points is not None:
                still.append(observation.points)
            continue
        if observation.tool.grasp != grasp:
            grasp, closed = observation.tool.grasp, observation.time
        frames.append(_timed(estimator, observation, found, closed=closed))
        pulls.append(pull)
        if observation.points is not None and np.linalg.norm(frames[-1].frame.displacement) < MAX_RESTING_DISPLACEMENT:
            resting.setdefault(grasp, []).append(observation.points)
    if not frames:
        raise PerceptionError("no frame with closed jaws could be used, so there is nothing to fit effects to.")
    estimator.release()
    doubt = _doubt(estimator, pulls) if reported else None
    if doubt is None:
        frames = [
            replace(one, frame=replace(one.frame, pull=pull))
            for one, pull in zip(frames, frame_pulls(pulls), strict=True)
        ]
    noise = _noise_of([still], estimator) or _noise_of(list(resting.values()), estimator) or noise
    measured = None if estimator.track_ids is None else estimator.track_ids >= 0
    fields, sd = noise.fields(estimator.sheet.rest, measured, every=noise.frames == 0)
    mistaken = another_shape(frames, sd, fields)
    stiffness = estimator.declaration.membrane_stiffness
    return Dataset(
        estimator=estimator,
        frames=_parted([_weighed(one, sd, fields, stiffness) for one in _without(frames, mistaken)]),
        noise=noise,
        fields=fields,
        detection=estimator.detection,
        left_out=tuple(frames[k].index for k in mistaken),
        force_doubt=doubt,
    )


def assumed(sd: float) -> StillNoise:
    """Return the noise assumed where there are too few still frames: the stated sd [m], and a share of smooth noise."""
    return StillNoise(sd=sd, smooth_sd=ASSUMED_SHARE * sd, length=ASSUMED_LENGTH, frames=0, exponent=ASSUMED_EXPONENT)


def stated(points: MeasuredPoints) -> StillNoise:
    """Return the noise that points state; where they state no smooth noise, a share of it is assumed."""
    if points.smooth_length is None:
        return assumed(points.sd)
    white = np.sqrt(points.sd**2 - points.smooth_sd**2)
    return StillNoise(sd=float(white), smooth_sd=points.smooth_sd, length=points.smooth_length, frames=0)


def _doubt(estimator: Estimator, pulls: list[MeasuredPull | None]) -> str | None:
    """Return why measured forces of frames with closed jaws are not used; None where they are."""
    check = estimator.force_check
    if check is not None:
        return check.why_not
    return OPEN_ALONE if all(pull is None for pull in pulls) else None


def _timed(estimator: Estimator, observation: Observation, found: Estimate, *, closed: int) -> Timed:
    hold = estimator.grip.hold
    assert hold is not None
    visible = np.all(np.isfinite(found.observed), axis=1)
    with jax.enable_x64(True):
        frame = ClosedFrame(
            y=jnp.asarray(np.nan_to_num(found.observed)),
            visible=jnp.asarray(visible),
            precision=jnp.zeros((len(visible), 3, 3)),
            held=jnp.asarray(hold.held),
            force_unknown=jnp.asarray(estimator.force_unknown(hold.held)),
            rotated=jnp.asarray(hold.rotated(observation.tool)),
            displacement=jnp.asarray(observation.tool.position - hold.tip),
            by_points=jnp.asarray(observation.tool.by_points),
            held_sd=jnp.zeros(()),
        )
    return Timed(
        frame=frame,
        index=found.index,
        grasp=observation.tool.grasp,
        part=observation.tool.grasp,
        time=(found.time - estimator.rest_time) / 1e9,
        closed=(found.time - closed) / 1e9,
        state=found.positions,
        reports=tuple(
            ((report.time - estimator.rest_time) / 1e9, report.position - hold.tip)
            for report in (*observation.reports, ToolReport(time=observation.time, position=observation.tool.position))
            if report.time >= closed
        ),
    )


def _weighed(one: Timed, sd: float, fields: Float[np.ndarray, "n modes"], stiffness: float) -> Timed:
    """Return a frame with the precision of its particles, of the mean of what is held, and of its force, under noise.

    Where the jaws closed on each particle is known up to its noise, which strains the sheet around the grip in all
    frames of a grasp. So the predicted force has an offset of about that noise times the membrane stiffness [N/m].
    """
    held = np.asarray(one.frame.held & one.frame.visible)
    shared = np.sum(fields[held].mean(axis=0) ** 2) + sd**2 / held.sum() if held.any() else 0.0
    with jax.enable_x64(True):
        precision = jnp.where(one.frame.visible[:, None, None], jnp.eye(3)[None] / sd**2, 0.0)
        pull = one.frame.pull
        if pull is not None:
            pull = replace(pull, offset_sd=jnp.hypot(pull.offset_sd, stiffness * sd))
        return replace(
            one, frame=replace(one.frame, precision=precision, held_sd=jnp.asarray(np.sqrt(shared)), pull=pull)
        )


def _without(frames: list[Timed], mistaken: list[int]) -> list[Timed]:
    """Return all but some frames; their reports of the tool go to the next frame of the same grasp."""
    kept: list[Timed] = []
    reports: tuple[tuple[float, Float[np.ndarray, " 3"]], ...] = ()
    for k, one in enumerate(frames):
        reports = (reports if k and one.grasp == frames[k - 1].grasp else ()) + one.reports
        if k not in mistaken:
            kept.append(replace(one, reports=reports))
            reports = ()
    return kept


def _parted(frames: list[Timed]) -> list[Timed]:
    """Return a single grasp divided into `N_PARTS` in the order of time, if it is long enough."""
    if len({one.grasp for one in frames}) > 1 or len(frames) <= N_PARTS:
        return frames
    return [replace(one, part=1 + N_PARTS * k // len(frames)) for k, one in enumerate(frames)]


def _noise_of(series: list[list[MeasuredPoints]], estimator: Estimator) -> StillNoise | None:
    """Return the noise from tracked points in series of frames without motion; None without tracks or frames."""
    ids = estimator.track_ids
    if ids is None:
        return None
    return measure([_by_particle(still, ids) for still in series], estimator.sheet.rest)


def _by_particle(still: list[MeasuredPoints], ids: Int[np.ndarray, " n"]) -> Float[np.ndarray, "frames n 3"]:
    positions = np.full((len(still), len(ids), 3), np.nan)
    for row, points in zip(positions, still, strict=True):
        assert points.track_id is not None
        place = {int(track): k for k, track in enumerate(points.track_id)}
        known = [k for k, track in enumerate(ids) if int(track) in place]
        row[known] = points.positions[[place[int(ids[k])] for k in known]]
    return positions
