"""What of a survey cannot be right, or deserves a look, each with its likely cure.

The ranges are wide: what they refuse is no recording of a thin sheet that a tool pulls, or would give a wrong answer
without a word. docs/RECORDINGS.md has them as a table.
"""

from collections.abc import Iterator
from dataclasses import replace

from .problem import RecordingProblem, metres, seconds, warning
from .survey import Survey
from .tool_fits import APART
from .tool_problems import NOISE_MULTIPLES

MAX_NOISE_RATIO = 2.0
"""Largest ratio of the measured to the declared noise that is no doubt yet."""
REFUSED_EXTENT_M, DOUBTED_EXTENT_M = (1e-3, 10.0), (5e-3, 2.0)
"""Extent of the sheet [m]: outside the first it is refused, outside the second doubted. A corneal flap is 8 mm wide, a
bed sheet 2 m; between metres and millimetres lies a factor of 1000."""
MAX_TOOL_DISTANCE_M, DOUBTED_TOOL_DISTANCE = 1.0, 1.0
"""Distance of the tool from what it holds: above the first [m] and above three extents of the sheet it is refused;
above the second [extents of the sheet] doubted. A robot reports its flange at times, up to some 0.3 m from the tip."""
FARTHEST_EXTENTS = 3.0
"""Distance of the tool that no large sheet explains [extents of the sheet]."""
STILL_SHARE = 0.1
"""Share of the held points' motion below which the tool counts as standing still, and the other way round."""
MIN_BASELINE_M, DOUBTED_BASELINE_M = 1e-4, (1e-3, 0.5)
"""Distance between the cameras [m]: a stereo endoscope has 4 to 6 mm, a wide bench rig 0.3 m. `StereoCamera` refuses
one above 1 m."""
MAX_DISPARITY_SHARE = 0.5
"""Largest disparity at the tool that can be matched [image width], the search range of `SemiGlobalMatching`."""
MAX_DEPTH_M = 10.0
"""Largest distance of the tool from the camera [m]: a pixel is then larger than the mesh's spacing."""
REFUSED_PERIOD_S, DOUBTED_PERIOD_S = (1e-6, 1e5), (1e-3, 30.0)
"""Time from frame to frame [s]: high-speed cameras reach 1 ms, slow test machines some seconds a frame. Below 1 us and
above a day the unit is wrong."""
GAP_PERIODS, MIN_GAP_S = 20.0, 1.0
"""A gap within one grasp is named above both [median periods; s]: creep and slip then happen unseen."""
MAX_TOOL_SPEED_M_S = 5.0
"""Speed of the tool that is doubted [m/s]: robot arms reach 2 m/s."""
MAX_UNSEEN = 0.5
"""Share of unseen points that is doubted."""
MAX_HELD = 0.5
"""Share of the sheet in the grip that is doubted: attachments show in points that are not held."""


def problems(survey: Survey) -> tuple[RecordingProblem, ...]:
    """Return all problems of a surveyed recording, those that refuse it first."""
    found = [*_use(survey), *_size(survey), *_times(survey), *_camera(survey), *_tool(survey), *_noise(survey)]
    found += survey.doubts
    return tuple(sorted(found, key=lambda problem: not problem.refuses))


def _use(survey: Survey) -> Iterator[RecordingProblem]:
    """Find what leaves nothing to estimate from."""
    if not survey.frames:
        yield _refuse(
            "no-frame", f"none of the {survey.skipped} frames can be used; the first one: {survey.first_skipped}."
        )
        return
    if survey.frames == 1 and not survey.mesh_declared:
        yield _refuse("one-frame", "one frame only, in which nothing moves; give those of a pull, the first at rest.")
        return
    if not survey.closed_frames:
        yield _refuse(
            "no-grasp", "the jaws are never closed; the estimator learns from frames in which the tool pulls."
        )
        return
    if survey.grasps == 1:
        yield warning("one-grasp", "one grasp only: several, at different places, show more of the attachments.")
    if survey.sensing == "cloud":
        yield warning(
            "no-identities",
            "points are not the same from frame to frame, as they have no track_id: only the shape of the surface "
            "shows, not what slides along it.",
        )
    if survey.missing_tracks:
        named = ", ".join(map(str, survey.missing_tracks[:5]))
        text = f"held tracks that no point has: {named}; give the numbers as in the points' track_id."
        yield _problem("held-tracks", text, refuses=survey.held_motion_m is None)
    if survey.grip_share is not None and survey.grip_share > MAX_HELD:
        yield _problem(
            "grip-share",
            f"the tool always holds {survey.grip_share:.0%} of the sheet's points, or more; is the radius of the grip "
            "in metres, and are the held rows right?",
            refuses=survey.grip_share == 1,
        )
    if survey.unseen is not None and survey.unseen > MAX_UNSEEN:
        yield warning("unseen", f"{survey.unseen:.0%} of the points are not seen; is a missing value read as such?")


