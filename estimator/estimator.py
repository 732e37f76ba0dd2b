"""The estimator's front: observations in, estimates out.

While the sheet lies still before the first grasp, frames only fix where it rests. Then every frame with closed jaws
goes perception -> grip -> filter. Sees nothing but observations, the camera's calibration and the declaration.
"""

import time
from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jiggle_mj.actions import Cut, Suture
from jiggle_mj.camera import StereoCamera
from jiggle_mj.errors import PerceptionError
from jiggle_mj.estimate import Belief, Detection, Estimate, Sheet
from jiggle_mj.material import Material, material
from jiggle_mj.mesh_checks import check_unfolded
from jiggle_mj.observation import Declaration, Observation, ToolState
from jiggle_mj.sheet_triangulation import SheetPlane

from .belief import summaries as summaries
from .belief.attachment_belief import AttachmentBelief
from .belief.boundary_belief import BoundaryBelief
from .belief.topology import Change, after, meant_by, region_of
from .blas import one_thread
from .config import EstimatorConfig
from .filters.build import build_filter
from .filters.evidence import Filter, PosteriorSummary
from .filters.implicit import ImplicitFilter
from .fusion import fused, pull
from .grip import GripHold
from .identification import identify
from .perception import Believed, Disparity, Perception, TissueMask, Track
from .perception.mesh_field import MeshField
from .physics.environment import Grip
from .physics.mesh import SheetMesh
from .planning.pull_predictor import PullPredictor

SEEN = 3e-4
"""Standard deviation of a seen coordinate before the first frame has said how well it is seen [m]."""


