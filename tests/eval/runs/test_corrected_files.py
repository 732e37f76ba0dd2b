"""The corrected model as files: what close-loop writes is what an estimate and MuJoCo's `sysid` toolbox read."""

import dataclasses
import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import mujoco
import numpy as np
import pytest
import yaml

import jiggle_mj as jm
from jiggle_mj.cli.settings import declared
from jiggle_mj.errors import OptionError
from jiggle_mj.estimator.attribution.corrected import CorrectedParameter, corrected_declaration
from jiggle_mj.estimator.effects import LIBRARY
from jiggle_mj.eval.runs.corrected_files import CORRECTED, PARAMETERS, parameters_text, write_corrected
from jiggle_mj.eval.runs.settings_used import settings_used, with_declared
from jiggle_mj.observation import Declaration
from tests.support.tiny_scene import call, scene_file

DECLARED = Declaration(membrane_stiffness=20.0, bed=False, gravity=(0.0, -9.81, 0.0), effects={"friction": (0.2,)})


def added(name: str, nominal: tuple[float, ...], value: tuple[float, ...]) -> CorrectedParameter:
    """Return what was added of an effect, with bounds at four prior standard deviations."""
    effect = next(one for one in LIBRARY if one.name == name.partition(".")[0])
    reach = 4 * np.array(effect.prior_sd)
    lowest = np.maximum(nominal - reach, 0 if effect.non_negative else -np.inf)
    return CorrectedParameter(
        effect=effect,
        nominal=nominal,
        value=value,
        min_value=tuple(lowest.tolist()),
        max_value=tuple((nominal + reach).tolist()),
    )


EFFECTS = {
    "friction": (0.2 - 0.05,),
    "camera_bias": (1e-3, -2e-5, 0.0, 1e-7, 0.01, 0.0),
    "inclusion.14": (1.25,),
}


NOMINAL = {**{name: tuple(0.0 for _ in values) for name, values in EFFECTS.items()}, **DECLARED.effects}
ADDED = {name: added(name, NOMINAL[name], values) for name, values in EFFECTS.items()}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("closed")
    write_corrected(folder, ADDED, DECLARED, name="a sheet")
    return folder


def test_the_corrected_declaration_is_read_back_to_the_last_digit(folder):
    expected = dataclasses.replace(DECLARED, effects=EFFECTS)
    assert with_declared(Declaration(), jm.read_declaration(folder / CORRECTED)) == expected
    assert with_declared(Declaration(), declared([str(folder / CORRECTED)])) == expected


def test_later_declarations_are_over_those_of_the_file(folder):
    given = declared(["poisson=0.3", str(folder / CORRECTED), "effects.inclusion.14=[0.5]", "membrane_stiffness=15"])
    found = with_declared(Declaration(), given)
    assert (found.poisson, found.membrane_stiffness) == (DECLARED.poisson, 15.0)
    assert found.effects == EFFECTS | {"inclusion.14": (0.5,)}


def test_the_file_says_what_holds_for_the_session_alone(folder):
    lines = {line.partition(" = ")[0]: line for line in (folder / CORRECTED).read_text().splitlines()}
    assert lines["camera_bias"].endswith(
        "# m, m, m, rad, rad, rad; of the tool, camera or tracker: holds for this session alone"
    )
    assert lines["inclusion.14"].endswith("# log factor")


def test_muJoCos_toolbox_reads_the_parameters(folder, monkeypatch):
    loaded = sysid_parameters(monkeypatch).ParameterDict.load_from_disk(folder / PARAMETERS)
    assert loaded.keys() == ["friction", "camera_bias", "inclusion.14"]
    friction, camera = loaded["friction"], loaded["camera_bias"]
    assert (friction.name, friction.frozen) == ("friction", False)
    np.testing.assert_array_equal(friction.nominal, [0.2])
    np.testing.assert_array_equal(friction.value, [0.2 - 0.05])
    np.testing.assert_array_equal(friction.min_value, [0.0])
    np.testing.assert_allclose(friction.max_value, [0.2 + 4 * 0.3])
    np.testing.assert_array_equal(camera.value, EFFECTS["camera_bias"])
    np.testing.assert_allclose(camera.max_value, [0.012] * 3 + [0.12] * 3)
    np.testing.assert_array_equal(camera.min_value, -camera.max_value)


