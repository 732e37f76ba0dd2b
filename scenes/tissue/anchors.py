"""What holds the sheet to the world while it moves: layers of springs, and welds.

The scene's attachments are one layer; what disturbs the sheet may add others. MuJoCo has one linear spring for each
joint, so the layers are merged: stiffnesses add up, and the anchor is their weighted mean.
"""

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from ..scene.scene import Scene
from .constraints import constraint_force
from .model import TissueModel
from .springs import Springs


class Anchors:
    """The springs and welds of one sheet."""

    def __init__(self, tissue: TissueModel, scene: Scene, data: mujoco.MjData) -> None:
        """As the scene has them; `data` at rest."""
        self._tissue, self._data = tissue, data
        self._rest = data.qpos[tissue.qpos_address].copy()
        owner = tissue.owner

        def of(name: str, free: object) -> np.ndarray:
            return np.array([free if one < 0 else getattr(scene.attachments[one], name) for one in owner], dtype=float)

        def limit(name: str) -> np.ndarray:
            stated = of(name, 0.0)
            return np.where(stated > 0, stated, np.inf)

        self.attachments = Springs(
            stiffness=np.where(np.isfinite(tissue.stiffness), tissue.stiffness, 0.0),
            anchor=of("offset", np.zeros(3)),
            slack=of("slack", 0.0),
            hardening=of("hardening", 0.0),
            yields_at=limit("yields_at"),
            creep=of("creep", 0.0),
            breaks_at=limit("breaks_at"),
        )
        n = len(owner)
        self.sutures = Springs(stiffness=np.zeros(n), anchor=np.zeros((n, 3)))
        """Those sewn on the way."""
        self.others: list[Springs] = []
        """Springs that pull at the sheet, but attach it to nothing."""
        self.welds_break_at = limit("breaks_at")
        """Largest force of each vertex's weld [N]."""
        self.write()

    @property
    def layers(self) -> list[Springs]:
        """All springs."""
        return [self.attachments, self.sutures, *self.others]

    @property
    def moved(self) -> Float[np.ndarray, "n 3"]:
        """How far each vertex is from its place at rest [m]."""
        return self._data.qpos[self._tissue.qpos_address] - self._rest

    @property
    def welded(self) -> Bool[np.ndarray, " n"]:
        """Which vertices are welded now."""
        welded = np.zeros(len(self._tissue.stiffness), dtype=bool)
        for vertex, weld in self._tissue.welds.items():
            welded[vertex] = self._data.eq_active[weld]
        return welded

    @property
    def stiffness(self) -> Float[np.ndarray, " n"]:
        """Of what attaches each vertex now, sutures among it [N/m]; infinity is a weld."""
        return np.where(self.welded, np.inf, self.attachments.stiffness + self.sutures.stiffness)

    @property
    def load(self) -> Float[np.ndarray, " n"]:
        """What the springs that attach each vertex pull with, and the constraint force of each weld [N]."""
        moved = self.moved
        return self.attachments.force(moved) + self.sutures.force(moved) + self._weld_load()

    def follow(self) -> None:
        """Break, yield and creep for the step that has just been taken."""
        moved, duration = self.moved, self._tissue.model.opt.timestep
        changed = [layer.follow(moved, duration) for layer in self.layers]
        if np.isfinite(self.welds_break_at).any():
            self._part(self._weld_load() > self.welds_break_at)
        if any(changed) or not all(layer.linear for layer in self.layers):
            self.write()

    def cut(self, vertices: Bool[np.ndarray, " n"]) -> None:
        """Nothing attaches these from now on."""
        for layer in (self.attachments, self.sutures):
            layer.stiffness = np.where(vertices, 0.0, layer.stiffness)
        self._part(vertices)
        self.write()

    def sew(
        self, vertices: Bool[np.ndarray, " n"], *, stiffness: float, offset: Float[np.ndarray, " 3"], slack: float
    ) -> None:
        """Attach these, to their places at rest but for an offset; an earlier suture there is replaced."""
        sutures = self.sutures
        sutures.stiffness = np.where(vertices, stiffness, sutures.stiffness)
        sutures.anchor = np.where(vertices[:, None], offset, sutures.anchor)
        sutures.slack = np.where(vertices, slack, sutures.slack)
        self.write()

    def write(self) -> None:
        """Merge the layers into MuJoCo's springs."""
        moved, tissue = self.moved, self._tissue
        parts = [layer.linearised(moved) for layer in self.layers]
        stiffness = np.sum([k for k, _ in parts], axis=0)
        pulled = np.sum([pull for _, pull in parts], axis=0)
        anchor = pulled / np.where(stiffness > 0, stiffness, 1.0)[:, None]
        tissue.model.jnt_stiffness[tissue.joints] = stiffness[:, None]
        tissue.model.qpos_spring[tissue.qpos_address] = self._rest + anchor

    def _part(self, vertices: Bool[np.ndarray, " n"]) -> None:
        """Open the welds among these."""
        for vertex, weld in self._tissue.welds.items():
            if vertices[vertex]:
                self._data.eq_active[weld] = 0

    def _weld_load(self) -> Float[np.ndarray, " n"]:
        load, welds = np.zeros(len(self._tissue.stiffness)), self._tissue.welds
        load[list(welds)] = np.linalg.norm(constraint_force(self._data, np.array([*welds.values()], int)), axis=1)
        return load
