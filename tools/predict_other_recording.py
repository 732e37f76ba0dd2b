"""What a loop found of one recording, held against another of the same sheet: does it foretell that one better?

    python tools/predict_other_recording.py out/cloth/discrepancy.json other.mcap

Nothing is fitted to the other recording, and nothing is attached in it. Effects that hold for one session alone (of the
tool, the camera or the tracker) are also left out one by one.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jiggle_mj.estimator.attribution.dataset import collect_dataset
from jiggle_mj.estimator.attribution.held_out import from_rest, residuals, rms
from jiggle_mj.estimator.attribution.problem import Point, Problem
from jiggle_mj.estimator.effects import LIBRARY
from jiggle_mj.recording.reader import Recording


def main() -> None:
    """Print the root mean square error [mm] of each grasp and of all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("discrepancy", type=Path)
    parser.add_argument("recording", type=Path)
    said = parser.parse_args()
    effects = json.loads(said.discrepancy.read_text())["effects"]
    recording = Recording.open(said.recording)
    dataset = collect_dataset(recording.declaration, recording.camera, recording)
    with jax.enable_x64(True):
        problem = Problem.build(dataset, LIBRARY)
        variants = {"nothing": [], "all of it": effects}
        for one in effects:
            if one["this_session_alone"]:
                variants[f"all but {one['name']}"] = [other for other in effects if other is not one]
        for name, some in variants.items():
            print(f"{name}: {_error_by_grasp(problem, some)}", flush=True)


def _error_by_grasp(problem: Problem, effects: list[dict[str, Any]]) -> str:
    frames = problem.history.frames
    theta = np.zeros(problem.sheet.size)
    for one in effects:
        theta[problem.sheet.place(one["name"], one["site"])] = one["theta"]
    states = np.stack([one.state for one in frames])
    plain = Point(theta=theta, s=np.zeros(states.shape[1]), states=states, seen=states)
    held_out = from_rest(problem, plain, list(range(len(frames))), by_tool=True)
    grasps = problem.history.by(lambda one: one.grasp, range(len(frames))).values()
    each = [residuals(problem, held_out, grasp) for grasp in grasps]
    return f"{1e3 * rms(np.concatenate(each)):.1f} mm; by grasp " + ", ".join(f"{1e3 * rms(one):.1f}" for one in each)


if __name__ == "__main__":
    main()
