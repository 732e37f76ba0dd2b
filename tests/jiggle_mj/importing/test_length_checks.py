"""Lengths and places of recording.toml in the unit of the data, or in cm: refused with the unit that they need."""

import pytest

from jiggle_mj.errors import RecordingError
from tests.support.measured_folder import TOML, bring_in, folder

PULL = "start = [0, 0, {z}]\ndirection = [0, 0, 1]\nstep = {step}"
"""A straight pull in place of held rows."""
TRUTH = "attached_at = {at}\nattached_within = {within}"
"""A region in place of attached rows."""
ROWS, ATTACHED = "rows = [0, 1]", "attached_rows = [11, 12]\nattached_rows_first = 1"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (ROWS, f"{ROWS}\nradius = 2", r"\[grasp\] radius is 2 m, and the sheet is 0.006 m large: .* in metres"),
        (ROWS, f"{ROWS}\nradius = 0.2", "radius is 0.2 m"),
        (ROWS, "at = [0, 0, 5e-3]\nradius = 2", "radius is 2 m"),
        (ROWS, "at = [0, 0, 5]\nradius = 2e-3", "at is away from the points by 4.995 m"),
        (ROWS, PULL.format(z=5e-3, step=1), "step makes 2 m"),
        (ROWS, PULL.format(z=5, step=1e-3), "start is away from the points by 4.995 m"),
        ("[grasp]", "[mesh]\nmargin = 5\n[grasp]", r"\[mesh\] margin is 5 m"),
        ("noise_sd = 1e-4", "point_sd = 1e-4\nsmooth_sd = 1e-4\nsmooth_length = 10", "smooth_length is 10 m"),
        ("[grasp]", "[mesh]\nmargin = 5e-3\nspacing = 1\n[grasp]", r"\[mesh\] spacing is 1 m"),
        (
            "[grasp]",
            "[mesh]\noutline = [[-2, -2], [9, -2], [9, 7], [-2, 7]]\nspacing = 6e-3\n[grasp]",
            r"\[mesh\] outline is 11 m",
        ),
        (
            "[grasp]",
            "[mesh.extend]\naxis = [1, 0, 0]\nbegin = -0.002\nend = 9\nspacing = 2e-3\n[grasp]",
            r"\[mesh.extend\] end is beyond the points by 8.994 m",
        ),
        (
            "[grasp]",
            "[mesh.extend]\naxis = [1, 0, 0]\nbegin = -0.002\nend = 0.009\nspacing = 2\n[grasp]",
            r"\[mesh.extend\] spacing is 2 m",
        ),
        (ATTACHED, TRUTH.format(at=[6, 4, 5], within=2e-3), "attached_at is away from the points by 8.7"),
        (ATTACHED, TRUTH.format(at=[6e-3, 4e-3, 5e-3], within=2), "attached_within is 2 m"),
    ],
)
def test_a_length_that_no_sheet_of_this_size_has_is_refused_with_its_unit(tmp_path, old, new, message):
    """The sheet is 6 x 4 mm."""
    assert old in TOML
    with pytest.raises(RecordingError, match=message):
        bring_in(folder(tmp_path, toml=TOML.replace(old, new, 1)))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (ROWS, "at = [0, 0, 5e-3]\nradius = 2e-3"),
        (ROWS, PULL.format(z=0.04, step=0.02)),
        ("[grasp]", "[mesh]\nmargin = 0.047\nspacing = 6e-3\n[grasp]"),
        ("[grasp]", "[mesh]\noutline = [[-20e-3, -20e-3], [27e-3, -20e-3], [27e-3, 20e-3], [-20e-3, 20e-3]]\n[grasp]"),
        (ATTACHED, TRUTH.format(at=[6e-3, 4e-3, 5e-3], within=0.04)),
    ],
)
def test_lengths_of_up_to_eight_sheets_are_read(tmp_path, old, new):
    assert bring_in(folder(tmp_path, toml=TOML.replace(old, new, 1)))[0].n_frames == 3
