"""Test whether the effects found in one recording predict another recording of the same sheet better.

    python tools/predict_other_recording.py out/cloth/discrepancy.json other.mcap

Nothing is fitted to the other recording, and nothing is attached in it. Effects that hold for one session alone (of the
tool, the camera or the tracker) are also left out one at a time.
"""

import argparse
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jiggle_mj.estimator.attribution.dataset import collect_dataset
from jiggle_mj.estimator.attribution.held_out import from_rest, rms
from jiggle_mj.estimator.attribution.problem import Point, Problem
from jiggle_mj.estimator.effects import LIBRARY
from jiggle_mj.eval.metrics.result_file import read_json
from jiggle_mj.recording.reader import Recording


def main() -> None:
    """Print the root mean square error [mm] of each grasp and of all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("discrepancy", type=Path)
    parser.add_argument("recording", type=Path)
    arguments = parser.parse_args()
    effects = read_json(arguments.discrepancy, "'jiggle-mj close-loop' writes it")["effects"]
    recording = Recording.open(arguments.recording)
    dataset = collect_dataset(recording.declaration, recording.camera, recording)
    with jax.enable_x64(True):
        problem = Problem.build(dataset, LIBRARY)
        variants = {"no effect": [], "all effects": effects}
        for effect in effects:
            if effect["this_session_alone"]:
                variants[f"all but {effect['name']}"] = [kept for kept in effects if kept is not effect]
        for name, used in variants.items():
            print(f"{name}: {_error_by_grasp(problem, used)}", flush=True)


def _error_by_grasp(problem: Problem, effects: list[dict[str, Any]]) -> str:
    """Return the held-out error of all frames and of each grasp [mm], as text."""
    frames = problem.history.frames
    theta = np.zeros(problem.sheet.size)
    for effect in effects:
        theta[problem.sheet.place(effect["name"], effect["site"])] = effect["theta"]
    states = np.stack([frame.state for frame in frames])
    plain = Point(theta=theta, s=np.zeros(states.shape[1]), states=states, seen=states)
    held_out = from_rest(problem, plain, list(range(len(frames))), by_tool=True)
    grasps = problem.history.by(lambda frame: frame.grasp, range(len(frames))).values()
    errors = [residuals(problem, held_out, grasp) for grasp in grasps]
    by_grasp = ", ".join(f"{1e3 * rms(error):.1f}" for error in errors)
    return f"{1e3 * rms(np.concatenate(errors)):.1f} mm; by grasp {by_grasp}"


def residuals(problem: Problem, point: Point, frames: list[int]) -> Float[np.ndarray, "m 3"]:
    """Return observed minus predicted positions of some frames, for observed particles that are not held [m]."""
    closed = [(problem.history.frames[k].frame, point.seen[k]) for k in frames]
    return np.concatenate([(np.asarray(frame.y) - seen)[np.asarray(frame.counted)] for frame, seen in closed])


if __name__ == "__main__":
    main()