def test_the_parameters_have_the_keys_that_the_toolbox_writes(folder, monkeypatch, tmp_path):
    toolbox = sysid_parameters(monkeypatch)
    theirs = toolbox.ParameterDict({"one": toolbox.Parameter("one", 0.0, -1.0, 1.0)})
    theirs.save_to_disk(tmp_path / "theirs.yaml")
    keys = set(yaml.safe_load((tmp_path / "theirs.yaml").read_text())["one"])
    ours = yaml.safe_load((folder / PARAMETERS).read_text())
    assert all(set(one) == keys for one in ours.values())


def test_without_an_effect_both_files_are_of_what_is_declared(tmp_path):
    plain = Declaration()
    write_corrected(tmp_path, {}, plain, name="a sheet")
    assert with_declared(Declaration(), jm.read_declaration(tmp_path / CORRECTED)) == plain
    assert yaml.safe_load((tmp_path / PARAMETERS).read_text()) == {} == yaml.safe_load(parameters_text({}))


def test_a_recording_keeps_the_effects_of_its_declaration(tmp_path):
    declaration = corrected_declaration(ADDED, DECLARED)
    with jm.RecordingWriter(tmp_path / "run.mcap", camera=None, declaration=declaration, metadata={}) as writer:
        writer.write(at_rest())
    assert jm.Recording.open(tmp_path / "run.mcap").declaration == dataclasses.replace(DECLARED, effects=EFFECTS)


def test_a_result_says_which_effects_were_declared():
    used = settings_used(DECLARED, jm.EstimatorConfig(), declare={"effects": DECLARED.effects}, declared=True)
    assert used["declaration"]["effects"] == {"value": {"friction": (0.2,)}, "from": "argument"}  # pyright: ignore
    plain = settings_used(Declaration(), jm.EstimatorConfig(), declare={}, declared=True)
    assert "effects" not in plain["declaration"]  # pyright: ignore[reportOperatorIssue]


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (["no.toml"], "--declare no.toml cannot be read: No such file"),
        (["effects.gravity=0.3"], r"effects.gravity must be a list, such as \[0, 0, -9.81\]; got 0.3"),
        (["effects=0.3"], "effects must be a table of names; got 0.3"),
        (["effects.gravity=[0, 0, 'x']"], "effects.gravity must be a finite number; got 'x'"),
    ],
)
def test_what_declares_no_effect_is_refused(given, says):
    with pytest.raises(OptionError, match=says):
        declared(given)


def test_a_policy_and_an_estimate_take_the_file(tmp_path, monkeypatch, capsys):
    scene, file = scene_file(tmp_path), tmp_path / "corrected.toml"
    file.write_text("[effects]\nstretch = [0.3]\ntool_scale = [0.02]\n")
    given = ("--declare", file, "--declare", "effects.tool_scale=[0.05]", "--json")
    run = ("run", scene, "--sensing", "particles", "--policy", "information", "--steps", "5", "--out", tmp_path / "run")
    estimate = ("estimate", tmp_path / "run" / "run.mcap", "--out", tmp_path / "estimate", "--allow-implausible")
    for verb in (run, estimate):
        assert call(monkeypatch, *verb, *given) == 0
        result = json.loads(capsys.readouterr().out)
        effects = {"value": {"stretch": [0.3], "tool_scale": [0.05]}, "from": "argument"}
        assert result["settings"]["declaration"]["effects"] == effects
        assert result["frames"]["used"] > 0
    file.write_text("[effects]\ntool_latency = [0.1]\n")
    assert call(monkeypatch, *estimate[:3], tmp_path / "late", *given[:2]) == 2
    assert "tool_latency needs what the tool reports after each frame" in capsys.readouterr().err
    assert not (tmp_path / "late").exists()


def at_rest() -> jm.Observation:
    """Return an observation of three points with open jaws."""
    tool = jm.ToolState(position=np.zeros(3), quat_wxyz=np.eye(4)[0], closed=False, grasp=0, radius=0.01)
    points = jm.MeasuredPoints(positions=np.eye(3), track_id=np.arange(3))
    return jm.Observation(index=0, time=0, tool=tool, points=points)


def sysid_parameters(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return MuJoCo's module of parameters; what prints its tables need not be installed."""
    printing = SimpleNamespace(Fore=SimpleNamespace(), Style=SimpleNamespace(), tabulate=None)
    for name in ("colorama", "tabulate"):
        if importlib.util.find_spec(name) is None:
            monkeypatch.setitem(sys.modules, name, printing)
    path = Path(mujoco.__file__).parent / "sysid" / "_src" / "parameter.py"
    spec = importlib.util.spec_from_file_location("sysid_parameter", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
