"""The table of undeclared effects: its scenes, and counts by hand."""

import json
from concurrent.futures import ThreadPoolExecutor

import pytest
from jiggle_mj.estimator.effects import LIBRARY
from jiggle_mj.eval import undeclared_table
from jiggle_mj.eval.closing_the_loop import DISCREPANCY
from jiggle_mj.eval.undeclared_table import INSIDE, MOVING, NOTHING, OUTSIDE, markdown, measure, scene_with

from jiggle_mj.recording_declaration import VERSION, file_metadata


def found(verdict: str, *names: str, after: float = 1e-3, also: tuple[str, ...] = ()) -> dict:
    """A run that was foretold to 2 mm before."""
    detection = {"by_dilation": {"1": {"pug": 0.5}}}
    return {
        "verdict": verdict,
        "effects": [{"name": name, "theta": [0.1, 0.2], "sd": [0.01, 0.02]} for name in names],
        "ambiguous_with": list(also),
        "held_out": {"before_rms_m": 2e-3, "after_rms_m": after},
        "detection_before": detection,
        "detection_after": detection,
    }


def test_scenes_differ_by_what_is_undeclared_alone_and_keep_it_secret():
    plain = scene_with(NOTHING, 0)
    assert plain.disturbances == ()
    for name in (*INSIDE, *OUTSIDE):
        scene = scene_with(name, 0)
        assert len(scene.disturbances) == (2 if MOVING in scene.disturbances else 1)
        assert scene.secret and scene.attachments == plain.attachments


def test_what_is_inside_is_in_the_library_and_what_is_outside_is_not():
    names = {effect.name for effect in LIBRARY}
    assert {effect for effect, *_ in INSIDE.values()} <= names
    assert (
        not {undeclared_table.scene_with(name, 0).disturbances[0].__class__.__name__.lower() for name in OUTSIDE}
        & names
    )


def test_counts():
    runs = {
        ("friction", 0): found("effect", "friction"),
        ("friction", 1): found("ambiguous", "gravity", also=("friction",)),
        ("stretch", 0): found("no-effect", after=2e-3),
        ("grasp slips", 0): found("unexplained", after=2e-3),
        ("anchors break", 0): found("effect", "anchor_creep"),
        (NOTHING, 0): found("no-effect", after=2e-3),
    }
    lines = markdown(runs).splitlines()
    assert lines[2] == (
        "| friction | friction (1); gravity, friction (1) | effect (1); ambiguous (1) | 0.1 (0.01), 0.2 (0.02); "
        "0.1 (0.01), 0.2 (0.02) | 2.00 → 1.00; 2.00 → 1.00 | 0.50 → 0.50; 0.50 → 0.50 |"
    )
    said = " ".join(lines[-3:])
    assert "named first in 1 of 3, among those named in 2; the held-out error falls by 50% at the median" in said
    assert "Nothing undeclared: 0 of 1 named." in said
    assert "Not in the library: 1 of 2 unexplained or with a remainder." in said


@pytest.mark.parametrize(("version", "times"), [(file_metadata()[VERSION], 1), ("0.0", 2)])
def test_what_this_version_ran_is_not_run_again(tmp_path, monkeypatch, version, times):
    ran = []

    def run(name, seed, folder):
        ran.append((name, seed))
        folder.mkdir(exist_ok=True)
        (folder / DISCREPANCY).write_text(json.dumps({VERSION: version} | found("no-effect")))

    monkeypatch.setattr(undeclared_table, "_run", run)
    with ThreadPoolExecutor(1) as executor:
        runs = [measure(["tool scale"], [0, 1], tmp_path, executor=executor, say=lambda _: None) for _ in range(2)]
    both = [("tool scale", 0), ("tool scale", 1)]
    assert ran == times * both
    assert [list(one) for one in runs] == [both, both]


@pytest.mark.slow
def test_an_undeclared_tool_scale_is_named_across_engines(tmp_path):
    undeclared_table._run("tool scale", 0, tmp_path / "run")
    closed = json.loads((tmp_path / "run" / DISCREPANCY).read_text())
    assert [one["name"] for one in closed["effects"]] == ["tool_scale"]
    assert closed["held_out"]["after_rms_m"] < closed["held_out"]["before_rms_m"]