def _size(survey: Survey) -> Iterator[RecordingProblem]:
    """Find a sheet in the wrong unit."""
    size = survey.extent_m
    if size is None:
        return
    if not size > 0:
        yield _refuse("extent", "all points are at one place; are the columns x, y, z the right ones?")
    elif not _within(size, REFUSED_EXTENT_M):
        unit = "millimetres called metres" if size > 1 else "metres called millimetres"
        yield _refuse(
            "extent",
            f"the sheet is {metres(size)} wide; {metres(REFUSED_EXTENT_M[0])} to {metres(REFUSED_EXTENT_M[1])} can be. "
            f"Are these {unit}? Lengths of a recording are in metres; set 'unit' in recording.toml.",
        )
    elif not _within(size, DOUBTED_EXTENT_M):
        yield warning("extent", f"the sheet is {metres(size)} wide; is the unit of length right?")


def _times(survey: Survey) -> Iterator[RecordingProblem]:
    """Find times in the wrong unit, and gaps."""
    period, gap = survey.period_s, survey.largest_gap_s
    if period is None:
        return
    if not _within(period, REFUSED_PERIOD_S):
        yield _refuse(
            "period",
            f"a frame comes every {seconds(period)}; times are in seconds (are these milliseconds or nanoseconds?).",
        )
    elif not _within(period, DOUBTED_PERIOD_S):
        yield warning(
            "period", f"a frame comes every {seconds(period)}; are the times in seconds, not in milliseconds or ns?"
        )
    if gap is not None and gap > max(GAP_PERIODS * period, MIN_GAP_S):
        yield warning("gap", f"{seconds(gap)} without a frame while the jaws are closed, where one comes every "
                    f"{seconds(period)}; are frames lost, or is a release missing?")  # fmt: skip


def _camera(survey: Survey) -> Iterator[RecordingProblem]:
    """Find a camera that cannot see the tool, or whose baseline has the wrong unit."""
    baseline, size = survey.baseline_m, survey.image_size
    if baseline is None or size is None:
        return
    if baseline < MIN_BASELINE_M:
        yield _refuse(
            "baseline",
            f"the cameras are {metres(baseline)} apart; {metres(MIN_BASELINE_M)} or more can be. The right P[0,3] is "
            "-fx * baseline in px m: was it divided by 1000 though it was in metres?",
        )
        return
    if not _within(baseline, DOUBTED_BASELINE_M):
        yield warning("baseline", f"the cameras are {metres(baseline)} apart; is the baseline in metres?")
    depth, disparity = survey.tool_depth_m, survey.tool_disparity_px
    if depth is None:
        return
    if depth <= 0 or depth > MAX_DEPTH_M:
        where = "behind the camera" if depth <= 0 else f"{metres(depth)} from the camera"
        yield _refuse(
            "tool-depth",
            f"the tool is {where} when the jaws close; are /tf (world to the left optical frame, z forward) and the "
            "tool's pose in metres, and of one world?",
        )
    elif disparity is not None and disparity > MAX_DISPARITY_SHARE * size[0]:
        yield _refuse(
            "disparity",
            f"at the tool, {metres(depth)} from the camera, the disparity is {disparity:.0f} px of an image "
            f"{size[0]} px wide; at most half of it can be matched: are baseline and poses in one unit?",
        )
    elif not survey.tool_in_view:
        yield warning("tool-view", "the tool is outside the left image when the jaws close; do /tf and its pose fit?")


