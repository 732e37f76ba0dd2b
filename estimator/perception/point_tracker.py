"""From measured points with identities to particles: a mesh over the first frames, then a look-up by track id.

The estimator triangulates the points anew, unless a mesh is declared. Clouds without identities go to
`cloud_tracker`.
"""

from collections import Counter

import numpy as np
from jaxtyping import Bool, Float, Int

from jiggle_mj.errors import PerceptionError
from jiggle_mj.estimate import Sheet
from jiggle_mj.mesh_checks import check_mesh
from jiggle_mj.observation import DeclaredMesh, MeasuredPoints
from jiggle_mj.sheet_triangulation import SheetPlane, triangulate

from .track import UNSEEN_VARIANCE, Track

LONGEST_EDGE = 2.5
"""Triangles with a longer edge are no tissue [medians of all edges]."""
FEWEST = 20
"""Fewest points that make a sheet."""
OFTEN = 0.5
"""Share of the frames at rest in which a point must be seen to become a particle."""
ASTRAY, FEW = 4.0, 0.25
"""Times the usual square of the points' distances from where they mostly are, beyond which a frame at rest is left out,
and the largest share of frames for which that holds: what is off more often is noise."""


class PointTracker:
    """Follows one sheet through a recording of points."""

    def __init__(self, mesh: DeclaredMesh | None = None):
        self._declared = mesh
        self.ids = np.empty(0, dtype=np.int64)
        """Track id of each particle, -1 where nothing is measured."""

    def start(self, still: list[MeasuredPoints]) -> Sheet:
        """Lay the mesh over the mean of one or more frames at rest; stray points and rarely seen ones are left out.

        So are a few frames in which the points lie elsewhere than in the others: something has moved already. A
        declared mesh stays as it is declared.

        Raises:
            PerceptionError: points without identities, or too few of them.
            MeshError: two sheets.
        """
        found = [_by_id(points) for points in still]
        if self._declared is not None:
            self.ids = self._declared.track_id
            rest_variance = np.full(len(self.ids), _rest_variance(self._declared, found, still[0].sd))
            sheet = Sheet(rest=self._declared.vertices, faces=self._declared.faces)
        else:
            ids = _often(found)
            if len(ids) < FEWEST:
                raise PerceptionError(
                    f"{len(ids)} points are seen in half of the {len(still)} frames at rest; a sheet needs {FEWEST}."
                )
            found = _alike(found, np.asarray(ids))
            times = Counter(i for frame in found for i in frame)
            rest = np.array([np.mean([frame[i] for frame in found if i in frame], axis=0) for i in ids])
            self.ids = np.asarray(ids)
            flat = SheetPlane.through(rest).flatten(rest)
            edges = triangulate(flat, np.inf)[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
            longest = LONGEST_EDGE * np.median(np.linalg.norm(flat[edges[:, 0]] - flat[edges[:, 1]], axis=1))
            faces = triangulate(flat, float(longest))
            used, faces = np.unique(faces, return_inverse=True)
            self.ids = self.ids[used]
            faces = faces.reshape(-1, 3)
            check_mesh(rest[used], faces)
            sheet = Sheet(rest=rest[used], faces=faces)
            rest_variance = still[0].sd ** 2 / np.array([times[i] for i in self.ids.tolist()])
        self._rest_variance: Float[np.ndarray, " n"] = rest_variance
        return sheet

    def track(self, points: MeasuredPoints) -> Track:
        """Look the particles up in one frame; the error of the rest positions is part of the covariance."""
        found = _by_id(points)
        positions = _positions(found, self.ids)
        visible = np.asarray(np.isfinite(positions).all(axis=1))
        variance = np.where(visible, points.sd**2 + self._rest_variance, UNSEEN_VARIANCE)
        return Track(positions=positions, covariance=variance[:, None, None] * np.eye(3), visible=visible)


def _by_id(points: MeasuredPoints) -> dict[int, np.ndarray]:
    """Finite points by their identity."""
    if points.track_id is None:
        raise PerceptionError(
            "the points carry no track_id; the filter must know which point is which (track them, or record images)."
        )
    seen = np.isfinite(points.positions).all(axis=1) & (points.track_id >= 0)
    return dict(zip(points.track_id[seen].tolist(), points.positions[seen], strict=True))


def _often(found: list[dict[int, np.ndarray]]) -> list[int]:
    """Identities that enough frames show, in order."""
    times = Counter(i for frame in found for i in frame)
    return sorted(i for i, count in times.items() if count >= OFTEN * len(found))


def _alike(found: list[dict[int, np.ndarray]], ids: Int[np.ndarray, " n"]) -> list[dict[int, np.ndarray]]:
    """Without a few frames in which the points are elsewhere than in most."""
    positions = np.array([_positions(frame, ids) for frame in found])
    squared = (positions - np.nanmedian(positions, axis=0)) ** 2
    off = np.nansum(squared, axis=(1, 2)) / np.maximum(np.isfinite(squared).sum(axis=(1, 2)), 1)
    return [frame for frame, kept in zip(found, usual(off, times=ASTRAY, rarely=FEW), strict=True) if kept]


def usual(squares: Float[np.ndarray, " t"], *, times: float, rarely: float) -> Bool[np.ndarray, " t"]:
    """All but those beyond that many times the median, if they are at most a share `rarely`; more are no exceptions."""
    beyond = squares > times * np.median(squares)
    return ~beyond if beyond.mean() <= rarely else np.ones(len(squares), dtype=bool)


def _positions(found: dict[int, np.ndarray], ids: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Of each particle, NaN where nothing was found."""
    unseen = np.full(3, np.nan)
    return np.array([found.get(i, unseen) for i in ids.tolist()])


def _rest_variance(mesh: DeclaredMesh, found: list[dict[int, np.ndarray]], sd: float) -> float:
    """Of each coordinate of a declared mesh [m^2]: how far it is from the frames at rest, beyond their own noise.

    A mesh that is one of these frames has that frame's noise; one that a frame shows nothing of is taken to have it.
    """
    off = np.array([_positions(frame, mesh.track_id) for frame in found]) - mesh.vertices
    if (np.nansum(np.abs(off), axis=(1, 2)) == 0).any():
        return sd**2
    return float(np.clip(np.nanmean(off**2) - sd**2, 0, sd**2))
