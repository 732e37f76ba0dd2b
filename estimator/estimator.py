"""The estimator's front: observations in, estimates out.

While the sheet lies still before the first grasp, frames only fix where it rests. Then every frame with closed jaws
goes perception -> grip -> filter. Sees nothing but observations, the camera's calibration and the declaration.
"""

import time
from dataclasses import dataclass
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from jiggle_mj.estimator.attachment_belief import AttachmentBelief
from jiggle_mj.estimator.belief import BoundaryBelief
from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.estimator.filters.adam import AdamShooting
from jiggle_mj.estimator.filters.evidence import Evidence, Filter, Pull, Stated
from jiggle_mj.estimator.filters.explicit import PRIOR_MEAN, MultipleShooting
from jiggle_mj.estimator.filters.force_balance import ForceBalance
from jiggle_mj.estimator.filters.implicit import ImplicitFilter, prior_belief
from jiggle_mj.estimator.filters.nnls import NonNegativeLeastSquares
from jiggle_mj.estimator.filters.unscented import ReducedUnscented
from jiggle_mj.estimator.grip import GripHold
from jiggle_mj.estimator.mesh import SheetMesh
from jiggle_mj.estimator.perception import Disparity, PointTracker, StereoTracker, TissueMask, Track
from jiggle_mj.estimator.perception.mesh_field import MeshField
from jiggle_mj.estimator.surrogate import Membrane, surrogate

from jiggle_mj.camera import StereoCamera
from jiggle_mj.errors import PerceptionError
from jiggle_mj.estimate import Belief, Detection, Estimate, Sheet
from jiggle_mj.mesh_checks import check_unfolded
from jiggle_mj.observation import Declaration, MeasuredPoints, Observation, StereoPair, ToolState
from jiggle_mj.sheet_triangulation import SheetPlane

FilterName = Literal["implicit", "explicit", "adam", "nnls", "unscented"]


