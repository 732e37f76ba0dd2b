"""Tracker of measured points with identities: a mesh over the frames at rest, then a look-up by track id.

The estimator triangulates the points itself, unless a mesh is declared. Clouds without identities go to
`cloud_tracker`.
"""

from collections import Counter

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jiggle_mj.errors import PerceptionError
from jiggle_mj.estimate import Sheet
from jiggle_mj.mesh_checks import check_mesh
from jiggle_mj.observation import DeclaredMesh, MeasuredPoints
from jiggle_mj.sheet_triangulation import SheetPlane, triangulate

from ..ranges import refuse_many_particles
from .config import PointTrackerConfig
from .point_noise import CombinedNoise
from .robust import usual
from .still_noise import StillNoise, measure
from .track import UNSEEN_VARIANCE, Track

MESH_CAUSE = "the declared mesh"
"""What gives so many particles, where it does, for the message."""


class PointTracker:
    """Tracker of one sheet in a recording of points."""

    def __init__(self, mesh: DeclaredMesh | None = None, config: PointTrackerConfig | None = None):
        self._declared, self._config = mesh, config or PointTrackerConfig()
        self.ids = np.empty(0, dtype=np.int64)
        """Track id of each particle, -1 where nothing is measured."""
        self.noise: CombinedNoise | None = None
        """Noise of the points, once there is a sheet."""
        self.fields: Float[Array, "n modes"] | None = None
        """The noise that neighbours share, as `Track.fields` has it, once there is a sheet."""

    def start(self, still: list[MeasuredPoints]) -> Sheet:
        """Return the mesh over the mean of one or more frames at rest; a declared mesh is returned unchanged.

        Points that are rarely seen, and points without a triangle, are dropped. So are a few frames in which the points
        lie elsewhere than in the others: the sheet has moved already.

        Raises:
            PerceptionError: points without identities, too few of them, or too many.
            MeshError: two sheets.
        """
        config, frames = self._config, [_by_id(points) for points in still]
        if self._declared is not None:
            refuse_many_particles(len(self._declared.vertices), MESH_CAUSE)
            self.ids = self._declared.track_id
            rest_variance = np.full(len(self.ids), _rest_variance(self._declared, frames, still[0].sd))
            sheet = Sheet(rest=self._declared.vertices, faces=self._declared.faces)
        else:
            ids = _seen_often(frames, config.min_seen_share)
            if len(ids) < config.min_points:
                raise PerceptionError(
                    f"{len(ids)} points are seen in at least {config.min_seen_share:.0%} of the {len(still)} frames at "
                    f"rest; a sheet needs {config.min_points}."
                )
            refuse_many_particles(len(ids), "one particle for each point")
            frames = _without_outliers(frames, np.asarray(ids), config)
            times = Counter(i for frame in frames for i in frame)
            rest = np.array([np.mean([frame[i] for frame in frames if i in frame], axis=0) for i in ids])
            self.ids = np.asarray(ids)
            flat = SheetPlane.through(rest).flatten(rest)
            edges = triangulate(flat, np.inf)[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
            longest = config.max_edge * np.median(np.linalg.norm(flat[edges[:, 0]] - flat[edges[:, 1]], axis=1))
            faces = triangulate(flat, float(longest))
            used, faces = np.unique(faces, return_inverse=True)
            self.ids = self.ids[used]
            faces = faces.reshape(-1, 3)
            check_mesh(rest[used], faces)
            sheet = Sheet(rest=rest[used], faces=faces)
            rest_variance = still[0].sd ** 2 / np.array([times[i] for i in self.ids.tolist()])
        self._rest_variance: Float[np.ndarray, " n"] = rest_variance
        self._still_sd = still[0].sd
        positions = np.array([_positions(frame, self.ids) for frame in frames])
        seen = np.asarray(np.isfinite(positions).all(axis=2).any(axis=0))
        self.noise = CombinedNoise.of(still[0], measure([positions], sheet.rest))
        self.fields = self._shared(self.noise.noise, sheet.rest, seen)
        counts = self.noise.measured or self.fields is not None
        self._least_sd = self.noise.noise.total_sd if counts else 0.0
        return sheet

    def _shared(
        self, noise: StillNoise, rest: Float[np.ndarray, "n 3"], seen: Bool[np.ndarray, " n"]
    ) -> Float[Array, "n modes"] | None:
        """Return the noise that neighbours share as fields [m], with that of the rest positions; None for none."""
        fields, _ = noise.fields(rest, seen)
        with_rest = fields * np.sqrt(1 + self._rest_variance / self._still_sd**2)[:, np.newaxis]
        return jnp.asarray(with_rest) if fields.shape[1] else None

    def track(self, points: MeasuredPoints) -> Track:
        """Return the particles of one frame, with the error of the rest positions in their covariance."""
        positions = _positions(_by_id(points), self.ids)
        visible = np.asarray(np.isfinite(positions).all(axis=1))
        rest = max(1.0, self._least_sd / self._still_sd) ** 2 * self._rest_variance
        variance = np.where(visible, max(points.sd, self._least_sd) ** 2 + rest, UNSEEN_VARIANCE)
        return Track(
            positions=positions,
            covariance=variance[:, None, None] * np.eye(3),
            visible=visible,
            fields=self.fields,
        )


def _by_id(points: MeasuredPoints) -> dict[int, np.ndarray]:
    """Return the finite points by their identity [m]."""
    if points.track_id is None:
        raise PerceptionError(
            "the points have no track_id, which says which point is which in every frame; track them, or record images."
        )
    seen = np.isfinite(points.positions).all(axis=1) & (points.track_id >= 0)
    return dict(zip(points.track_id[seen].tolist(), points.positions[seen], strict=True))


def _seen_often(frames: list[dict[int, np.ndarray]], share: float) -> list[int]:
    """Return the identities that at least a share of the frames show, in order."""
    times = Counter(i for frame in frames for i in frame)
    return sorted(i for i, count in times.items() if count >= share * len(frames))


def _without_outliers(
    frames: list[dict[int, np.ndarray]], ids: Int[np.ndarray, " n"], config: PointTrackerConfig
) -> list[dict[int, np.ndarray]]:
    """Return the frames without a few in which the points lie elsewhere than in most."""
    positions = np.array([_positions(frame, ids) for frame in frames])
    squared = (positions - np.nanmedian(positions, axis=0)) ** 2
    distance = np.nansum(squared, axis=(1, 2)) / np.maximum(np.isfinite(squared).sum(axis=(1, 2)), 1)
    kept = usual(distance, times=config.outlier_ratio, rarely=config.max_outlier_share)
    return [frame for frame, keep in zip(frames, kept, strict=True) if keep]


def _positions(frame: dict[int, np.ndarray], ids: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Return the position of each particle in a frame [m], NaN where unseen."""
    unseen = np.full(3, np.nan)
    return np.array([frame.get(i, unseen) for i in ids.tolist()])


def _rest_variance(mesh: DeclaredMesh, frames: list[dict[int, np.ndarray]], sd: float) -> float:
    """Return the variance of a declared mesh's coordinates: its error against frames at rest, minus their noise [m^2].

    A mesh that is one of these frames has that frame's noise. So has, by assumption, a mesh that a frame does not show.
    """
    error = np.array([_positions(frame, mesh.track_id) for frame in frames]) - mesh.vertices
    if (np.nansum(np.abs(error), axis=(1, 2)) == 0).any():
        return sd**2
    return float(np.clip(np.nanmean(error**2) - sd**2, 0, sd**2))
