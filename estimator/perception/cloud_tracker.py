"""Trackers of clouds whose points have no identities, over the mesh of `cloud_mesh`.

The filter 'implicit' matches each cloud to the state that it searches for (`cloud_surface`), so that state and
attachments are estimated together. For the other filters a cloud becomes positions as in the paper: one step of the
simulator f', whose sweeps include the gradient of the chamfer distance (`xpbd`, `chamfer`) and whose attachments are
the belief's. The observation of a particle is then the mean of the points around it, along the sheet's normal. Along
the surface the particles are where the simulator moves them, with a standard deviation of
`CloudTrackerConfig.slide_sd`.
"""

from functools import cached_property

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Bool, Float
from scipy.spatial import KDTree

from jiggle_mj.errors import PerceptionError
from jiggle_mj.estimate import Sheet
from jiggle_mj.observation import Declaration, MeasuredPoints

from ..physics.environment import Grip
from ..physics.mesh import SheetMesh
from ..physics.simulator import simulator
from ..physics.xpbd import XPBD
from .chamfer import Chamfer
from .cloud_mesh import evenly
from .cloud_surface import Cloud, CloudSurface
from .config import CloudTrackerConfig
from .track import UNSEEN_VARIANCE, Track

MIN_SHARE = 0.5
"""Smallest share of a cloud's points that lie on the sheet."""


class CloudTracker:
    """Tracker of one sheet in a recording of clouds."""

    def __init__(
        self,
        sheet: Sheet,
        declaration: Declaration,
        still: list[MeasuredPoints],
        config: CloudTrackerConfig | None = None,
    ):
        """Prepare the mesh, and measure the clouds of the sheet at rest."""
        self._mesh, self._config = SheetMesh(sheet.rest, sheet.faces), config or CloudTrackerConfig()
        self._declaration, self._neighbourhood = declaration, self._config.neighbourhood * self._mesh.spacing
        clouds = [self._finite(points) for points in still]  # as dense as later ones, or the outline would seem to move
        self._surface = CloudSurface.build(self._mesh, clouds, sd=still[0].sd)

    def unmatched(self, points: MeasuredPoints) -> Track:
        """Return a cloud that the filter is to match; `matched` says afterwards what it shows.

        Raises:
            PerceptionError: the cloud has too few points.
        """
        cloud = self._finite(points)
        if len(cloud) < self._config.min_points:
            raise PerceptionError(f"the cloud has {len(cloud)} points; a sheet needs {self._config.min_points}.")
        sd = jnp.asarray(points.sd)
        return Track.of_nothing(
            self._mesh.n, Cloud(surface=self._surface, points=self._padded(cloud), sd=sd, sd_ratio=jnp.ones_like(sd))
        )

    def simulated(
        self, points: MeasuredPoints, before: Float[np.ndarray, "n 3"], b: Float[np.ndarray, " n"], grip: Grip
    ) -> Track:
        """Return the particles that match one cloud, by the paper's simulator.

        Args:
            points: the cloud.
            before: state of the frame before [m].
            b: stiffness of the attachments [N/m].
            grip: springs to the tip, which has moved since.
        """
        cloud = self._finite(points)
        if not len(cloud):
            return Track.of_nothing(len(before))
        state = jnp.asarray(before), jnp.asarray(b), grip, self._padded(cloud)
        x = np.asarray(_matched(*self._simulator, *state, self._config))
        normal = trimesh.Trimesh(x, self._mesh.faces, process=False).vertex_normals
        height = offset(x, normal, cloud, self._neighbourhood)
        x, seen = x + normal * height[:, None], np.isfinite(height)
        across = normal[:, :, None] * normal[:, None, :]
        covariance = points.sd**2 * across + self._config.slide_sd**2 * (np.eye(3) - across)
        unseen = UNSEEN_VARIANCE * np.eye(3)
        return Track(
            positions=np.where(seen[:, None], x, np.nan),
            covariance=np.where(seen[:, None, None], covariance, unseen),
            visible=seen,
        )

    @cached_property
    def _simulator(self) -> tuple[XPBD, Chamfer]:
        """The simulator, and the points on the mesh whose distance to a cloud it lowers."""
        config, mesh = self._config, self._mesh
        chamfer = Chamfer.build(mesh, count=config.samples, reach=config.reach * mesh.spacing)
        return simulator(mesh, self._declaration), chamfer

    def _finite(self, points: MeasuredPoints) -> Float[np.ndarray, "q 3"]:
        """Return the points that are there, at most `CloudTrackerConfig.samples` of them, evenly chosen [m]."""
        return evenly(points.positions[np.isfinite(points.positions).all(axis=1)], self._config.samples)

    def _padded(self, cloud: Float[np.ndarray, "q 3"]) -> Float[Array, "p 3"]:
        """Return a cloud as `CloudTrackerConfig.samples` rows, NaN behind its own, so that one program serves all."""
        rows = self._config.samples - len(cloud)
        return jnp.asarray(np.pad(cloud, ((0, rows), (0, 0)), constant_values=np.nan))