@dataclass(frozen=True, kw_only=True)
class EstimatorConfig:
    """Settings of the estimator; stiffnesses are shares of the declared membrane stiffness k."""

    spacing: float = 4.4e-3
    """Between the particles of a mesh laid over images [m]."""
    filter: FilterName = "implicit"
    """How a frame enters the belief: through the balance of forces, or, as in the paper, through a simulated step; the
    others are baselines: gradient descent on that step, least squares on the forces, and patches through equilibria."""
    samples: int = 1
    """Frames that each update of the explicit filter or of adam simulates, the latest among them."""
    membrane: Membrane = "triangles"
    """Law of the sheet's plane where no step is simulated: St Venant-Kirchhoff triangles, or springs along edges."""
    reference: float = 1.0
    """Attachment stiffness in the middle of the implicit filter's scale from free to rigid [k]."""
    prior_sd: float = 1 / 75
    """Standard deviation of each attachment stiffness before anything is seen, for the other filters [k]."""
    force_sd: float = 4.5e-3
    """Standard deviation of the force that the model gets wrong on a particle [k x spacing]."""
    anchor_sd: float = 1e-4
    """How far a welded particle may be from its anchor, for the implicit filter [m]."""
    grip_sd: float = 1.5e-3
    """How well held particles follow the tip [m]."""
    grip_stiffness: float = 3.0
    """Of the springs that carry held particles with the tip while the state is searched [k]."""
    detect_above: float = 0.011
    """Filters that state no probability report a particle attached when its mean stiffness exceeds this [k]."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in POSITIVE:
            if not getattr(self, name) > 0:
                raise ValueError(f"EstimatorConfig.{name} must be above 0; got {getattr(self, name)}.")
        for name in SHARES:
            share = getattr(self, name)
            if not 1 / LARGEST_RATIO <= share <= LARGEST_RATIO:
                raise ValueError(
                    f"EstimatorConfig.{name} is a share of the membrane stiffness and must lie between "
                    f"{1 / LARGEST_RATIO:g} and {LARGEST_RATIO:g}, what float32 can add to it; got {share}."
                )
        if self.filter not in get_args(FilterName):
            raise ValueError(f"EstimatorConfig.filter must be one of {get_args(FilterName)}; got {self.filter!r}.")
        if not (isinstance(self.samples, int) and self.samples >= 1):
            raise ValueError(f"EstimatorConfig.samples must be an integer of at least 1; got {self.samples}.")
        if self.membrane not in ("triangles", "edges"):
            raise ValueError(f"EstimatorConfig.membrane must be 'triangles' or 'edges'; got {self.membrane!r}.")


RULE = "P(attached) > 0.5"
"""Of filters that state a probability."""
POSITIVE = (
    "spacing",
    "reference",
    "prior_sd",
    "force_sd",
    "anchor_sd",
    "grip_sd",
    "grip_stiffness",
    "detect_above",
)
"""Settings that must be above 0."""

SHARES, LARGEST_RATIO = ("reference", "prior_sd", "force_sd", "grip_stiffness", "detect_above"), 1e7
"""Settings that are shares of the membrane stiffness, and how far from it they may be either way."""


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
            config: settings; the defaults are those that the README's figures were made with.
            mask: which pixels are tissue; by colour if None.
            disparity: dense stereo; semi-global matching if None.
        """
        self.declaration, self.config = declaration, config or EstimatorConfig()
        self.skipped: list[tuple[int, str]] = []
        """Index and reason of each observation that could not be used."""
        self._stereo = (
            None
            if camera is None
            else StereoTracker(camera, spacing=self.config.spacing, mask=mask, disparity=disparity)
        )
        self._points = PointTracker(declaration.mesh)
        self._still: list[MeasuredPoints] = []
        self._sheet: Sheet | None = None
        self._filter: Filter | None = None
        self._hold: GripHold | None = None
        self._closing: ToolState | None = None
        self._used = False

    @property
    def sheet(self) -> Sheet:
        """The particles; fixed from the first grasp on.

        Raises:
            ValueError: asked before the first frame with closed jaws.
        """
        self._check_begun()
        assert self._sheet is not None
        return self._sheet

    @property
    def belief(self) -> Belief:
        """The belief so far; `release` first, once a grasp is over.

        Raises:
            ValueError: asked before the first frame with closed jaws.
        """
        self._check_begun()
        with jax.enable_x64(True), one_thread():
            mean, covariance = self._belief.moments()
            if isinstance(self._belief, BoundaryBelief):
                return Belief(mean=np.asarray(mean), covariance=np.asarray(covariance))
            lower, upper = self._belief.interval()
            return Belief(
                mean=np.asarray(mean),
                covariance=np.asarray(covariance),
                reference=float(self._belief.reference),
                lower=np.asarray(lower),
                upper=np.asarray(upper),
            )

    @property
    def detection(self) -> Detection:
        """Which particles are called attached so far; see `belief`.

        Raises:
            ValueError: asked before the first frame with closed jaws.
        """
        self._check_begun()
        if np.isfinite(self._probability).all():
            return Detection(
                attached=self._probability > 0.5,
                score=self._probability,
                stiffness=self._b,
                probabilistic=True,
                rule=RULE,
            )
        limit = self.config.detect_above * self.declaration.membrane_stiffness
        return Detection(
            attached=self._b > limit,
            score=self._b,
            stiffness=self._b,
            rule=f"non-negative mean of b > {self.config.detect_above:g} k = {limit:.3g} N/m",
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

        Happens by itself when the jaws open or a new grasp begins; needed only where observations end with closed jaws.
        """
        if self._filter is None:
            return
        with jax.enable_x64(True), one_thread():
            if (again := self._filter.release(self._belief)) is not None:
                self._believe(again)

    def _update(self, observation: Observation) -> Estimate | None:
        tool = observation.tool
        if self._filter is None:
            self._look_at_rest(observation)
            if not tool.closed:
                return None
            self._filter = self._begin()
        if not tool.closed:
            self.release()
            self._hold = self._closing = None
            return None
        if self._closing is None or self._closing.grasp != tool.grasp:
            self.release()
            self._closing = tool
        began = time.perf_counter()
        track = self._see(observation)
        seen = time.perf_counter()
        if not track.visible.any():
            self.skipped.append((observation.index, "no particle was seen"))
            return None
        hold, before = self._grip(track, tool)
        evidence, start = self._evidence(track, tool, hold, before)
        update = self._filter.update(self._belief, jnp.asarray(self._b), evidence, jnp.asarray(start))
        if not (np.isfinite(update.x).all() and np.isfinite(update.b).all()):
            raise PerceptionError(
                f"observation {observation.index} leaves the filter without a finite state: no sheet explains it."
            )
        self._hold, self._x = hold, np.asarray(update.x)
        self._believe(update)
        return Estimate(
            index=observation.index,
            time=observation.time,
            positions=self._x,
            observed=track.positions,
            mean=self._b,
            sd=np.asarray(update.sd),
            probability=self._probability,
            held=hold.held,
            entropy=float(update.entropy),
            nis=float(update.nis),
            boundary_energy=0.5 * float(np.mean(self._b * np.sum((self._x - self.sheet.rest) ** 2, axis=1))),
            update_s=time.perf_counter() - seen,
            perception_s=seen - began,
            converged=bool(update.converged),
        )

    def _believe(self, stated: Stated) -> None:
        self._belief, self._b, self._probability = stated.belief, np.asarray(stated.b), np.asarray(stated.probability)

    def _check_begun(self) -> None:
        if self._filter is None:
            raise ValueError("the sheet is not known before the first frame with closed jaws; call update first.")

    def _look_at_rest(self, observation: Observation) -> None:
        """Use a frame before the first grasp: the first image, every cloud of points."""
        if observation.images is not None and self._stereo is not None:
            if self._sheet is None:
                self._start(observation.index, observation.images, observation.tool)
        elif observation.points is not None:
            if not (observation.tool.closed and self._still):
                self._still.append(observation.points)
        else:
            raise PerceptionError(
                f"observation {observation.index} has neither points nor images with a calibrated camera."
            )

    def _start(self, index: int, images: StereoPair, tool: ToolState) -> None:
        """Lay the mesh over an image; one that cannot be used is passed over while another may come."""
        assert self._stereo is not None
        try:
            self._sheet = self._stereo.start(images, tool)
        except PerceptionError as failure:
            if tool.closed:
                raise
            self.skipped.append((index, str(failure)))

    def _begin(self) -> Filter:
        """Build the model once the rest shape is known."""
        if self._sheet is None:
            self._sheet = self._points.start(self._still)
        check_unfolded(self._sheet.rest, self._sheet.faces)
        mesh = SheetMesh(self._sheet.rest, self._sheet.faces)
        self._field = MeshField(SheetPlane.through(mesh.rest).flatten(mesh.rest), mesh.faces)
        found, self._belief = self._build(mesh)
        self.prior_entropy = float(self._belief.entropy())
        self._x, self._b, self._probability = mesh.rest, np.zeros(mesh.n), np.full(mesh.n, np.nan)
        return found

    def _build(self, mesh: SheetMesh) -> tuple[Filter, BoundaryBelief | AttachmentBelief]:
        """The filter that the settings name, and what it believes beforehand."""
        config, k = self.config, self.declaration.membrane_stiffness
        grip_stiffness, force_sd = config.grip_stiffness * k, config.force_sd * k * mesh.spacing
        mean = PRIOR_MEAN if config.filter == "explicit" else 0.0
        gaussian = BoundaryBelief.prior(mesh.n, mean=mean, sd=config.prior_sd * k)
        if config.filter in ("explicit", "adam"):
            shooting = MultipleShooting if config.filter == "explicit" else AdamShooting
            return shooting(mesh, self.declaration, grip_stiffness=grip_stiffness, samples=config.samples), gaussian
        energy = surrogate(mesh, self.declaration, membrane=config.membrane)
        if config.filter == "nnls":
            return NonNegativeLeastSquares.build(energy, force_sd=force_sd), gaussian
        if config.filter == "unscented":
            tolerance = force_sd / 4
            return ReducedUnscented(mesh, energy, grip_stiffness=grip_stiffness, force_tolerance=tolerance), gaussian
        reference = config.reference * k
        balance = ForceBalance.build(
            mesh,
            energy,
            reference=reference,
            force_sd=force_sd,
            anchor_sd=config.anchor_sd,
            grip_stiffness=grip_stiffness,
        )
        return ImplicitFilter(balance), prior_belief(mesh, reference=reference)

    def _see(self, observation: Observation) -> Track:
        if observation.images is not None and self._stereo is not None:
            return self._stereo.track(observation.images, observation.tool, predicted=self._x)
        if observation.points is not None:
            return self._points.track(observation.points)
        raise PerceptionError(f"observation {observation.index} has neither points nor images; one is needed.")

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

    def _evidence(
        self, track: Track, tool: ToolState, hold: GripHold, before: Float[np.ndarray, "n 3"]
    ) -> tuple[Evidence, Float[np.ndarray, "n 3"]]:
        """Fuse what was seen with what the grip says; and a start for the state, smooth where nothing was seen."""
        seen, held, expected = track.visible, hold.held, hold.expected(tool)
        precision = np.where(seen[:, None, None], np.linalg.inv(track.covariance), 0.0)
        weighed = np.einsum("nij,nj->ni", precision, np.nan_to_num(track.positions))
        grip = np.where(held, self.config.grip_sd**-2, 0.0)
        precision = precision + grip[:, None, None] * np.eye(3)
        weighed = weighed + grip[:, None] * expected
        known = seen | held
        y = np.where(
            known[:, None],
            np.linalg.solve(np.where(known[:, None, None], precision, np.eye(3)), weighed[..., None])[..., 0],
            0,
        )
        motion = np.where(known[:, None], y - before, 0.0)
        start = before + np.where(held[:, None], motion, self._field.fill(motion, known, stiffness=1.0))
        y = np.where(known[:, None], y, start)
        evidence = Evidence(
            y=jnp.asarray(y),
            precision=jnp.asarray(precision),
            held=jnp.asarray(held),
            loaded=jnp.asarray(self._field.widened(held)),
            pull=Pull(
                before=jnp.asarray(before),
                tip=jnp.asarray(tool.position),
                length=jnp.asarray(np.linalg.norm(hold.closed_at - hold.tip, axis=1)),
            ),
        )
        return evidence, start

    def _named(self, tool: ToolState) -> Bool[np.ndarray, " n"] | None:
        """Particles that the recording or the declaration says are held; only points have names."""
        if not len(self._points.ids):
            return None
        if tool.held_tracks:
            return np.isin(self._points.ids, tool.held_tracks)
        return None if self.declaration.mesh is None else self.declaration.mesh.held
