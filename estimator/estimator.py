"""The estimator: observations in, estimates out.

While the sheet lies still before the first grasp, frames only fix its rest shape. Every frame with closed jaws then
goes through perception, grip, fusion and filter. It sees nothing but observations, calibration and declaration.
"""

import time
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jiggle_mj.actions import Cut, Suture
from jiggle_mj.argument_checks import as_array, as_instance
from jiggle_mj.camera import StereoCamera
from jiggle_mj.errors import ObservationError, PerceptionError
from jiggle_mj.estimate import Belief, Detection, Estimate, ForceCheck, KeptFrames, PointNoise, Sheet
from jiggle_mj.material import Material, check_ratios
from jiggle_mj.observation import Declaration, Observation, ToolState

from . import summaries
from .belief.attachment_belief import AttachmentBelief
from .belief.topology import Change, region_of
from .blas import one_thread
from .config import EstimatorConfig
from .corrected_frames import refuse_unusable_effects
from .filters.force_balance import ForceBalance
from .filters.kept_frames import kept_frames
from .filters.posterior_summary import Convergence
from .force_sensor import ForceSensor
from .fusion import pull
from .grip import GripHold, GripTracker
from .identifying import OnPass, identify_tracked
from .perception import Disparity, FrameMask, Perception, SimulatorInput, TissueMask, Track
from .perception.cloud_tracker import matched
from .physics.environment import Grip
from .tracked_sheet import TrackedSheet

INITIAL_POINT_SD = 3e-4
"""Standard deviation of a seen coordinate until the first frame with closed jaws has shown it [m]."""


