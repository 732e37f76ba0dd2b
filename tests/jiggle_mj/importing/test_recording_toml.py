"""A recording.toml with a mistake is refused, with key, value and what is allowed."""

import pytest

from jiggle_mj.errors import RecordingError
from jiggle_mj.importing.folder import import_folder
from tests.support.measured_folder import TOML, bring_in, folder


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('unit = "mm"', 'unit = "inch"', "unit must be one of m, cm, mm, um; got 'inch'"),
        ('unit = "mm"', "", r"lacks the key 'unit'\.$"),
        ('unit = "mm"', 'units = "mm"', r"lacks the key 'unit'; did you write 'units' for it\?"),
        ('unit = "mm"', 'Unit = "mm"', "did you write 'Unit' for it"),
        ('unit = "mm"', 'time_unit = "ms"', r"lacks the key 'unit'\.$"),
        ("noise_sd = 1e-4", "noise = 1e-4", "lacks the key 'noise_sd'; did you write 'noise' for it"),
        ("noise_sd = 1e-4", "noise_sd = 1e-4\npoint_sd = 1e-4", "noise_sd is all noise together, and point_sd a part"),
        ("noise_sd = 1e-4", "noise_sd = 1e-4\nsmooth_sd = 1e-4", "smooth_sd needs point_sd"),
        ("noise_sd = 1e-4", "point_sd = 1e-4\nsmooth_sd = 1e-4", "lacks the key 'smooth_length'"),
        ("noise_sd = 1e-4", "point_sd = 1e-4\nsmooth_length = 0.01", "smooth_length needs smooth_sd"),
        ("noise_sd = 1e-4", "point_sd = 1e-4\nsmooth_sd = -1", "smooth_sd must be a number"),
        ('files = ["rest.xyz", "pulled_*.xyz"]', 'file = ["rest.xyz"]', "lacks the key 'files'; did you write 'file'"),
        ("period = 0.5", "period = 0", "period must be a number above 0; got 0"),
        ('name = "grid"', "name = 3", "name must be a text; got 3"),
        (
            'name = "grid"',
            'name = "grid"\nunits = "mm"',
            r"unknown key 'units'; did you mean 'unit'\? Known: declaration, force, frame, grasp",
        ),
        (
            "rows = [0, 1]",
            "rows = [0, 1]\ntip = 3",
            r"\[grasp\] has the unknown key 'tip'\. Known: after, at, begin, direction",
        ),
        ("bed = false", "bed = 0", r"\[declaration\] bed must be true or false; got 0"),
        ("bed = false", "youngs = 3.0", r"\[declaration\] has the unknown key 'youngs'\. Known: areal_density"),
        ("bed = false", "poisson = 0.5", r"\[declaration\] Declaration.poisson must be in \[0, 0.5\)"),
        ("gravity = [0.0, 0.0, 0.0]", "gravity = [0, 0, -9810]", "Declaration.gravity must be at most 100 m/s"),
        ("rows = [0, 1]", "rows = [0, 1]\nafter = 1e300", r"\[grasp\] after must be a number from 0 to 9e\+09 \[s\]"),
        ("bed = false", "thickness = 0", r"\[declaration\] Declaration.thickness must be above 0"),
        ("rows = [0, 1]", "", r"\[grasp\] needs one of rows, rows_file, at"),
        ("rows = [0, 1]", 'rows = [0]\nrows_file = "r"', "both rows and rows_file"),
        ("rows = [0, 1]", "rows = [12]", r"names row 12; rows are numbered 0\.\.11"),
        ("rows = [0, 1]", "rows = []", "names row none"),
        ("rows = [0, 1]", 'rows_file = "rest.xyz"', "must hold whole numbers"),
        ("attached_rows = [11, 12]", "attached_rows = [0]", r"\[truth\] names row 0; rows are numbered 1\.\.12"),
        ("attached_rows = [11, 12]", "attached_beyond = 1.0", r"\[truth\] attached_beyond needs \[mesh.extend\]"),
        ("[truth]", "[truth]\nattached_beyond = 1.0", "several of attached_beyond, attached_rows and attached_at"),
        ('files = ["rest.xyz", "pulled_*.xyz"]', "files = []", "needs at least one file"),
        ('files = ["rest.xyz", "pulled_*.xyz"]', 'key = "p"\nfiles = ["a.xyz"]', "key names the array of an .npz"),
        ('files = ["rest.xyz", "pulled_*.xyz"]', 'files = ["none_*.xyz"]', "no file that matches 'none_"),
        ('files = ["rest.xyz", "pulled_*.xyz"]', 'files = ["no.xyz"]', r"no\.xyz cannot be read: No such file"),
        ('_*.xyz"]', '_*.xyz"]\ntimes = "t"', r"has both period and \[points\] times; .*: give one"),
        (
            "rows = [0, 1]",
            "rows = [0]\nstart = [0, 0, 0]\ndirection = [0, 0, 1]\nstep = 1e-3",
            r"\[grasp\] has both start, of a straight pull, and rows",
        ),
        ('_*.xyz"]', '_*.xyz"]\nrest = 3', r"\[points\] rest is 3; there are 3 frames"),
        ('_*.xyz"]', '_*.xyz"]\n[frame]\nrotation = [[2,0,0],[0,1,0],[0,0,1]]', "is not a rotation"),
        ('_*.xyz"]', '_*.xyz"]\n[mesh.extend]\naxis = [0,0,0]', "axis must be a vector that is not zero"),
        ("[points]", "[points", "is not TOML"),
    ],
)
def test_a_wrong_toml_is_refused_with_key_value_and_what_is_allowed(tmp_path, old, new, message):
    assert old in TOML
    where = folder(tmp_path, toml=TOML.replace(old, new))
    with pytest.raises(RecordingError, match=message) as refusal:
        bring_in(where)
    assert "\n" not in str(refusal.value)
    assert not (where / "run.mcap").exists() and not (where / "run.truth.mcap").exists()


def test_the_noise_is_that_of_single_points_and_the_one_that_neighbours_share(tmp_path):
    stated = "point_sd = 3e-4\nsmooth_sd = 4e-4\nsmooth_length = 0.01"
    _, recording = bring_in(folder(tmp_path, toml=TOML.replace("noise_sd = 1e-4", stated)))
    points = next(iter(recording)).points
    assert points.sd == pytest.approx(5e-4)  # 3, 4, 5
    assert (points.smooth_sd, points.smooth_length, points.sd_stated) == (4e-4, 0.01, True)


def test_a_missing_toml_is_refused(tmp_path):
    with pytest.raises(RecordingError, match=r"recording\.toml is missing.*jiggle-mj init"):
        import_folder(tmp_path, None, tmp_path / "run.mcap")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-32", "cp1252"])
def test_a_description_in_any_marked_encoding_is_read(tmp_path, encoding):
    where = folder(tmp_path)
    (where / "recording.toml").write_bytes(TOML.replace('"grid"', '"größe"').encode(encoding))
    assert bring_in(where)[0].n_frames == 3


def test_a_description_in_an_unmarked_encoding_is_refused_by_name(tmp_path):
    where = folder(tmp_path)
    (where / "recording.toml").write_bytes(TOML.encode("utf-16-le"))
    with pytest.raises(RecordingError, match=r"UTF-16 needs its mark \(BOM\)"):
        bring_in(where)
