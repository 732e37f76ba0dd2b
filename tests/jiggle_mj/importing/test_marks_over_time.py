"""Marks of lost points that one frame alone does not show, and displacements that are taken for positions."""

import numpy as np
import pytest

from jiggle_mj.errors import RecordingError
from tests.support.measured_folder import TOML, bring_in, folder

FRAMES, HELD = 12, (0, 1, 8, 9)
TOML_OF_ARRAY = TOML.replace('files = ["rest.xyz", "pulled_*.xyz"]', 'files = ["d.npz"]\nkey = "p"').replace(
    "rows = [0, 1]", f"rows = {list(HELD)}"
)


def sheet() -> np.ndarray:
    """Frames of an 8 x 6 sheet of 5 mm pitch around the origin, whose corner rises by 20 mm; noise of 0.05 mm [mm]."""
    x, y = np.meshgrid(5.0 * np.arange(8) - 17.3, 5.0 * np.arange(6) - 12.4)
    rest = np.column_stack([x.ravel(), y.ravel(), np.full(48, 0.3)])
    decay = np.exp(-np.linalg.norm(rest - rest[0], axis=1) / 12)
    up = np.linspace(0, 20, FRAMES)[:, None, None] * decay[:, None] * np.array([0, 0, 1.0])
    return rest + up + np.random.default_rng(7).normal(scale=0.05, size=up.shape)


def notes(tmp_path, positions: np.ndarray, keys: str = "", **arrays: np.ndarray) -> tuple[str, ...]:
    """Import the positions; return the notes."""
    where = folder(tmp_path, toml=TOML_OF_ARRAY.replace('key = "p"', f'key = "p"\n{keys}'))
    np.savez(where / "d.npz", p=positions, **arrays)
    return bring_in(where)[0].notes


@pytest.mark.parametrize("mark", [(0, 0, 0), (-1, -1, -1), (3.25, -2, 0.5)])
def test_one_lost_point_a_frame_at_a_place_inside_the_sheet_is_refused(tmp_path, mark):
    positions = sheet()
    for k in range(1, FRAMES):
        positions[k, 5 * k % 48] = mark
    with pytest.raises(RecordingError, match=r"frame \d+ has 1 point at exactly .*give missing = \["):
        notes(tmp_path, positions)


@pytest.mark.parametrize("mark", [4e7, 4e7 + 0.4])
def test_a_place_of_lost_points_is_found_in_micrometres_far_from_the_origin(tmp_path, mark):
    """Numbers of 4e7 are rounded to 7e-9, which is more than a place in metres is."""
    positions = 1e3 * sheet() + 4e7
    for k in range(1, FRAMES):
        positions[k, 5 * k % 48] = mark
    where = folder(tmp_path, toml=TOML_OF_ARRAY.replace('unit = "mm"', 'unit = "um"'))
    np.savez(where / "d.npz", p=positions)
    with pytest.raises(RecordingError, match=r"11 points jump to it at different times.*give missing = \["):
        bring_in(where)


@pytest.mark.parametrize("depth", [120.0, 400.0])
def test_a_depth_that_is_lost_for_one_point_a_frame_is_refused(tmp_path, depth):
    positions = sheet() + np.array([0, 0, depth])
    for k in range(1, FRAMES):
        positions[k, 5 * k % 48, 2] = 0
    with pytest.raises(RecordingError, match=r"11 points jump to z = 0 at different times.*Write nan there"):
        notes(tmp_path, positions)


def test_a_sheet_that_leaves_0_has_lost_no_depth(tmp_path):
    positions = sheet()
    positions[:, :, 2] -= positions[:1, :, 2]
    positions[:, :, 2] += np.linspace(0, 80, FRAMES)[:, None]
    assert notes(tmp_path, positions, 'layout = "frames, points"') == ()


@pytest.mark.parametrize("mark", [0, -1, -999])
def test_a_row_that_is_at_a_mark_far_from_the_sheet_in_every_frame_is_refused(tmp_path, mark):
    positions = sheet() + 300
    positions[:, 20] = mark
    with pytest.raises(RecordingError, match=rf"rows 20 .*in every frame, far from all others.*missing = \[{mark}, "):
        notes(tmp_path, positions)


def test_a_row_that_is_at_a_mark_inside_the_sheet_in_every_frame_is_noted(tmp_path):
    positions = sheet()
    positions[:, 20] = 0
    (note,) = notes(tmp_path, positions)
    assert note.startswith("rows [20] from 0 are at exactly (0, 0, 0)") and "missing = [0, 0, 0]" in note


