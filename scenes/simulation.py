"""Stepping the tissue to rest, with a guard against instability.

At rest means that no coordinate moves faster than 1 mm/s; with implicit elasticity that takes about five steps of
20 ms after a small move. MuJoCo's warnings are counted here instead of being appended to MUJOCO_LOG.TXT.
"""

import tempfile
from collections import Counter
from pathlib import Path

import mujoco
import numpy as np

from jiggle_mj.errors import SimulationError

SETTLED = 1e-3
"""Largest speed of a settled coordinate [m/s]."""
AT_REST = 1e-5
"""Before the first frame [m/s]: still frames are to show the noise of sensing, not the last of the settling."""
MAX_STEPS = 400
"""After these a state counts as capped, not settled."""
MAX_COORDINATE, MAX_SPEED = 2.0, 50.0
"""Beyond these [m], [m/s] a state of a 10 cm sheet is an explosion."""

warnings: Counter[str] = Counter()
"""MuJoCo's warnings so far, by their first 60 characters; 'M+K solve ran out of iterations' is harmless: forces
balance to 5e-4 all the same."""


def _count(text: str) -> None:
    warnings[text[:60]] += 1


mujoco.set_mju_user_warning(_count)


def settle(model: mujoco.MjModel, data: mujoco.MjData, *, speed: float = SETTLED, dump_dir: Path | None = None) -> bool:
    """Step until every coordinate is slower than `speed` [m/s]; False if the cap of `MAX_STEPS` came first.

    Raises:
        SimulationError: the state became unstable; its dump is named.
    """
    for _ in range(MAX_STEPS):
        mujoco.mj_step(model, data)
        check_state(model, data, dump_dir=dump_dir)
        if np.abs(data.qvel).max() < speed:
            return True
    return False


def check_state(model: mujoco.MjModel, data: mujoco.MjData, *, dump_dir: Path | None = None) -> None:
    """Refuse a state that is not finite or has exploded, after writing it to a file.

    Raises:
        SimulationError: with the path of the dump, an npz of qpos, qvel, time, mocap_pos and eq_active.
    """
    size, speed = np.abs(data.qpos).max(), np.abs(data.qvel).max()
    if size < MAX_COORDINATE and speed < MAX_SPEED:
        return
    folder = dump_dir if dump_dir is not None else Path(tempfile.mkdtemp(prefix="jiggle-mj-"))
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "unstable_state.npz"
    np.savez(path, qpos=data.qpos, qvel=data.qvel, time=data.time, mocap_pos=data.mocap_pos, eq_active=data.eq_active)
    raise SimulationError(
        f"the simulation became unstable at t = {data.time:.2f} s (largest coordinate {size:.3g} m, speed "
        f"{speed:.3g} m/s); the state is in {path}. Lower tissue.young or the attachments' stiffness, or raise "
        "tissue.damping."
    )
