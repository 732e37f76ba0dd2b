"""The survey of a recording: its size, times, motion and noise in numbers, from one pass and no estimator.

Few images are decoded, so a survey takes little longer than reading the file.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from ..camera import StereoCamera
from ..observation import MeasuredForce, ToolState
from ..recording.reader import Recording
from .closed_tool import NS, ClosedTool
from .cloud_motion import CloudMotion
from .declaration_problems import declaration_problems
from .force_problems import force_problems
from .grip_share import grip_share
from .held_motion import HeldMotion
from .image_problems import image_problems
from .increments import increments
from .point_motion import PointMotion, common, extent, nearest_distance, spacing
from .point_problems import point_problems
from .problem import RecordingProblem
from .tool_problems import empty_grips, outliers, tip_offset, vertical, why_apart

COMPARED_FRAMES = 40
"""Most frames in which points are compared with their neighbours, evenly over the recording, which bounds the time."""


@dataclass(frozen=True, kw_only=True)
class Survey:
    """What a recording holds, in numbers. None: it cannot be known from what the recording has."""

    sensing: Literal["stereo", "points", "cloud", "nothing"]
    """What is seen: stereo images, points with identities, or points without; nothing if no frame can be used."""
    frames: int
    """Usable frames."""
    first_skipped: str
    """Why the first unusable frame cannot be used; empty without one."""
    skipped: int
    """Frames that cannot be used."""
    span_s: float
    """Time from the first usable frame to the last [s]."""
    period_s: float | None
    """Median time from frame to frame [s]."""
    largest_gap_s: float | None
    """Longest time from frame to frame while one grasp holds [s]."""
    points: int | None
    """Points in the first frame that has any."""
    extent_m: float | None
    """Longest side of the box around the points at rest [m]."""
    spacing_m: float | None
    """Median distance of a point to its nearest neighbour at rest [m]."""
    unseen: float | None
    """Share of the points that are not seen, over all frames."""
    points_motion_m: float | None
    """Largest distance of the points from where they were first; 95th percentile over the points [m]."""
    held_motion_m: float | None
    """Largest mean displacement of the held points since the jaws closed [m]."""
    grip_share: float | None
    """Smallest share of the sheet's points, or of the declared mesh's vertices, that the tool holds in a grasp."""
    missing_tracks: tuple[int, ...]
    """Held tracks that no point has."""
    grasps: int
    """Number of grasps with closed jaws."""
    closed_frames: int
    """Frames with closed jaws."""
    tool_by_points: bool
    """Whether the tool's position is only that of the held points."""
    tool_distance_m: float | None
    """Largest distance of the tool from what it holds when the jaws close [m]."""
    tool_motion_m: float
    """Largest distance of the tool from where the jaws closed, while they are closed [m]."""
    tool_path_m: float
    """Length of the tool's path while the jaws are closed [m]."""
    tool_speed_m_s: float | None
    """Largest speed of the tool from frame to frame while the jaws are closed [m/s]."""
    tool_gap_m: float | None
    """Largest difference of the tool's displacement and that of the held points, since the jaws closed [m]."""
    why_apart: RecordingProblem | None
    """What explains that tool and held points move differently."""
    declared_sd_m: float | None
    """Noise of a coordinate as the recording states it [m]."""
    noise_sd_m: float | None
    """Noise of a coordinate as it is measured [m]."""
    noise_from: Literal["still frames", "neighbours"] | None
    """What it is measured from: frames before the jaws close, or how single points stray from their neighbours."""
    image_size: tuple[int, int] | None
    """Width and height of the images [px]."""
    baseline_m: float | None
    """Distance between the two cameras [m]."""
    tool_depth_m: float | None
    """Median distance of the tool from the camera, along its optical axis, when the jaws close [m]."""
    tool_disparity_px: float | None
    """Disparity at that distance [px]."""
    tool_in_view: bool | None
    """Whether the tool is inside the left image whenever the jaws close."""
    doubts: tuple[RecordingProblem, ...]
    """What only the frames themselves show: about the tool, the bed under what it lifts, which point is which, and the
    images."""
    declared: bool
    """Whether the recording declares the tissue; else the defaults hold."""
    mesh_declared: bool
    """Whether it declares the sheet's mesh at rest; else the first frames show it."""