def test_a_point_at_the_origin_among_others_that_stand_still_is_not_noted(tmp_path):
    positions = sheet() - sheet()[0, 47]
    positions[:, 40:] = positions[0, 40:]
    assert notes(tmp_path, positions) == ()


@pytest.mark.parametrize("first", [0.0, 1e-2])
def test_displacements_without_coordinates_are_refused_as_such(tmp_path, first):
    """They begin at nothing, or at noise."""
    displacements = sheet() - sheet()[0]
    displacements[0] = np.random.default_rng(1).normal(scale=first, size=(48, 3)) if first else 0
    with pytest.raises(RecordingError, match=r"are these displacements\? Give the reference coordinates as points"):
        notes(tmp_path, displacements)


@pytest.mark.parametrize("lost", [None, HELD[0]])
def test_displacements_from_frame_to_frame_are_refused_as_such(tmp_path, lost):
    """The tool rises by 20 mm in eleven steps; a held point by one step at most, and one may be lost for a while."""
    positions, rise = sheet(), np.linspace(0, 20, FRAMES)
    tool = positions[0, list(HELD)].mean(axis=0) + rise[:, None] * np.array([0, 0, 1.0])
    positions[:, list(HELD)] = positions[0, list(HELD)] + (tool - tool[0])[:, None]
    steps = np.diff(positions, axis=0, prepend=positions[:1])
    if lost is not None:
        steps[4:6, lost] = np.nan
    toml = TOML_OF_ARRAY.replace("[grasp]", '[grasp]\ntool = "t"')
    where = folder(tmp_path, toml=toml.replace('key = "p"', 'key = "p"\ndisplacements = "u"'))
    np.savez(where / "d.npz", p=np.repeat(positions[:1], FRAMES, axis=0), u=steps, t=tool)
    with pytest.raises(
        RecordingError,
        match=r"stand still while the tool .* where these are displacements, give those from the rest frame",
    ):
        bring_in(where)


def test_rows_that_are_other_points_in_each_frame_are_refused_before_the_grasp_is_judged(tmp_path):
    """Most of a frame's rows change places in the first case, some in the second, as a tracker's mistakes."""
    rng = np.random.default_rng(2)
    shuffled = np.stack([frame[rng.permutation(48)] for frame in sheet()])
    with pytest.raises(RecordingError, match=r"48 points take places of others.*A row, or a track_id, must be"):
        notes(tmp_path, shuffled)
    few = sheet()
    few[6:, 30:40] = few[6:, np.roll(np.arange(30, 40), 1)]
    (tmp_path / "few").mkdir()
    assert notes(tmp_path / "few", few) == ()


def of_displacements(tmp_path, positions: np.ndarray, *, steps: bool) -> tuple[str, ...]:
    """Import the reference and displacements, from rest or from the frame before, without a tool; return the notes."""
    tmp_path.mkdir(exist_ok=True)
    moved = np.diff(positions, axis=0, prepend=positions[:1]) if steps else positions - positions[0]
    reference = np.repeat(positions[:1], len(positions), axis=0)
    return notes(tmp_path, reference, 'displacements = "u"\nmissing = "none"', u=moved)


RISES = {
    "steady": np.linspace(0, 20, 24),
    "up and back": 20 - np.abs(np.linspace(-20, 20, 24)),
    "eased": 20 * np.sin(np.linspace(0, np.pi / 2, 24)) ** 2,
    "back and forth": 10 * np.sin(2 * np.pi * np.arange(24) / 9),
    "still": np.zeros(24),
}


@pytest.mark.parametrize("noise", [1e-3, 0.05, 0.2])
@pytest.mark.parametrize("rise", RISES)
def test_displacements_from_rest_are_never_doubted(tmp_path, rise, noise):
    """A sheet of which a corner rises, with noise [mm]; and one that stands still."""
    assert of_displacements(tmp_path, lifted(RISES[rise], noise), steps=False) == ()


@pytest.mark.parametrize(("rise", "noise"), [("steady", 1e-3), ("steady", 0.2), ("up and back", 0.05)])
def test_displacements_from_frame_to_frame_are_doubted_without_a_tool(tmp_path, rise, noise):
    (note,) = of_displacements(tmp_path, lifted(RISES[rise], noise), steps=True)
    assert note.startswith("WARNING: are the displacements those from the frame before?")


def lifted(rise: np.ndarray, noise: float) -> np.ndarray:
    rest = sheet()[0]
    decay = np.exp(-np.linalg.norm(rest - rest[0], axis=1) / 12)
    up = rise[:, None, None] * decay[:, None] * np.array([0, 0, 1.0])
    return rest + up + np.random.default_rng(8).normal(scale=noise, size=up.shape)
