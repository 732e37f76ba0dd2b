"""From clouds whose points have no identities to particles: the paper's joint estimation of state and attachments.

A mesh is laid over the clouds of the sheet at rest. Each later cloud is met by one step of the simulator f', in whose
sweeps the gradient of the chamfer distance takes part (`xpbd`, `chamfer`), with the attachments believed so far: the
state of a frame depends on the belief, and the belief on the states. A particle's observation is then the mean of the
points around it, along the sheet's normal. A cloud shows where the surface is, and not which point of it: along it the
particles are where the simulator takes them, and are stated to be known no better than to `SLIDE`. Where the sheet
slides within its own surface, nothing is seen.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Bool, Float
from scipy.spatial import KDTree

from jiggle_mj.errors import PerceptionError
from jiggle_mj.estimate import Sheet
from jiggle_mj.mesh_checks import check_mesh
from jiggle_mj.observation import Declaration, MeasuredPoints
from jiggle_mj.sheet_triangulation import SheetPlane, triangulate

from ..physics.environment import Grip
from ..physics.mesh import SheetMesh
from ..physics.simulator import simulator
from ..physics.xpbd import XPBD
from .chamfer import Chamfer
from .point_tracker import FEWEST
from .track import UNSEEN_VARIANCE, Track

LONGEST_EDGE = 2.5
"""Triangles with a longer edge are no tissue [spacing]."""
THINNED = 0.75
"""Least distance of two particles, which are then about one apart [spacing]."""
AROUND = 0.7
"""Points of the clouds at rest within this distance give a particle its height [spacing]."""
SAMPLES = 3000
"""Points on the mesh; of a larger cloud so many are used."""
REACH = 0.15
"""See `Chamfer` [spacing]. From about 0.3 on, an edge of the view draws in what is hidden behind it."""
SWEEPS = 120
"""Of the step that meets a cloud. The paper's 20 leave a lifted corner behind the cloud, and what is behind is taken to
be held back."""
RATE = 0.6
"""Share of the way to a cloud that an even shift of it moves the sheet in one sweep: the paper's alpha, made free of
the number of points."""
SLIDE = 5e-3
"""Standard deviation of a particle's place along the surface [m]."""


def lay_mesh(still: list[MeasuredPoints], *, spacing: float) -> Sheet:
    """A mesh over clouds of the sheet at rest: points of the largest, thinned from the outline on, at all their height.

    Raises:
        PerceptionError: too small a sheet for the spacing.
        MeshError: two sheets.
    """
    clouds = [one.positions[np.isfinite(one.positions).all(axis=1)] for one in still]
    largest = max(clouds, key=len)
    if len(largest) < FEWEST:
        raise PerceptionError(f"the clouds at rest have {len(largest)} points at most; a sheet needs {FEWEST}.")
    plane = SheetPlane.through(np.concatenate(clouds))
    flat = plane.flatten(largest)
    flat = np.concatenate([flat[on_outline := outline(flat, spacing)], flat[~on_outline]])
    chosen = flat[thinned(flat, THINNED * spacing)]
    if len(chosen) < FEWEST:
        raise PerceptionError(
            f"the clouds at rest give {len(chosen)} particles at a spacing of {spacing * 1e3:.1f} mm; a sheet needs "
            f"{FEWEST} (more points, or a smaller EstimatorConfig.spacing)."
        )
    faces = triangulate(chosen, LONGEST_EDGE * spacing)
    used, faces = np.unique(faces, return_inverse=True)
    everything = np.concatenate(clouds)
    around = KDTree(plane.flatten(everything)).query_ball_point(chosen[used], AROUND * spacing)
    above = (everything - plane.centre) @ plane.axes[2]
    height = np.array([above[near].mean() for near in around])
    rest = plane.raise_up(chosen[used]) + height[:, None] * plane.axes[2]
    check_mesh(rest, faces.reshape(-1, 3))
    return Sheet(rest=rest, faces=faces.reshape(-1, 3))


