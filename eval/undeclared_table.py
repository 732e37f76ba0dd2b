"""Whether closing the loop names what a scene holds and nobody declares: effects of the library, none, and others.

A sheet that is attached along an arc is lifted at four corners and one edge, and let down; particles are seen with
noise half of which neighbours share. What would belong to the rest shape if it were there from the start begins after
the still frames.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from jiggle_mj.estimator.attribution.closing import LEFT_OVER
from jiggle_mj.eval.closing_the_loop import DISCREPANCY, close_loop
from jiggle_mj.eval.tables import carry_out
from jiggle_mj.scenes import Reference, Scene, load_scene, programme
from jiggle_mj.scenes.anchor_disturbances import (
    AnchorBreak,
    AnchorCreep,
    AnchorShift,
    AnchorYield,
    GraspSlip,
    PointPull,
)
from jiggle_mj.scenes.disturbance import Disturbance
from jiggle_mj.scenes.report_disturbances import (
    CameraBias,
    CameraDrift,
    DepthScale,
    ImageLatency,
    Inertia,
    PointSlip,
    ToolLatency,
    ToolScale,
    ToolTurn,
)
from jiggle_mj.scenes.sheet_disturbances import (
    Anisotropy,
    Bending,
    Heterogeneity,
    Inclusion,
    MaterialDamping,
    PreStrain,
    StrainStiffening,
    Stretch,
    TissueCreep,
    TissueYield,
)
from jiggle_mj.scenes.world_disturbances import Bed, Friction, Gravity, ViscousDrag

from jiggle_mj.episode import observe
from jiggle_mj.mcap_files import truth_path
from jiggle_mj.recording_declaration import is_current

LATE = 2.2
"""When what would else be in the rest shape begins: after the still frames, before the first grasp [s]."""
MOVING, SLOW = Inertia(magnitude=0.02), 0.03
"""Frames that are taken while the tool has just stopped, and how fast it goes there [m/s]: that a report comes late
shows in no sheet at rest."""
INSIDE: dict[str, tuple[str, *tuple[Disturbance, ...]]] = {
    "gravity x 0.3": ("gravity", Gravity(magnitude=0.3, start=LATE)),
    "gravity leaning": ("gravity", Gravity(magnitude=1.0, tilt_deg=25, azimuth_deg=30, start=LATE)),
    "bed lower": ("bed", Bed(magnitude=-0.003, start=LATE)),
    "friction": ("friction", Friction(magnitude=1.0)),
    "viscous drag": ("viscous_drag", ViscousDrag(magnitude=2.0), MOVING),
    "material damping": ("material_damping", MaterialDamping(magnitude=0.5), MOVING),
    "tissue creep": ("tissue_creep", TissueCreep(magnitude=0.3)),
    "inclusion": ("inclusion", Inclusion(magnitude=8, centre=(-0.02, -0.02), radius=0.015)),
    "heterogeneity": ("heterogeneity", Heterogeneity(magnitude=0.6)),
    "anisotropy": ("anisotropy", Anisotropy(magnitude=3.0)),
    "stretch": ("stretch", Stretch(magnitude=2.5)),
    "bending": ("bending", Bending(magnitude=15)),
    "pre-strain": ("pre_strain", PreStrain(magnitude=0.03, start=LATE)),
    "stiffening": ("strain_stiffening", StrainStiffening(magnitude=400)),
    "point pull": ("point_pull", PointPull(magnitude=3.0, at=(0.02, 0.02), start=LATE)),
    "anchor shift": ("anchor_shift", AnchorShift(magnitude=0.003, direction=(1.0, 0.3, 0.0), start=LATE)),
    "anchor creep": ("anchor_creep", AnchorCreep(magnitude=0.5)),
    "tool scale": ("tool_scale", ToolScale(magnitude=1.08)),
    "tool turn": ("tool_turn", ToolTurn(magnitude=4.0)),
    "tool latency": ("tool_latency", ToolLatency(magnitude=0.2), MOVING),
    "image latency": ("image_latency", ImageLatency(magnitude=0.2), MOVING),
    "camera bias": ("camera_bias", CameraBias(magnitude=0.003, pitch_deg=1.0, start=LATE)),
    "camera drift": ("camera_drift", CameraDrift(magnitude=0.0003, roll_deg=0.05, start=LATE)),
    "depth scale": ("depth_scale", DepthScale(magnitude=1.03, start=LATE)),
    "point slip": ("point_slip", PointSlip(magnitude=0.0002)),
}
"""What is undeclared, the effect's name, and the disturbances."""
OUTSIDE: dict[str, Disturbance] = {
    "grasp slips": GraspSlip(magnitude=0.006),
    "tissue yields": TissueYield(magnitude=0.1),
    "anchors yield": AnchorYield(magnitude=0.0015),
    "anchors break": AnchorBreak(magnitude=0.01),
}
"""What the library leaves out."""
NOTHING = "nothing"
Found = dict[tuple[str, int], dict[str, Any]]
"""discrepancy.json by what is undeclared and seed."""


