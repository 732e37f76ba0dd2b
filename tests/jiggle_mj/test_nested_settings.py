"""Settings by dotted names: typed by their field, and an unknown name gets the one that was probably meant."""

from pathlib import Path

import pytest

from jiggle_mj.cli.settings import configured, declared
from jiggle_mj.errors import OptionError


def test_a_file_is_read_and_a_setting_is_over_it(tmp_path):
    path = tmp_path / "settings.toml"
    path.write_text("spacing = 3e-3\nfilter = 'nnls'\n[perception.stereo]\nmin_depth = 1\nmin_found = 0.5\n")
    config = configured(path, ("perception.stereo.min_depth=0.05", "seed=7"), "implicit")
    assert (config.spacing, config.filter, config.seed) == (3e-3, "nnls", 7)
    assert (config.perception.stereo.min_depth, config.perception.stereo.min_found) == (0.05, 0.5)


def test_declared_properties_are_those_that_are_named():
    assert declared(("membrane_stiffness=20", "gravity=[0, 0, 9.81]", "bed=false")) == {
        "membrane_stiffness": 20.0,
        "gravity": (0.0, 0.0, 9.81),
        "bed": False,
    }


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("perception.stereo.min_dept=1", r"did you mean perception\.stereo\.min_depth\?"),
        ("min_depth=1", r"did you mean perception\.stereo\.min_depth\?"),
        ("filter.tau_min=1", r"unknown setting 'filter\.tau_min'"),
        ("spacing=wide", "spacing must be a finite number; got 'wide'"),
        ("spacing=nan", "spacing must be a finite number"),
        ("spacing=-1", "spacing must be above 0"),
        ("samples=1.5", "samples must be a whole number"),
        ("filter=magic", "filter must be one of 'implicit'"),
        ("perception=1", "perception is a table"),
        ("spacing", "write NAME=VALUE"),
    ],
)
def test_a_wrong_setting_is_refused_by_name(text, why):
    with pytest.raises(OptionError, match=why):
        configured(None, (text,), "implicit")


def test_a_wrong_declaration_or_file_is_refused_by_name(tmp_path):
    with pytest.raises(OptionError, match="did you mean thickness"):
        declared(("thicknes=1",))
    with pytest.raises(OptionError, match="poisson must be in"):
        declared(("poisson=0.7",))
    with pytest.raises(OptionError, match="cannot be read"):
        configured(tmp_path / "none.toml", (), "implicit")
    with pytest.raises(OptionError, match="is inside more than 8 tables"):
        declared((deep_file(tmp_path),))
    with pytest.raises(OptionError, match="must be a finite number"):
        declared((f"poisson={10**400}",))
    (tmp_path / "bad.toml").write_text("= 1")
    with pytest.raises(OptionError, match="is no TOML"):
        configured(tmp_path / "bad.toml", (), "implicit")


def deep_file(folder: Path) -> str:
    """Return the path of a file with a table inside many others."""
    path = folder / "deep.toml"
    path.write_text(f"[{'.'.join('a' * 3000)}]\nb = 1\n")
    return str(path)
