"""Recordings of a sheet that hangs by its upper edge and swings, by the reference's engine; gravity is along y."""

from collections.abc import Callable

import mujoco
import numpy as np

from jiggle_mj.observation import IDENTITY_WXYZ, Declaration, MeasuredPoints, Observation, ToolReport, ToolState
from jiggle_mj.scenes.scene.scene import BedConfig, Scene, TissueConfig
from jiggle_mj.scenes.tissue.jaws import Jaws
from jiggle_mj.scenes.tissue.model import build_tissue

G = 9.81
"""Acceleration of gravity [m/s^2]."""
TIMESTEP = 2e-3
"""Timestep [s], a tenth of the scenes': with theirs a swing decays numerically."""
NOISE = 3e-4
"""Standard deviation of each observed coordinate [m]."""
REPORT, GAP = 0.02, 0.1
"""Time between reports of the tool, and between frames [s]."""
N_FRAMES, N_STILL = 20, 20
"""Frames of each grasp, and still frames before the first."""
PAUSE = 1.0
"""Time between two grasps [s]."""
SETTLE_TIME, SETTLED = 0.1, 1e-4
"""Shortest time of settling [s], and the largest speed of a sheet at rest [m/s]."""
ON_EDGE = 1e-6
"""Distance within which a vertex is on the upper edge [m]."""
SHEET = Declaration(
    membrane_stiffness=30.0, poisson=0.45, thickness=1e-3, areal_density=1.0, gravity=(0.0, -G, 0.0), bed=False
)


class HangingSheet:
    """Sheet of 0.10 m x 0.12 m of the default tissue, hanging at rest."""

    def __init__(self) -> None:
        scene = Scene(
            name="hanging",
            tissue=TissueConfig(size=(0.1, 0.12), spacing=0.011, mesh="equilateral"),
            bed=BedConfig(present=False),
        )
        tissue = build_tissue(scene, drawn=False)
        self.model, self.data = tissue.model, mujoco.MjData(tissue.model)
        self.model.opt.gravity, self.model.opt.timestep = SHEET.gravity, TIMESTEP
        mujoco.mj_forward(self.model, self.data)
        height = tissue.sheet.vertices[:, 1]
        self.top = np.flatnonzero(height > height.max() - ON_EDGE)
        self.jaws = Jaws(tissue, self.data)
        self.jaws.tip = np.array([0.0, height.max(), 0.0])
        self.jaws.close(self.top)
        while self.data.time < SETTLE_TIME or np.abs(self.data.qvel).max() > SETTLED:
            mujoco.mj_step(self.model, self.data)

    def swung(self, displacement: Callable[[float], np.ndarray], seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and tip [m] at every report, while the tip moves by displacement(t) [m]."""
        start, positions, tips = self.jaws.tip, [], []
        for k in range(round(seconds / TIMESTEP) + 1):
            if k % round(REPORT / TIMESTEP) == 0:
                positions.append(self.data.flexvert_xpos.copy())
                tips.append(self.jaws.tip)
            self.jaws.tip = start + displacement((k + 1) * TIMESTEP)
            mujoco.mj_step(self.model, self.data)
        return np.array(positions), np.array(tips)


def smooth(u: float) -> float:
    """Return a step from 0 to 1 as u goes from 0 to 1, with continuous speed."""
    u = min(max(u, 0.0), 1.0)
    return u * u * (3 - 2 * u)


def recording(grasps: int, seed: int) -> list[Observation]:
    """Return still frames, then grasps in each of which the tip makes three random moves, mostly across the sheet."""
    rng, observations, began = np.random.default_rng(seed), [], N_STILL * GAP

    def observe(x, tip, time, grasp, top, reports=()):
        points = MeasuredPoints(positions=x + NOISE * rng.normal(size=x.shape), track_id=np.arange(len(x)), sd=NOISE)
        tool = ToolState(
            position=tip,
            quat_wxyz=IDENTITY_WXYZ,
            closed=grasp > 0,
            grasp=grasp,
            radius=0.01,
            held_tracks=tuple(top.tolist()),
        )
        observations.append(
            Observation(index=len(observations), time=round(time * 1e9), tool=tool, reports=reports, points=points)
        )

    for grasp in range(1, grasps + 1):
        sheet = HangingSheet()
        positions, tips = sheet.swung(_random_moves(rng), (N_FRAMES - 1) * GAP)
        if grasp == 1:
            for k in range(N_STILL):
                observe(positions[0], tips[0], k * GAP, 0, sheet.top)
        reports: list[ToolReport] = []
        for k, (x, tip) in enumerate(zip(positions, tips, strict=True)):
            time = began + k * REPORT
            if k % round(GAP / REPORT):
                reports.append(ToolReport(time=round(time * 1e9), position=tip))
            else:
                observe(x, tip, time, grasp, sheet.top, tuple(reports))
                reports = []
        began += N_FRAMES * GAP + PAUSE
    return observations


def _random_moves(rng: np.random.Generator) -> Callable[[float], np.ndarray]:
    """Return the displacement of the tip [m] at a time [s]: three smooth moves, one after the other."""
    moves, begins = [], 0.3
    for _ in range(3):
        duration = rng.uniform(0.2, 0.5)
        along, up, across = rng.uniform(-0.015, 0.015), rng.uniform(-0.01, 0.01), rng.uniform(0.01, 0.025)
        moves.append((begins, duration, np.array([along, up, rng.choice([-1, 1]) * across])))
        begins += duration + rng.uniform(0, 0.3)
    return lambda t: np.sum([move * smooth((t - begins) / duration) for begins, duration, move in moves], axis=0)
