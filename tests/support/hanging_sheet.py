"""A sheet that hangs by its upper edge and is swung, by the reference's engine: gravity goes along its y axis."""

import mujoco
import numpy as np

from jiggle_mj.observation import UNTURNED, Declaration, MeasuredPoints, Observation, ToolReport, ToolState
from jiggle_mj.scenes.scene.scene import BedConfig, Scene, TissueConfig
from jiggle_mj.scenes.tissue.jaws import Jaws
from jiggle_mj.scenes.tissue.model import build_tissue

G = 9.81
TIMESTEP = 2e-3
"""A tenth of the scenes': at theirs a swing dies numerically [s]."""
NOISE = 3e-4
"""[m]."""
REPORT, GAP, FRAMES, STILL = 0.02, 0.1, 20, 20
"""Time between reports of the tool and between frames [s]; frames of each grasp, and still ones before the first."""
SHEET = Declaration(
    membrane_stiffness=30.0, poisson=0.45, thickness=1e-3, areal_density=1.0, gravity=(0.0, -G, 0.0), bed=False
)


class HangingSheet:
    """0.10 m x 0.12 m of the default tissue, at rest."""

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
        self.top = np.flatnonzero(height > height.max() - 1e-6)
        self.jaws = Jaws(tissue, self.data)
        self.jaws.tip = np.array([0.0, height.max(), 0.0])
        self.jaws.close(self.top)
        while self.data.time < 0.1 or np.abs(self.data.qvel).max() > 1e-4:
            mujoco.mj_step(self.model, self.data)

    def swung(self, way, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """Positions and the tip at every report, while the tip goes by way(t)."""
        start, positions, tips = self.jaws.tip, [], []
        for k in range(round(seconds / TIMESTEP) + 1):
            if k % round(REPORT / TIMESTEP) == 0:
                positions.append(self.data.flexvert_xpos.copy())
                tips.append(self.jaws.tip)
            self.jaws.tip = start + way((k + 1) * TIMESTEP)
            mujoco.mj_step(self.model, self.data)
        return np.array(positions), np.array(tips)


def smooth(u: float) -> float:
    """From 0 to 1, without a jump of the speed."""
    u = min(max(u, 0.0), 1.0)
    return u * u * (3 - 2 * u)


def recording(grasps: int, seed: int) -> list[Observation]:
    """Still frames, then grasps in each of which the tip goes three ways at random, to and fro across the sheet."""
    rng, seen, began = np.random.default_rng(seed), [], STILL * GAP

    def observed(x, tip, time, grasp, top, told=()):
        points = MeasuredPoints(positions=x + NOISE * rng.normal(size=x.shape), track_id=np.arange(len(x)), sd=NOISE)
        tool = ToolState(
            position=tip,
            quat_wxyz=UNTURNED,
            closed=grasp > 0,
            grasp=grasp,
            radius=0.01,
            held_tracks=tuple(top.tolist()),
        )
        seen.append(Observation(index=len(seen), time=round(time * 1e9), tool=tool, reports=told, points=points))

    for grasp in range(1, grasps + 1):
        sheet, way = HangingSheet(), _ways(rng)
        positions, tips = sheet.swung(way, (FRAMES - 1) * GAP)
        if grasp == 1:
            for k in range(STILL):
                observed(positions[0], tips[0], k * GAP, 0, sheet.top)
        told: list[ToolReport] = []
        for k, (x, tip) in enumerate(zip(positions, tips, strict=True)):
            time = began + k * REPORT
            if k % round(GAP / REPORT):
                told.append(ToolReport(time=round(time * 1e9), position=tip))
            else:
                observed(x, tip, time, grasp, sheet.top, tuple(told))
                told = []
        began += FRAMES * GAP + 1.0
    return seen


def _ways(rng: np.random.Generator):
    legs, begins = [], 0.3
    for _ in range(3):
        lasts = rng.uniform(0.2, 0.5)
        along, up, across = rng.uniform(-0.015, 0.015), rng.uniform(-0.01, 0.01), rng.uniform(0.01, 0.025)
        legs.append((begins, lasts, np.array([along, up, rng.choice([-1, 1]) * across])))
        begins += lasts + rng.uniform(0, 0.3)
    return lambda t: sum(leg * smooth((t - begins) / lasts) for begins, lasts, leg in legs)