def _tool(survey: Survey) -> Iterator[RecordingProblem]:
    """Find a tool that is elsewhere, or of another clock, and a sheet that does not move."""
    if survey.why_apart is not None and survey.why_apart.refuses:
        yield survey.why_apart
        return
    distance, size = survey.tool_distance_m, survey.extent_m
    if distance is not None and size is not None and not survey.tool_by_points:
        if distance > max(MAX_TOOL_DISTANCE_M, FARTHEST_EXTENTS * size):
            yield _refuse(
                "tool-distance",
                f"the tool is {metres(distance)} from the points that it holds, on a sheet {metres(size)} wide; is its "
                "position in the unit and the frame of the points (millimetres, another origin)?",
            )
            return
        if distance > DOUBTED_TOOL_DISTANCE * size:
            yield warning(
                "tool-distance",
                f"the tool is {metres(distance)} from the points that it holds, on a sheet {metres(size)} wide; is it "
                "the tip that is reported, in the frame of the points?",
            )
    if not survey.closed_frames:
        return
    held, tool = survey.held_motion_m, survey.tool_motion_m
    noise = NOISE_MULTIPLES * (survey.noise_sd_m or 0.0)
    if (held is None or held <= noise) and tool <= noise and (survey.closed_frames > 1 or not survey.tool_by_points):
        if survey.points_motion_m is None:
            yield warning("tool-still", "the tool does not move; nothing can be learned from it.")
        elif survey.points_motion_m <= noise:
            yield _refuse(
                "no-motion",
                f"nothing moves: tool {metres(tool)}, held points {metres(held or 0.0)}, noise "
                f"{metres(noise / NOISE_MULTIPLES)}; are these reference coordinates, to which displacements must be "
                "added, or one frame many times?",
            )
        elif survey.sensing == "points":
            them = "those that the tool holds " + ("do not" if held is not None else "are never seen while it pulls")
            yield warning("held-still", f"points move, and {them}; are the held rows right?")
    still = held is not None and tool < STILL_SHARE * held
    apart = held is not None and survey.tool_gap_m is not None and survey.tool_gap_m > max(held, tool) + noise
    if survey.why_apart is not None:
        yield replace(survey.why_apart, refuses=apart or still)
        return
    if held is None or survey.tool_by_points or max(held, tool) <= noise:
        return
    if still:
        yield _refuse(
            "tool-still",
            f"the tool moves {metres(tool)} while the points that it holds move {metres(held)}; do the clocks of tool "
            "and frames overlap (one since 1970 or in ms: tool_clock_offset, tool_time_unit), and are both in metres?",
        )
    elif held < STILL_SHARE * tool:
        yield warning(
            "held-still",
            f"the tool moves {metres(tool)} and the points that it holds {metres(held)}; did they slip, are the held "
            "rows right, or is the tool's unit or clock another one?",
        )
    elif apart and survey.tool_gap_m is not None:
        yield _refuse(
            "tool-apart",
            f"tool and held points move apart by {metres(survey.tool_gap_m)}, further than either moves "
            f"({metres(tool)} and {metres(held)}): one moves while the other stands, or the other way. Is the tool's "
            "clock late, or its frame another one?",
        )
    elif survey.tool_gap_m is not None and survey.tool_gap_m > max(APART * max(held, tool), noise):
        yield warning(
            "tool-gap",
            f"tool and held points move apart by {metres(survey.tool_gap_m)} while they move {metres(held)}; does the "
            "tool's clock lag, does it turn without saying so, or do points slip?",
        )
    if survey.tool_speed_m_s is not None and survey.tool_speed_m_s > MAX_TOOL_SPEED_M_S:
        yield warning(
            "tool-speed", f"the tool moves at up to {survey.tool_speed_m_s:.3g} m/s; are times and unit right?"
        )


def _noise(survey: Survey) -> Iterator[RecordingProblem]:
    """Find a declared noise that the measured one contradicts."""
    declared, measured = survey.declared_sd_m, survey.noise_sd_m
    if declared is None or measured is None or survey.sensing != "points":
        return
    if measured > MAX_NOISE_RATIO * declared:
        yield warning(
            "noise",
            f"the noise is declared as {metres(declared)} and measured as {metres(measured)} ({survey.noise_from}); "
            "the larger one counts where still frames show it: set noise_sd to what is measured.",
        )
    elif survey.noise_from == "still frames" and declared > NOISE_MULTIPLES * measured > 0:  # 0: rounded, or none
        yield warning(
            "noise",
            f"the noise is declared as {metres(declared)}, and still frames show {metres(measured)}; unless it has "
            "parts that do not change with time, a smaller noise_sd shows more attachments.",
        )


def _within(value: float, limits: tuple[float, float]) -> bool:
    return limits[0] <= value <= limits[1]


def _problem(name: str, text: str, *, refuses: bool) -> RecordingProblem:
    return RecordingProblem(name=name, refuses=refuses, text=text)


def _refuse(name: str, text: str) -> RecordingProblem:
    return _problem(name, text, refuses=True)