class Estimator:
    """Follows one tissue through one recording."""

    def __init__(
        self,
        declaration: Declaration,
        camera: StereoCamera | None = None,
        *,
        config: EstimatorConfig | None = None,
        mask: TissueMask | None = None,
        disparity: Disparity | None = None,
    ):
        """Say what is known beforehand.

        Args:
            declaration: what the user says of the tissue.
            camera: needed for observations with images.
            config: settings; the defaults are those that the figures of docs/RESULTS.md were made with.
            mask: which pixels are tissue; by colour if None.
            disparity: dense stereo; semi-global matching if None.
        """
        self.declaration, self.config = declaration, config or EstimatorConfig()
        self.skipped: list[tuple[int, str]] = []
        """Index and reason of each observation that could not be used."""
        self._perception = Perception(declaration, camera, spacing=self.config.spacing, mask=mask, disparity=disparity)
        self._filter: Filter | None = None
        self._hold: GripHold | None = None
        self._closing: ToolState | None = None
        self._tool: ToolState | None = None
        self._sharpness = np.eye(3) * SEEN**-2
        self.changes: list[Change] = []
        """Cuts and sutures so far, as the belief took them; of the filter 'implicit' alone."""
        self._idle: Observation | None = None
        self._slip = 0.0
        self._used = False
        self._converged = True

    @property
    def sheet(self) -> Sheet:
        """The particles; fixed from the first grasp on.

        Raises:
            ValueError: asked before the first frame with closed jaws.
        """
        self._check_begun()
        return self._perception.sheet()

    def begin(self) -> Sheet:
        """Fix the sheet by the frames so far, before the jaws close, so that a first grasp can be planned.

        Raises:
            PerceptionError: nothing was seen that a sheet could be laid over.
            MeshError: the sheet at rest is folded, or not one sheet.
        """
        if self._filter is None:
            if not self._perception.ready:
                raise PerceptionError("no frame has shown the sheet yet; wait for one before planning a grasp.")
            with jax.enable_x64(True), one_thread():
                self._filter = self._begin()
        return self.sheet

    @property
    def positions(self) -> Float[np.ndarray, "n 3"]:
        """Where the particles are [m]: as believed while the jaws hold some, else as last seen, or at rest."""
        self._check_begun()
        if self._hold is not None:
            return self._x
        if self._idle is not None:
            with jax.enable_x64(True), one_thread():
                self._lying, self._idle = self._lies(self._idle), None
        return self._lying

    @property
    def rest_time(self) -> int:
        """When the sheet lay as its rest shape has it [ns], once a frame has shown it."""
        return self._perception.rest_time

    @property
    def hold(self) -> GripHold | None:
        """What the jaws hold; None while they are open."""
        return self._hold

    @property
    def track_ids(self) -> Int[np.ndarray, " n"] | None:
        """Which tracked point each particle is; None where they have no names."""
        return self._perception.track_ids

    @property
    def slip(self) -> float:
        """How far the held particles were last seen from where the tip should have taken them, in the median [m]."""
        return 0.0 if self._hold is None else self._slip

    @property
    def tool(self) -> ToolState | None:
        """As the robot last reported it."""
        return self._tool

    def force_unknown(self, held: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Particles that a grip on those which are held may pull at, themselves among them."""
        self._check_begun()
        return self._field.widened(held)

    def predictor(self, about: Bool[np.ndarray, " n"] | None = None) -> PullPredictor:
        """What pulls would show and cost, as far as is believed now; `release` first, once a grasp is over.

        Args:
            about: particles whose attachments are asked about; all if None.

        Raises:
            ValueError: asked before `begin`, or of another filter than 'implicit'.
        """
        self._check_begun()
        implicit, belief = self._implicit("predicts pulls")
        position = 1.0 if implicit.noise is None else implicit.noise.position
        asked = jnp.ones(len(self._x), dtype=bool) if about is None else jnp.asarray(about)
        point_precision = jnp.asarray(self._sharpness / position)
        return PullPredictor.build(implicit.balance, belief, point_precision, asked)

    @property
    def belief(self) -> Belief:
        """The belief so far; `release` first, once a grasp is over.

        Raises:
            ValueError: asked before the first frame with closed jaws.
        """
        self._check_begun()
        with jax.enable_x64(True), one_thread():
            return summaries.belief(self._summary)

    @property
    def detection(self) -> Detection:
        """Which particles are called attached so far; see `belief`.

        Raises:
            ValueError: asked before the first frame with closed jaws.
        """
        self._check_begun()
        assert self._filter is not None
        return summaries.detection(
            self._summary, self._filter, self.declaration, self.config, converged=self._converged
        )

    def update(self, observation: Observation) -> Estimate | None:
        """Take one observation; None when it only helps to fix the rest shape, or cannot be used.

        Raises:
            PerceptionError: the sheet cannot be found in the first frames, or the first grasp is off the tissue. Once
                there is an estimate, a frame that cannot be used goes to `skipped` instead.
            MeshError: the sheet at rest is folded, or not one sheet.
        """
        with jax.enable_x64(True), one_thread():
            try:
                found = self._update(observation)
            except PerceptionError as failure:
                if not self._used:
                    raise
                self.skipped.append((observation.index, str(failure)))
                return None
        self._used |= found is not None
        return found

    def release(self) -> None:
        """Say that the grasp is over: its frames are judged again in the light of all of them.

        Happens by itself when the jaws open or a new grasp begins; needed only where observations end with closed
        jaws, or where the settings leave the judging to the end.

        Raises:
            PerceptionError: no finite belief explains the frames together; what was believed before stays.
        """
        self._release(at_the_end=True)

    def _release(self, *, at_the_end: bool = False) -> None:
        if self._filter is None:
            return
        thorough = at_the_end or self.config.refinement == "grasps"
        with jax.enable_x64(True), one_thread():
            if (again := self._filter.release(self._summary.belief, thorough=thorough)) is not None:
                self._refine(again)

    def identify(self, *, on_pass: Callable[[dict[str, float]], None] = lambda _: None) -> Material:
        """The sheet's own parameters from all frames so far; the belief becomes the one that goes with them.

        Args:
            on_pass: told of each ratio's factor after each pass, for progress.

        Raises:
            ValueError: asked before the first frame with closed jaws, or of another filter than 'implicit'.
        """
        self._check_begun()
        self._implicit("can identify the sheet")
        self.release()
        implicit, belief = self._implicit("can identify the sheet")
        with jax.enable_x64(True), one_thread():
            factors, log_sd, summary, converged = identify(implicit, belief, self._summary.b, on_pass=on_pass)
            self._refine(summary)
        return material(self.declaration, factors, log_sd, converged=converged)

    def _update(self, observation: Observation) -> Estimate | None:
        tool = self._tool = observation.tool
        if self._filter is None:
            if (passed_over := self._perception.look_at_rest(observation)) is not None:
                self.skipped.append((observation.index, passed_over))
            if not (tool.closed or observation.events):
                return None
            self.begin()
        for event in observation.events:
            self._change(event, observation.index)
        assert self._filter is not None
        if not tool.closed:
            self._release()
            self._hold = self._closing = None
            self._idle = observation
            return None
        if self._closing is None or self._closing.grasp != tool.grasp:
            self._release()
            self._closing = tool
        began = time.perf_counter()
        track = self._see(observation)
        seen = time.perf_counter()
        if not track.visible.any():
            self.skipped.append((observation.index, "no particle was seen"))
            return None
        hold, before = self._grip(track, tool)
        frame = fused(track, hold, tool, before, grip_sd=self.config.grip_sd, field=self._field)
        self._slip, self._sharpness = frame.slip, track.precision[track.visible].mean(axis=0)
        update = self._filter.update(self._summary.belief, self._summary.b, frame.evidence, jnp.asarray(frame.start))
        if not (np.isfinite(update.x).all() and np.isfinite(update.b).all()):
            raise PerceptionError(
                f"observation {observation.index} leaves the filter without a finite state: no sheet explains it."
            )
        self._hold, self._x = hold, np.asarray(update.x)
        again = self._filter.reconsider(update.belief) if self.config.refinement == "frames" else None
        summary = again or update
        self._summary, b = summary, np.asarray(summary.b)
        return Estimate(
            index=observation.index,
            time=observation.time,
            positions=self._x,
            observed=track.positions,
            mean=b,
            sd=np.asarray(summary.sd),
            probability=np.asarray(summary.probability),
            held=hold.held,
            entropy=float(summary.entropy),
            nis=float(update.nis),
            boundary_energy=0.5 * float(np.mean(b * np.sum((self._x - self.sheet.rest) ** 2, axis=1))),
            update_s=time.perf_counter() - seen,
            perception_s=seen - began,
            converged=bool(update.converged),
        )

    def _change(self, event: Cut | Suture, index: int) -> None:
        """Take a cut or suture into the belief, before the observation that it was seen with."""
        region = region_of(event, self.sheet.rest)
        if not region.any():
            self.skipped.append((index, f"the {type(event).__name__.lower()} is beside the sheet, and was left out"))
            return
        self._release()
        assert self._filter is not None
        belief = self._summary.belief
        if isinstance(belief, AttachmentBelief) and isinstance(self._filter, ImplicitFilter):
            if self.changes:
                self.changes[-1].evidence = self._filter.evidence()
            self.changes.append(Change(event=event, index=index, region=region, before=belief))
            self._summary = self._filter.restart(after(belief, event, region))
            return
        assert isinstance(belief, BoundaryBelief)
        meant = meant_by(event)
        change = jnp.where(region, meant - belief.mean(), 0.0)
        sd = max(self.config.prior_sd * self.declaration.membrane_stiffness, meant)
        belief = belief.predict(change, jnp.where(region, sd**2, 0.0))
        self._summary = replace(self._summary, belief=belief, b=belief.non_negative_mean())
        self._filter.forget()

    def worked(self, change: Change) -> float | None:
        """Log Bayes factor of 'it worked' against 'nothing changed'; None before a frame that says anything of it.

        Frames since the change and before the next are looked at.
        """
        implicit, _ = self._implicit("can tell")
        with jax.enable_x64(True), one_thread():
            evidence = change.evidence if change is not self.changes[-1] else implicit.evidence()
            return None if evidence is None else change.log_bayes_factor(*evidence)

    def _refine(self, summary: PosteriorSummary) -> None:
        """Believe what all frames together say."""
        if not all(np.isfinite(part).all() for part in (summary.b, summary.sd, summary.probability)):
            raise PerceptionError(
                "judged again, the frames of all grasps leave no finite belief: no attachments explain them together. "
                "What was believed before stays; leave out grasps to find the one that does not fit."
            )
        self._summary, self._converged = summary, bool(summary.converged)

    def _implicit(self, does: str) -> tuple[ImplicitFilter, AttachmentBelief]:
        """What only the filter 'implicit' does is done with these."""
        if isinstance(self._filter, ImplicitFilter) and isinstance(self._summary.belief, AttachmentBelief):
            return self._filter, self._summary.belief
        raise ValueError(f"only the filter 'implicit' {does}; this one is {self.config.filter!r}.")

    def _check_begun(self) -> None:
        if self._filter is None:
            raise ValueError("the sheet is not known before the first frame with closed jaws; call update first.")

    def _begin(self) -> Filter:
        """Build the model once the rest shape is known."""
        sheet = self._perception.sheet()
        mesh, plane = SheetMesh(sheet.rest, sheet.faces), SheetPlane.through(sheet.rest)
        check_unfolded(mesh.rest, mesh.faces, above=plane.axes[2])
        self._field = MeshField(plane.flatten(mesh.rest), mesh.faces)
        found, belief = build_filter(mesh, self.declaration, self.config)
        entropy, unknown = belief.entropy(), jnp.full(mesh.n, jnp.nan)
        self.prior_entropy = float(entropy)
        self._summary = PosteriorSummary(
            belief=belief,
            b=jnp.zeros(mesh.n),
            sd=unknown,
            probability=unknown,
            entropy=entropy,
            converged=jnp.asarray(True),
        )
        self._x = self._lying = mesh.rest
        return found

    def _see(self, observation: Observation) -> Track:
        return self._perception.track(observation, predicted=self._x, believed=lambda: self._believed(observation.tool))

    def _believed(self, tool: ToolState) -> Believed:
        """What a cloud is met with: the state before, and how the tip has moved."""
        hold, before = self._grip(Track.of_nothing(len(self._x)), tool)
        stiffness = jnp.where(hold.held, self.config.grip_stiffness * self.declaration.membrane_stiffness, 0.0)
        moved = pull(before, tool, hold)
        return before, np.asarray(self._summary.b), Grip.of(moved.tip, moved.length, stiffness)

    def _lies(self, observation: Observation) -> Float[np.ndarray, "n 3"]:
        """Where the sheet lies with the jaws open; what is not seen moves with its surroundings."""
        rest = self.sheet.rest
        try:
            if not self._perception.identifies:
                return rest
            track = self._see(observation)
        except PerceptionError:
            return rest
        if not track.visible.any():
            return rest
        off = np.where(track.visible[:, None], np.nan_to_num(track.positions) - rest, 0.0)
        return rest + self._field.fill(off, track.visible, stiffness=1.0)

    def _grip(self, track: Track, tool: ToolState) -> tuple[GripHold, Float[np.ndarray, "n 3"]]:
        """The grasp of this frame, and the state to start from: the last, or rest where the jaws have just closed.

        If the frame in which they closed could not be used, the sheet is taken to have been at rest in it.
        """
        if self._hold is not None and self._hold.grasp == tool.grasp:
            return self._hold, self._x
        assert self._closing is not None
        rest = self.sheet.rest
        seen = track.visible & (tool is self._closing)
        at_closing = np.where(seen[:, None], np.nan_to_num(track.positions), rest)
        try:
            return GripHold.close(self._closing, at_closing, self._named(tool)), rest
        except PerceptionError:
            self._closing = None  # a later frame of this grasp may know better
            raise

    def _named(self, tool: ToolState) -> Bool[np.ndarray, " n"] | None:
        """Particles that the recording or the declaration says are held; only points have names."""
        if (ids := self._perception.track_ids) is None:
            return None
        if tool.held_tracks:
            return np.isin(ids, tool.held_tracks)
        return None if self.declaration.mesh is None else self.declaration.mesh.held
