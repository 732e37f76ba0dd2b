"""The table of undeclared effects: its scenes, and counts by hand."""

import json
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import get_args

import pytest

from jiggle_mj.cli.options import RowsName
from jiggle_mj.estimator.effects import LIBRARY
from jiggle_mj.eval.runs.closing_the_loop import DISCREPANCY
from jiggle_mj.eval.studies.study import run_study
from jiggle_mj.eval.studies.undeclared_panel import (
    GROUPS,
    OUTSIDE,
    ROWS,
    SHIPPED_SPACING,
    TOGETHER,
    UNSETTLED,
    scene_with,
)
from jiggle_mj.eval.studies.undeclared_table import UndeclaredCell, UndeclaredStudy
from jiggle_mj.recording.declaration import VERSION, file_metadata
from jiggle_mj.scenes import Reference, load_scene
from jiggle_mj.scenes.scene.programme import opening


def found(
    verdict: str,
    *names: str,
    after: float = 1e-3,
    also: tuple[str, ...] = (),
    theta: Sequence[float] = (0.1, 0.2),
    sd: Sequence[float] = (0.01, 0.02),
) -> dict:
    """Return the content of discrepancy.json for a held-out error of 2 mm before."""
    detection = {"by_dilation": {"1": {"pug": 0.5}}}
    return {
        "verdict": verdict,
        "effects": [{"name": name, "theta": theta, "sd": sd} for name in names],
        "ambiguous_with": list(also),
        "held_out": {"before_rms_m": 2e-3, "after_rms_m": after},
        "detection_before": detection,
        "detection_after": detection,
    }


def test_scenes_differ_by_what_is_undeclared_alone_and_keep_it_secret():
    assert scene_with("nothing", 0).disturbances == ()
    nothing = {name: row for name, row in ROWS.items() if name.startswith("nothing")}
    plain = {
        (row.layout, row.coarse_layout, row.spacing): scene_with(name, 0).attachments for name, row in nothing.items()
    }
    for name, row in ROWS.items():
        scene = scene_with(name, 0)
        assert len(scene.disturbances) == max(len(row.effects), name in OUTSIDE) + (UNSETTLED in scene.disturbances)
        assert scene.secret and scene.attachments == plain[row.layout, row.coarse_layout, row.spacing]


def test_attachments_are_as_shipped_on_a_mesh_as_fine_as_there_and_wider_and_stiffer_on_a_coarser_one():
    shipped, (coarser,) = load_scene("arc").attachments, scene_with("nothing", 0).attachments
    assert load_scene("arc").tissue.spacing == SHIPPED_SPACING
    assert scene_with("nothing, images", 0).attachments == shipped
    assert coarser == replace(shipped[0], width=0.0115, stiffness=2.0)
    assert len(scene_with("nothing, U shape", 0).attachments) == 3


def test_undeclared_effects_begin_after_the_still_frames_and_before_the_jaws_close():
    """On the coarse sheet too, whose recordings are shorter."""
    for name in ("camera bias", "camera bias, three bars"):
        scene = scene_with(name, 1)
        with Reference(scene, seed=1, sensing="particles") as reference:
            seen = [reference.step(action) for action in islice(opening(scene), scene.programme.still_frames + 1)]
        assert [one.tool.closed for one in seen[-2:]] == [False, True]
        assert seen[0].time / 1e9 < scene.disturbances[0].start < seen[-1].time / 1e9


def test_every_row_has_a_name_of_its_own():
    assert len(ROWS) == sum(len(rows) for rows in GROUPS.values())
    assert set(get_args(RowsName)) == set(GROUPS)


def test_what_is_inside_is_in_the_library_and_what_is_outside_is_not():
    names = {effect.name for effect in LIBRARY}
    assert {effect for row in ROWS.values() for effect in row.effects} <= names
    assert not {type(d).__name__.lower() for row in OUTSIDE.values() for d in row.disturbances} & names


def test_true_sizes_are_of_the_row_s_own_effects_and_as_long_at_most():
    lengths = {effect.name: len(effect.prior_sd) for effect in LIBRARY}
    for row in ROWS.values():
        assert set(row.sizes) <= set(row.effects)
        assert all(len(size) <= lengths[name] for name, size in row.sizes.items())


def test_two_effects_are_each_of_another_name_and_begin_in_turn():
    for row in TOGETHER.values():
        assert len(set(row.effects)) == 2
        assert [d.start for d in row.disturbances] == sorted(d.start for d in row.disturbances)