def scene_with(undeclared: str, seed: int) -> Scene:
    """The arc on a coarser sheet, with more grasps, noise that neighbours share, and something that nobody declares."""
    arc = load_scene("arc")
    pulls = replace(
        arc.programme,
        still_frames=20,
        points=((-0.047, -0.047), (0.047, -0.047), (0.047, 0.047), (-0.047, 0.047), (0.0, -0.048)),
        height=0.035,
        increments=5,
        lowering=1,
    )
    disturbances = (OUTSIDE[undeclared],) if undeclared in OUTSIDE else INSIDE.get(undeclared, (NOTHING,))[1:]
    return replace(
        arc,
        name=f"undeclared, {undeclared}",
        seed=seed,
        secret=True,
        tissue=replace(arc.tissue, spacing=6.5e-3, mesh="unstructured", seed=seed),
        bed=replace(arc.bed, friction=0.1),
        attachments=(replace(arc.attachments[0], width=0.0115, stiffness=2.0),),
        tweezer=replace(arc.tweezer, radius=8e-3, speed=SLOW if MOVING in disturbances else arc.tweezer.speed),
        programme=pulls,
        sensing=replace(arc.sensing, point_sd=1.5e-4, smooth_sd=1.5e-4, smooth_length=0.012),
        disturbances=disturbances,
    )


def measure(
    names: Iterable[str], seeds: Iterable[int], directory: Path, *, executor: Executor, say: Callable[[str], None]
) -> Found:
    """Run what has not been run by this version, and read all of it.

    Args:
        names: of `INSIDE`, `OUTSIDE` and `NOTHING`.
        seeds: of mesh, noise and scene.
        directory: holds a folder for each.
        executor: runs several at a time.
        say: told of each that is done.
    """
    folders = {(name, seed): directory / f"{name.replace(' ', '_')}-{seed}" for name, seed in product(names, seeds)}
    left = {
        folder.name: partial(_run, *key, folder) for key, folder in folders.items() if not _done(folder / DISCREPANCY)
    }
    carry_out(left, executor, say=say)
    return {key: json.loads((folder / DISCREPANCY).read_text()) for key, folder in folders.items()}


def _done(file: Path) -> bool:
    return file.exists() and is_current(json.loads(file.read_text()))


def _run(undeclared: str, seed: int, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    scene, recording = scene_with(undeclared, seed), folder / "run.mcap"
    with Reference(scene, seed=seed, sensing="particles") as reference:
        for _ in observe(reference, programme(scene), recording, seed=seed, overwrite=True):
            pass
    close_loop(recording, folder, truth=truth_path(recording), overwrite=True)


def named(found: Mapping[str, Any]) -> list[str]:
    """Effects that a run names, with those that they could not be told from."""
    return [one["name"] for one in found["effects"]] + found["ambiguous_with"]


def markdown(runs: Found) -> str:
    """A line for each that was undeclared, and sums."""
    lines = [
        "| undeclared | named (of seeds) | verdicts | theta (sd) | held-out mm, before → after | PUG at one ring |",
        "|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(name for name, _ in runs):
        mine = [found for (one, _), found in runs.items() if one == name]
        held = [(1e3 * one["held_out"]["before_rms_m"], 1e3 * one["held_out"]["after_rms_m"]) for one in mine]
        cells = [
            _counted([", ".join(named(one)) or "nothing" for one in mine]),
            _counted([one["verdict"] for one in mine]),
            "; ".join(_theta(one) for one in mine),
            "; ".join(f"{before:.2f} → {after:.2f}" for before, after in held),
            "; ".join(f"{_pug(one, 'before')} → {_pug(one, 'after')}" for one in mine),
        ]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, "", *_sums(runs)])


def _sums(runs: Found) -> list[str]:
    inside = [(INSIDE[name][0], found) for (name, _), found in runs.items() if name in INSIDE]
    outside = [found for (name, _), found in runs.items() if name in OUTSIDE]
    nothing = [found for (name, _), found in runs.items() if name == NOTHING]
    said = []
    if inside:
        first = sum(bool(one["effects"]) and one["effects"][0]["name"] == effect for effect, one in inside)
        among = sum(effect in named(one) for effect, one in inside)
        gains = [1 - one["held_out"]["after_rms_m"] / one["held_out"]["before_rms_m"] for _, one in inside]
        said.append(
            f"In the library: named first in {first} of {len(inside)}, among those named in {among}; the held-out "
            f"error falls by {np.median(gains):.0%} at the median, and rises in {sum(gain < -0.01 for gain in gains)}."
        )
    if nothing:
        said.append(f"Nothing undeclared: {sum(bool(one['effects']) for one in nothing)} of {len(nothing)} named.")
    if outside:
        honest = sum(one["verdict"] in LEFT_OVER for one in outside)
        said.append(f"Not in the library: {honest} of {len(outside)} unexplained or with a remainder.")
    return said


def _counted(what: list[str]) -> str:
    return "; ".join(f"{one} ({what.count(one)})" for one in dict.fromkeys(what))


def _theta(found: Mapping[str, Any]) -> str:
    if not found["effects"]:
        return "-"
    one = found["effects"][0]
    values = [f"{value:.3g} ({sd:.2g})" for value, sd in zip(one["theta"], one["sd"], strict=True)]
    return ", ".join(values[:3]) + (" …" if len(values) > 3 else "")


def _pug(found: Mapping[str, Any], when: str) -> str:
    pug = found[f"detection_{when}"]["by_dilation"]["1"]["pug"]
    return "-" if pug is None else f"{pug:.2f}"
