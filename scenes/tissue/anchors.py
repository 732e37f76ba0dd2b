"""Springs and welds between the sheet and the world: what `model.py` compiled, as layers of `springs.py`.

The scene's attachments are one layer and sutures another; disturbances may add more. MuJoCo has one linear spring for
each joint, so the layers are merged after each change: stiffnesses add up, and the anchor is their weighted mean.
"""

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from ..scene.attachments import vertex_values
from ..scene.scene import Scene
from .constraints import constraint_force
from .model import TissueModel
from .springs import Springs


class Anchors:
    """The springs and welds of one sheet of n vertices."""

    def __init__(self, tissue: TissueModel, scene: Scene, data: mujoco.MjData) -> None:
        """Make a spring for each vertex from the scene's attachments; `data` is the sheet at rest."""
        self._tissue, self._data = tissue, data
        self._rest = data.qpos[tissue.qpos_address].copy()

        def value(key: str, free: object = 0.0) -> np.ndarray:
            return vertex_values(scene.attachments, tissue.owner, key, free=free)

        def limit(key: str) -> np.ndarray:
            return np.where(value(key) > 0, value(key), np.inf)

        self.attachments = Springs(
            stiffness=np.where(np.isfinite(tissue.stiffness), tissue.stiffness, 0.0),
            anchor=value("offset", np.zeros(3)),
            slack=value("slack"),
            hardening=value("hardening"),
            yields_at=limit("yields_at"),
            creep=value("creep"),
            breaks_at=limit("breaks_at"),
        )
        """Springs of the scene's attachments."""
        n = len(tissue.owner)
        self.sutures = Springs(stiffness=np.zeros(n), anchor=np.zeros((n, 3)))
        """Springs of the sutures made so far."""
        self.extra_layers: list[Springs] = []
        """Springs of disturbances; they pull at the sheet, but do not count as attachments."""
        self.welds_break_at = limit("breaks_at")
        """Force above which each vertex's weld breaks [N]."""
        self.write()

    @property
    def layers(self) -> list[Springs]:
        """Return all layers of springs."""
        return [self.attachments, self.sutures, *self.extra_layers]

    @property
    def displacement(self) -> Float[np.ndarray, "n 3"]:
        """Return the displacement of each vertex from its rest position [m]."""
        return self._data.qpos[self._tissue.qpos_address] - self._rest

    @property
    def welded(self) -> Bool[np.ndarray, " n"]:
        """Return which vertices are welded now."""
        welded = np.zeros(len(self._tissue.stiffness), dtype=bool)
        for vertex, weld in self._tissue.welds.items():
            welded[vertex] = self._data.eq_active[weld]
        return welded

    @property
    def stiffness(self) -> Float[np.ndarray, " n"]:
        """Return the stiffness of attachments and sutures at each vertex now [N/m]; infinity is a weld."""
        return np.where(self.welded, np.inf, self.attachments.stiffness + self.sutures.stiffness)

    @property
    def load(self) -> Float[np.ndarray, " n"]:
        """Return the attachment load of each vertex [N]: the forces of its springs plus that of its weld."""
        moved = self.displacement
        return self.attachments.force(moved) + self.sutures.force(moved) + self._weld_load()

    def follow(self) -> None:
        """Let springs and welds break, yield and creep for the last step."""
        moved, duration = self.displacement, self._tissue.model.opt.timestep
        changed = [layer.follow(moved, duration) for layer in self.layers]
        if np.isfinite(self.welds_break_at).any():
            self._open_welds(self._weld_load() > self.welds_break_at)
        if any(changed) or not all(layer.linear for layer in self.layers):
            self.write()

    def cut(self, vertices: Bool[np.ndarray, " n"]) -> None:
        """Remove the attachments, sutures and welds of these vertices."""
        for layer in (self.attachments, self.sutures):
            layer.stiffness = np.where(vertices, 0.0, layer.stiffness)
        self._open_welds(vertices)
        self.write()

    def sew(
        self, vertices: Bool[np.ndarray, " n"], *, stiffness: float, offset: Float[np.ndarray, " 3"], slack: float
    ) -> None:
        """Attach these vertices to their rest positions plus an offset; an earlier suture there is replaced."""
        sutures = self.sutures
        sutures.stiffness = np.where(vertices, stiffness, sutures.stiffness)
        sutures.anchor = np.where(vertices[:, None], offset, sutures.anchor)
        sutures.slack = np.where(vertices, slack, sutures.slack)
        self.write()

    def write(self) -> None:
        """Merge the layers into MuJoCo's springs: `jnt_stiffness` and `qpos_spring`."""
        moved, tissue = self.displacement, self._tissue
        linear = [layer.linearised(moved) for layer in self.layers]
        stiffness = np.sum([k for k, _ in linear], axis=0)
        weighted_anchor = np.sum([k_anchor for _, k_anchor in linear], axis=0)
        anchor = weighted_anchor / np.where(stiffness > 0, stiffness, 1.0)[:, None]
        tissue.model.jnt_stiffness[tissue.joints] = stiffness[:, None]
        tissue.model.qpos_spring[tissue.qpos_address] = self._rest + anchor

    def _open_welds(self, vertices: Bool[np.ndarray, " n"]) -> None:
        for vertex, weld in self._tissue.welds.items():
            if vertices[vertex]:
                self._data.eq_active[weld] = 0

    def _weld_load(self) -> Float[np.ndarray, " n"]:
        load, welds = np.zeros(len(self._tissue.stiffness)), self._tissue.welds
        load[list(welds)] = np.linalg.norm(constraint_force(self._data, np.array([*welds.values()], int)), axis=1)
        return load