def outline(flat: Float[np.ndarray, "m 2"], spacing: float) -> Bool[np.ndarray, " m"]:
    """Which points the sheet ends with; gaps up to the spacing are no end."""
    edges = np.sort(triangulate(flat, spacing)[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    pairs, count = np.unique(edges, axis=0, return_counts=True)
    found = np.zeros(len(flat), bool)
    found[pairs[count == 1]] = True
    return found


def thinned(flat: Float[np.ndarray, "m 2"], spacing: float) -> list[int]:
    """Points of which no two are nearer than the spacing, taken in order."""
    near = KDTree(flat).query_ball_point(flat, spacing)
    free, chosen = np.ones(len(flat), bool), []
    for i, around in enumerate(near):
        if free[i]:
            chosen.append(i)
            free[around] = False
    return chosen


class CloudTracker:
    """Follows one sheet through a recording of clouds."""

    def __init__(self, sheet: Sheet, declaration: Declaration):
        mesh = SheetMesh(sheet.rest, sheet.faces)
        self._simulator = simulator(mesh, declaration)
        self._chamfer = Chamfer.build(mesh, count=SAMPLES, reach=REACH * mesh.spacing)
        self._faces, self._around = sheet.faces, AROUND * mesh.spacing

    def track(
        self, points: MeasuredPoints, before: Float[np.ndarray, "n 3"], b: Float[np.ndarray, " n"], grip: Grip
    ) -> Track:
        """Meet one cloud from the state before it, the tip having moved, with attachments b [N/m]."""
        cloud = points.positions[np.isfinite(points.positions).all(axis=1)]
        if not len(cloud):
            return Track.of_nothing(len(before))
        cloud = cloud[np.linspace(0, len(cloud), min(len(cloud), SAMPLES), endpoint=False).astype(int)]
        filled = np.full((SAMPLES, 3), np.nan)
        filled[: len(cloud)] = cloud
        state = jnp.asarray(before), jnp.asarray(b), grip, jnp.asarray(filled)
        x = np.asarray(_met(self._simulator, self._chamfer, *state))
        normal = trimesh.Trimesh(x, self._faces, process=False).vertex_normals
        off = offset(x, normal, cloud, self._around)
        x, seen = x + normal * off[:, None], np.isfinite(off)
        across = normal[:, :, None] * normal[:, None, :]
        covariance = points.sd**2 * across + SLIDE**2 * (np.eye(3) - across)
        unseen = UNSEEN_VARIANCE * np.eye(3)
        return Track(
            positions=np.where(seen[:, None], x, np.nan),
            covariance=np.where(seen[:, None, None], covariance, unseen),
            visible=seen,
        )


def offset(
    x: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "n 3"], cloud: Float[np.ndarray, "q 3"], around: float
) -> Float[np.ndarray, " n"]:
    """How far along its normal each particle is from the mean of the points around it, NaN where there are none [m].

    What the simulator's forces and the cloud's pull left between them, which a filter would take for forces.
    """
    near = KDTree(cloud).query_ball_point(x, around)
    count = np.array([len(points) for points in near])
    particle = np.repeat(np.arange(len(x)), count)
    point = np.concatenate([np.asarray(points, int) for points in near])
    above = np.sum((cloud[point] - x[particle]) * normal[particle], axis=1)
    return np.bincount(particle, above, len(x)) / np.where(count > 0, count, np.nan)


@eqx.filter_jit
def _met(
    simulator: XPBD,
    chamfer: Chamfer,
    x: Float[Array, "n 3"],
    b: Float[Array, " n"],
    grip: Grip,
    cloud: Float[Array, "q 3"],
):
    count = jnp.sum(jnp.where(jnp.isfinite(cloud[:, 0]), 1.0, 0.0)) + len(chamfer.corners)
    rate = RATE * len(x) / (2 * count)
    slope = jax.grad(chamfer.distance)
    return simulator.step(x, b, grip, sweeps=SWEEPS, residual=lambda y: -rate * slope(y, cloud))