def survey(recording: Recording) -> Survey:
    """Return what a recording holds in numbers, from one pass over its usable frames, and from a few images.

    Args:
        recording: an open recording; iterating it anew afterwards begins at its first frame.
    """
    motion, closed, times, track, cloud = PointMotion(), ClosedTool(), list[int](), HeldMotion(), CloudMotion()
    shares, distances, mesh = list[float](), list[float](), recording.declaration.mesh
    tools: list[tuple[int, ToolState]] = []
    forces: list[tuple[ToolState, MeasuredForce | None]] = []
    stride = max(1, len(recording) // COMPARED_FRAMES)
    first_cloud: Float[np.ndarray, "m 3"] | None = None
    declared_sd: float | None = None
    identified = False
    for observation in recording.without_images():
        times.append(observation.time)
        tools.append((observation.index, observation.tool))
        forces.append((observation.tool, observation.force))
        points, held = observation.points, np.full(3, np.nan)
        begins, n_first = closed.begins(observation), 0 if first_cloud is None else len(first_cloud)
        if begins:
            motion.release()
        if points is not None and len(points.positions):
            declared_sd = points.sd if declared_sd is None else declared_sd
            identified |= points.track_id is not None
            if begins:
                shares.append(grip_share(observation.tool, points, mesh, known=motion.n_points or n_first))
                distances.append(
                    nearest_distance(points.positions, observation.tool.position)
                    if points.track_id is None
                    else motion.close(points, observation.tool)
                )
            if points.track_id is not None:
                still, compare = not closed.frames and not observation.tool.closed, len(times) % stride == 0
                held = motion.add(points, observation.tool, still=still, compare=compare)
            first_cloud = points.positions if first_cloud is None else first_cloud
        cloud.add(observation)
        closed.add(observation, held, motion.held_at_closing)
        track.add(observation, motion.held_at_closing + held, None if points is None else motion.positions)
    skipped = list(recording.skipped)
    rest = motion.rest if motion.rest is not None else first_cloud
    if motion.still_sd is not None:
        noise_sd, noise_from = motion.still_sd, "still frames"
    else:
        noise_sd, noise_from = motion.neighbour_sd, None if motion.neighbour_sd is None else "neighbours"
    steps = np.diff(times)
    seen = "points" if identified else "cloud" if first_cloud is not None else "nothing"
    depth, disparity, in_view = _in_camera(recording.camera, [tool.position for tool in closed.closings])
    distances = [distance for distance in distances if np.isfinite(distance)]
    left = None if recording.camera is None else recording.camera.left
    sd, apart = noise_sd or 0.0, None if rest is None else spacing(rest)
    why = None if closed.by_points else why_apart(track, noise_sd=sd)
    doubts = list[RecordingProblem]()
    doubts += point_problems(motion)
    doubts += cloud.problems()
    if recording.declared:
        doubts += declaration_problems(recording.declaration, None if rest is None else extent(rest))
    if rest is not None:
        gravity = np.array(recording.declaration.gravity)
        if not closed.by_points:
            doubts += increments(track)
        if not closed.by_points and why is None:
            doubts += outliers(track, noise_sd=sd)
            doubts += tip_offset(track, spread=motion.held_spread, spacing=apart or 0.0)
        if recording.declaration.mesh is None:
            radius = max((tool.radius for tool in closed.closings if not tool.held_tracks), default=np.inf)
            doubts += empty_grips(distances, reach=radius + (apart or 0.0))
        if recording.declaration.bed and gravity.any():
            doubts += vertical(track, rest, gravity, noise_sd=sd)
    return Survey(
        sensing="stereo" if recording.camera is not None and times else seen,
        frames=len(times),
        first_skipped=skipped[0][1] if skipped else "",
        skipped=len(skipped),
        span_s=(times[-1] - times[0]) * NS if times else 0.0,
        period_s=float(np.median(steps)) * NS if len(steps) else None,
        largest_gap_s=None if closed.largest_gap_ns is None else closed.largest_gap_ns * NS,
        points=None if rest is None else len(rest),
        extent_m=None if rest is None else extent(rest),
        spacing_m=apart,
        unseen=1 - motion.n_seen / motion.n_expected if motion.n_expected else None,
        points_motion_m=motion.largest if motion.n_expected else None,
        held_motion_m=closed.held,
        grip_share=min(shares, default=None),
        missing_tracks=motion.missing_tracks,
        grasps=len(closed.grasps),
        closed_frames=closed.frames,
        tool_by_points=closed.by_points,
        tool_distance_m=max(distances) if distances else None,
        tool_motion_m=closed.motion,
        tool_path_m=closed.path,
        tool_speed_m_s=closed.speed,
        tool_gap_m=closed.gap,
        why_apart=why,
        declared_sd_m=declared_sd,
        noise_sd_m=noise_sd,
        noise_from=noise_from,
        image_size=None if left is None else (left.width, left.height),
        baseline_m=None if recording.camera is None else recording.camera.baseline,
        tool_depth_m=depth,
        tool_disparity_px=disparity,
        tool_in_view=in_view,
        doubts=(*doubts, *image_problems(recording, tools), *force_problems(recording, forces)),
        declared=recording.declared,
        mesh_declared=mesh is not None,
    )


def _in_camera(
    camera: StereoCamera | None, places: list[Float[np.ndarray, " 3"]]
) -> tuple[float | None, float | None, bool | None]:
    """Return the median depth of places [m], the disparity there [px], and whether all are in the left image."""
    if camera is None or not places:
        return None, None, None
    world = np.array(places)
    depths = camera.in_camera(world)[:, 2]
    depth = common(depths.tolist())
    if depth is None or (depths <= 0).any():
        return depth, None, False
    uvd = camera.project(world)
    inside = (uvd[:, :2] >= 0).all() and (uvd[:, :2] < (camera.left.width, camera.left.height)).all()
    return depth, camera.focal[0] * camera.baseline / depth, bool(inside)