def matched(cloud: Cloud, x: Float[np.ndarray, "n 3"], held: Bool[np.ndarray, " n"]) -> tuple[Track, float]:
    """Return what a cloud shows of the particles, once the state is known, and the share of its points on the sheet.

    The particles lie within a spacing of the state [m].

    Raises:
        PerceptionError: most of the points lie off the sheet.
    """
    belongs, pull, precision = (np.asarray(part) for part in _shown(cloud, jnp.asarray(x), jnp.asarray(held)))
    known = np.isfinite(cloud.points).all(axis=1)
    share = float(belongs.sum()) / max(int(known.sum()), 1)
    if share < MIN_SHARE:
        raise PerceptionError(
            f"{share:.0%} of the cloud's points lie on the sheet, and {MIN_SHARE:.0%} are needed: the cloud is of "
            "something else, or shows more than the sheet (crop it), or is in another frame or unit."
        )
    covariance = np.linalg.inv(precision + np.eye(3) / float(cloud.surface.spacing) ** 2)
    covariance = (covariance + covariance.transpose(0, 2, 1)) / 2
    seen = np.trace(precision, axis1=1, axis2=2) > 0
    moved = np.einsum("nij,nj->ni", covariance, pull)
    positions = np.where(seen[:, None], x + moved, np.nan)
    return Track(positions=positions, covariance=covariance, visible=seen), share


@eqx.filter_jit
def _shown(
    cloud: Cloud, x: Float[Array, "n 3"], held: Bool[Array, " n"]
) -> tuple[Bool[Array, " q"], Float[Array, "n 3"], Float[Array, "n 3 3"]]:
    """Return which points lie on the sheet, and what they say of its particles, as one program."""
    return cloud.belongs(x), *cloud.matched(x, held)


def offset(
    x: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "n 3"], cloud: Float[np.ndarray, "q 3"], around: float
) -> Float[np.ndarray, " n"]:
    """Return the mean height of the points around each particle, along its normal [m]; NaN where there are none.

    The simulator stops where its elastic forces balance the attraction of the cloud. Without this correction a filter
    would take the distance for the effect of attachment forces.
    """
    near = KDTree(cloud).query_ball_point(x, around)
    count = np.array([len(points) for points in near])
    particle = np.repeat(np.arange(len(x)), count)
    point = np.concatenate([np.asarray(points, int) for points in near])
    above = np.sum((cloud[point] - x[particle]) * normal[particle], axis=1)
    return np.bincount(particle, above, len(x)) / np.where(count > 0, count, np.nan)


@eqx.filter_jit
def _matched(
    simulator: XPBD,
    chamfer: Chamfer,
    x: Float[Array, "n 3"],
    b: Float[Array, " n"],
    grip: Grip,
    cloud: Float[Array, "q 3"],
    config: CloudTrackerConfig,
) -> Float[Array, "n 3"]:
    """Return the state that matches a cloud, padded with NaN, after one step of f' [m]."""
    count = jnp.sum(jnp.where(jnp.isfinite(cloud[:, 0]), 1.0, 0.0)) + len(chamfer.corners)
    rate = config.rate * len(x) / (2 * count)
    gradient = jax.grad(chamfer.distance)
    return simulator.step(x, b, grip, sweeps=config.sweeps, residual=lambda y: -rate * gradient(y, cloud))