def test_noise_is_as_strong_in_every_row():
    sd = [math.hypot(scene_with(name, 0).sensing.point_sd, scene_with(name, 0).sensing.smooth_sd) for name in ROWS]
    assert sd == pytest.approx([sd[0]] * len(sd))


def by_cell(runs: dict[tuple[str, int], dict]) -> dict[UndeclaredCell, dict]:
    """Return runs by cell, from runs by row and seed."""
    return {UndeclaredCell(row=row, seed=seed): run for (row, seed), run in runs.items()}


def test_counts():
    runs = {
        ("friction", 0): found("effect", "friction"),
        ("friction", 1): found("ambiguous", "gravity", also=("friction",)),
        ("stretch", 0): found("no-effect", after=2e-3),
        ("stretch and image latency", 0): found("effect", "image_latency", "stretch"),
        ("stretch and image latency", 1): found("ambiguous", "image_latency", also=("stretch",)),
        ("bending and tissue creep", 0): found("effect", "bending", after=2.1e-3),
        ("stretch, images", 0): found("effect", "stretch", after=0.5e-3),
        ("anchors break", 0): found("unexplained", after=2e-3),
        ("anchors break", 1): found("effect", "anchor_creep"),
        ("nothing", 0): found("no-effect", after=2e-3),
        ("nothing, images", 0): found("effect", "gravity"),
    }
    lines = UndeclaredStudy().to_markdown(by_cell(runs)).splitlines()
    assert lines[2] == (
        "| friction | friction (1); gravity, friction (1) | effect (1); ambiguous (1) | 0.1 (0.01), 0.2 (0.02); "
        "0.1 (0.01), 0.2 (0.02) | 2.00 → 1.00; 2.00 → 1.00 | 0.50 → 0.50; 0.50 → 0.50 |"
    )
    assert lines[-5:] == [
        "One effect: named first in 1 of 3, all added in 1, all among those named in 2; held-out error falls by 50% at "
        "the median, and rises in 0; 0 of 0 parameters within their 95 % interval.",
        "Two effects: named first in 3 of 3, all added in 1, all among those named in 2; held-out error falls by 50% "
        "at the median, and rises in 1; 0 of 4 parameters within their 95 % interval.",
        "One effect, from images: named first in 1 of 1, all added in 1, all among those named in 1; held-out error "
        "falls by 75% at the median, and rises in 0; 0 of 1 parameters within their 95 % interval.",
        "Nothing undeclared: 1 of 2 named.",
        "Not in the library: 1 of 2 unexplained or with a remainder.",
    ]


def test_sizes_lie_within_their_intervals_or_do_not():
    """Two runs with a lowered bed: two of three parameters, and one of three; friction has no true size."""
    runs = {
        ("bed lower", 0): found("effect", "bed", theta=[-0.0031, 0.001, 0.003], sd=[1e-4, 1e-3, 1e-3]),
        ("bed lower", 1): found("effect", "bed", theta=[-0.0033, 0.003, 0.0], sd=[1e-4, 1e-3, 1e-3]),
        ("friction", 0): found("effect", "friction", theta=[0.4], sd=[0.01]),
    }
    assert UndeclaredStudy().to_markdown(by_cell(runs)).endswith("3 of 6 parameters within their 95 % interval.")


@pytest.mark.parametrize(("version", "times"), [(file_metadata()[VERSION], 1), ("0.0", 2)])
def test_what_this_version_ran_is_not_run_again(tmp_path, version, times):
    ran = []

    class Counted(UndeclaredStudy):
        def run_cell(self, cell: UndeclaredCell, path: Path) -> None:
            ran.append((cell.row, cell.seed))
            path.mkdir(exist_ok=True)
            (path / DISCREPANCY).write_text(json.dumps({VERSION: version} | found("no-effect")))

    study = Counted(rows=("tool scale",))
    with ThreadPoolExecutor(1) as executor:
        runs = [run_study(study, study.cells((0, 1)), tmp_path, executor=executor) for _ in range(2)]
    both = [("tool scale", 0), ("tool scale", 1)]
    assert ran == times * both
    assert [[(cell.row, cell.seed) for cell in results] for results in runs] == [both, both]


@pytest.mark.slow
def test_an_undeclared_tool_scale_is_named_across_engines(tmp_path):
    study, cell = UndeclaredStudy(), UndeclaredCell(row="tool scale", seed=0)
    study.run_cell(cell, tmp_path / "run")
    closed = study.read(cell, tmp_path / "run")
    assert [effect["name"] for effect in closed["effects"]] == ["tool_scale"]
    assert closed["held_out"]["after_rms_m"] < closed["held_out"]["before_rms_m"]