class Estimator:
    """Follows one tissue through one recording."""

    def __init__(
        self,
        declaration: Declaration,
        camera: StereoCamera | None = None,
        *,
        config: EstimatorConfig | None = None,
        mask: TissueMask | FrameMask | None = None,
        disparity: Disparity | None = None,
    ):
        """Take what is known before the first frame.

        Args:
            declaration: the tissue as the user declares it.
            camera: needed for observations with images.
            config: settings; the defaults are those that the figures of docs/RESULTS.md were made with.
            mask: which pixels are tissue; by colour if None.
            disparity: dense stereo; semi-global matching if None.

        Raises:
            OptionError: an argument is of another type.
        """
        self.declaration = as_instance(declaration, "declaration", Declaration, hint="Declaration() has defaults.")
        self.config = config = as_instance(EstimatorConfig() if config is None else config, "config", EstimatorConfig)
        refuse_unusable_effects(declaration, config)
        self.skipped: list[tuple[int, str]] = []
        """Index and reason of each observation that could not be used."""
        self.cloud_shares: list[float] = []
        """Share of the cloud's points that lie on the sheet, of each used frame with a cloud."""
        self._perception = Perception(
            declaration, camera, spacing=config.spacing, config=config.perception, mask=mask, disparity=disparity
        )
        self._tracked_or_none: TrackedSheet | None = None
        self._open_frame: Observation | None = None
        self._tool: ToolState | None = None
        self._seen_precision = np.eye(3) * INITIAL_POINT_SD**-2
        self._force, self._slip, self._has_estimate = ForceSensor(), 0.0, False
        self.grip, self._hold = GripTracker(), None
        """The grasp at hand, as it is observed and reported."""

    def update(self, observation: Observation) -> Estimate | None:
        """Take one observation; return None if it only helps to fix the rest shape, or cannot be used.

        Raises:
            ObservationError: this is no observation.
            PerceptionError: the sheet cannot be found in the first frames, or the first grasp is off the tissue. Once
                there is an estimate, a frame that cannot be used goes to `skipped` instead.
            MeshError: the sheet at rest is folded, or not one sheet.
        """
        as_instance(observation, "observation", Observation, hint="Iterate over a recording.", error=ObservationError)
        with jax.enable_x64(True), one_thread():
            try:
                estimate = self._update(observation)
            except PerceptionError as failure:
                if not self._has_estimate:
                    raise
                self.skipped.append((observation.index, str(failure)))
                return None
        self._has_estimate |= estimate is not None
        return estimate

    def _update(self, observation: Observation) -> Estimate | None:
        """Prepare the grasp of a frame, then run it through perception, grip, fusion and filter."""
        tool = self._tool = observation.tool
        force = self._force.look(observation)
        if self._tracked_or_none is None:
            if (passed_over := self._perception.look_at_rest(observation)) is not None:
                self.skipped.append((observation.index, passed_over))
            if not (tool.closed or observation.events):
                return None
            self.begin()
        for event in observation.events:
            self._change(event, observation.index)
        if not tool.closed:
            self._release()
            self.grip.release()
            self._open_frame = observation
            return None
        if self.grip.begins(tool):
            self._release()
            self.grip.closing = tool
        tracked, began = self._tracked, time.perf_counter()
        track = self._see(observation)
        seen = time.perf_counter()
        if track.cloud is None and not track.visible.any():
            self.skipped.append((observation.index, "no particle was seen"))
            return None
        hold, before = self._grasp(track, tool, observation.time)
        frame, state, update = tracked.update(observation, track, hold, before, force=force)
        if not update.explains_the_frame:
            raise PerceptionError(f"observation {observation.index} leaves no finite state: no sheet explains it.")
        if track.cloud is not None:
            track, share = matched(track.cloud, np.asarray(update.x), hold.held)
            self.cloud_shares.append(share)
        tracked.state, tracked.x = state, np.asarray(update.x)
        self.grip.hold, self._hold, self._slip = hold, frame.hold, frame.slip
        self._seen_precision = track.white_precision[track.visible].mean(axis=0)
        if self.config.refinement == "frames":
            tracked.state = tracked.filter.resample(tracked.state)
        return summaries.estimate(
            observation,
            tracked.state.summary,
            update,
            scale=tracked.stiffness_scale,
            rest=self.sheet.rest,
            observed=track.positions,
            held=hold.held,
            seconds=(time.perf_counter() - seen, seen - began),
        )

    def begin(self) -> Sheet:
        """Fix the sheet by the frames so far, before the jaws close, so that a first grasp can be planned.

        Raises:
            PerceptionError: no frame has shown the sheet.
            MeshError: the sheet at rest is folded, or not one sheet.
        """
        if self._tracked_or_none is None:
            if not self._perception.ready:
                raise PerceptionError("no frame has shown the sheet yet; wait for one before planning a grasp.")
            with jax.enable_x64(True), one_thread():
                self._tracked_or_none = TrackedSheet.seen_by(self._perception, self.declaration, self.config)
        return self.sheet

    def release(self) -> None:
        """Take note that the grasp is over: refine the belief with all grasps together.

        It happens by itself when the jaws open or a new grasp begins. It is needed only where observations end with
        closed jaws, or where the settings leave the refinement to the end.

        Raises:
            PerceptionError: no finite belief explains the frames together; the belief stays as it was.
        """
        self._release(at_the_end=True)

    def identify(self, parameters: Sequence[str] = (), *, on_pass: OnPass = lambda _: None) -> Material:
        """Return the sheet's own parameters from all frames so far; the belief becomes the one that goes with them.

        Args:
            parameters: some of 'weight' and 'bending'; the other stays as declared. Both if none is named.
            on_pass: called with each ratio's factor after each pass, for progress.

        Raises:
            ValueError: asked before `begin` and the first frame with closed jaws, or of another filter than 'implicit'.
            OptionError: the sheet has no such parameter; or effects are declared.
        """
        self._tracked.filter.by_forces("can identify the sheet")
        check_ratios(parameters)
        self.release()
        with jax.enable_x64(True), one_thread():
            return identify_tracked(self._tracked, self.declaration, parameters, on_pass=on_pass)

    @property
    def belief(self) -> Belief:
        """The belief so far; call `release` first once a grasp is over.

        Raises:
            ValueError: asked before `begin` and before the first frame with closed jaws.
        """
        with jax.enable_x64(True), one_thread():
            return summaries.belief(self._tracked.state.summary, self._tracked.stiffness_scale)

    @property
    def detection(self) -> Detection:
        """Which particles are called attached so far; see `belief`.

        Raises:
            ValueError: asked before `begin` and before the first frame with closed jaws.
        """
        tracked = self._tracked
        return summaries.detection(
            tracked.state.summary,
            self.declaration,
            self.config,
            scale=tracked.stiffness_scale,
            noise=tracked.filter.noise(tracked.state),
            refined=Convergence(int(tracked.state.release_convergence)),
        )

    @property
    def kept_frames(self) -> KeptFrames | None:
        """What `identify_kept` needs of the frames so far; None where it cannot be kept (`filters.kept_frames`)."""
        return kept_frames(self._tracked.state)

    @property
    def force_check(self) -> ForceCheck | None:
        """Measured and predicted force on the tool, as of the last release; None without a measured force."""
        return summaries.force_check(self._tracked.filter.force(self._tracked.state), self._tracked.stiffness_scale)

    @property
    def prior_entropy(self) -> float:
        """Entropy of the belief before the first frame [nat]."""
        return self._tracked.prior_entropy

    @property
    def changes(self) -> list[Change]:
        """Cuts and sutures so far as the belief took them; of the filter 'implicit' alone."""
        return [] if self._tracked_or_none is None else list(self._tracked_or_none.state.changes)

    def change_log_bayes_factor(self, change: Change) -> float | None:
        """Return the log Bayes factor of 'the change worked' against 'nothing changed' [nat].

        It is that of the frames after this change and before the next; None if they hold no evidence.

        Raises:
            ValueError: asked before `begin`, or of another filter than 'implicit'; this is no change.
        """
        as_instance(change, "change", Change, hint="Estimator.changes lists them.")
        filter = self._tracked.filter.by_forces("can infer whether a cut or suture worked")
        with jax.enable_x64(True), one_thread():
            return filter.log_bayes_factor(self._tracked.state, change)

    @property
    def balance(self) -> ForceBalance:
        """The sheet's balance of forces, with the learned noise.

        Raises:
            ValueError: asked before `begin`, or of another filter than 'implicit'.
        """
        with jax.enable_x64(True):
            return self._tracked.filter.by_forces("predicts pulls").balance(self._tracked.state)

    @property
    def attachment_belief(self) -> AttachmentBelief:
        """The belief over bounded stiffnesses; call `release` first once a grasp is over.

        Raises:
            ValueError: asked before `begin`, or of another filter than 'implicit'.
        """
        return self._tracked.filter.by_forces("predicts pulls").belief(self._tracked.state)

    @property
    def point_precision(self) -> Float[np.ndarray, "3 3"]:
        """Mean inverse covariance of a particle in the latest frame, as learned, without `shared_noise` [1/m^2].

        Raises:
            ValueError: asked before `begin`.
        """
        return self._seen_precision / self._tracked.position_variance

    @property
    def shared_noise(self) -> Float[np.ndarray, "n modes"] | None:
        """The noise that neighbours share as fields, with the learned noise; see `Track.fields`. None for none [m].

        Raises:
            ValueError: asked before `begin`.
        """
        fields, variance = self._perception.fields, self._tracked.position_variance
        return None if fields is None else np.asarray(fields) * np.sqrt(variance)

    @property
    def point_noise(self) -> PointNoise | None:
        """The noise of measured points that counts; None for images, and before there is a sheet."""
        return self._perception.noise

    @property
    def sheet(self) -> Sheet:
        """The particles; fixed from the first grasp on.

        Raises:
            ValueError: asked before `begin` and before the first frame with closed jaws.
        """
        return self._tracked.sheet

    @property
    def positions(self) -> Float[np.ndarray, "n 3"]:
        """Positions of the particles [m]: as estimated while the jaws hold some, else as last seen, or at rest."""
        tracked = self._tracked
        if self.grip.hold is not None:
            return tracked.x
        if self._open_frame is not None:
            with jax.enable_x64(True), one_thread():
                tracked.open_x, self._open_frame = self._positions_with_open_jaws(self._open_frame), None
        return tracked.open_x

    @property
    def rest_time(self) -> int:
        """When the sheet lay as its rest shape has it [ns], once a frame has shown it."""
        return self._perception.rest_time

    @property
    def hold(self) -> GripHold | None:
        """What the jaws hold, where it is without the errors of declared effects; None while they are open."""
        return None if self.grip.hold is None else self._hold

    @property
    def track_ids(self) -> Int[np.ndarray, " n"] | None:
        """Tracked point of each particle; None where points have no names."""
        return self._perception.track_ids

    @property
    def slip(self) -> float:
        """Median distance of the held particles from where the tool should have taken them, as last seen [m]."""
        return 0.0 if self.grip.hold is None else self._slip

    @property
    def tool(self) -> ToolState | None:
        """The tool as the robot last reported it."""
        return self._tool

    def force_unknown(self, held: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Return the particles that a grip on the held ones may pull at, the held ones included."""
        return self._tracked.field.dilated(as_array(held, "held", (len(self._tracked.x),), kind="booleans"))

    @property
    def _tracked(self) -> TrackedSheet:
        if self._tracked_or_none is None:
            raise ValueError(
                "the sheet is not known before the first frame with closed jaws; call update with it, or begin."
            )
        return self._tracked_or_none

    def _change(self, event: Cut | Suture, index: int) -> None:
        """Take a cut or suture into the belief, before the observation that it was seen with."""
        region = region_of(event, self.sheet.rest)
        if not region.any():
            self.skipped.append((index, f"the {type(event).__name__.lower()} is beside the sheet, and was left out"))
            return
        self._release()
        tracked = self._tracked
        tracked.state = tracked.filter.change(tracked.state, event, region=region, index=index)

    def _release(self, *, at_the_end: bool = False) -> None:
        if (tracked := self._tracked_or_none) is None:
            return
        thorough = at_the_end or self.config.refinement == "grasps"
        with jax.enable_x64(True), one_thread():
            tracked.take(*tracked.filter.release(tracked.state, thorough=thorough))

    def _see(self, observation: Observation) -> Track:
        simulated = None if self._tracked.filter.matches_clouds else lambda: self._prediction(observation.tool)
        return self._perception.track(observation, predicted=self._tracked.x, simulator_input=simulated)

    def _prediction(self, tool: ToolState) -> SimulatorInput:
        """Return the state before a frame, b, and the moved grip, for a filter that needs positions of a cloud."""
        tracked = self._tracked
        hold, before = self._grasp(Track.of_nothing(len(tracked.x)), tool)
        stiffness = jnp.where(hold.held, self.config.grip_stiffness * self.declaration.membrane_stiffness, 0.0)
        moved = pull(before, tool, hold)
        return before, np.asarray(tracked.state.summary.b), Grip.of(moved.tip, moved.length, stiffness)

    def _grasp(self, track: Track, tool: ToolState, time: int = 0) -> tuple[GripHold, Float[np.ndarray, "n 3"]]:
        """Return the grasp of a frame, and the state to start from; see `GripTracker.grasp`."""
        named = self._perception.named_held(tool)
        return self._tracked.grasp(self.grip, tool, track, time=time, named=named)

    def _positions_with_open_jaws(self, observation: Observation) -> Float[np.ndarray, "n 3"]:
        """Return where the sheet lies [m]: at rest where nothing identifies its particles."""
        rest = self.sheet.rest
        try:
            track = self._see(observation) if self._perception.identifies else None
        except PerceptionError:
            return rest
        return rest if track is None else self._tracked.without_grip(track, observation.time)
