"""The stiffness of the shell's triangles as MuJoCo stores it, which can be changed while the simulation runs.

With s_i = l_i^2 - L_i^2 for the three edges of an element, its energy is 1/4 s^T K s. MuJoCo stores six numbers of K,
the upper triangle row by row. Measured: K = 2 A M^-T C M^-1, with s = M e, e the Green strain and C the membrane's
stiffness.
"""

import numpy as np
from jaxtyping import Float

from .mesh import triangle_areas
from .simulation import Simulation


class Elements:
    """The f triangles of one simulation."""

    def __init__(self, simulation: Simulation) -> None:
        """Open views into the model; what is written to `stiffness` holds from the next step on."""
        self._model, self._data = simulation.model, simulation.data
        model, place = simulation.model, simulation.tissue.sheet.vertices
        self._edges = model.flex_elemedge.reshape(-1, 3)
        corners = place[model.flex_elem.reshape(-1, 3)]
        self.centres: Float[np.ndarray, "f 2"] = corners.mean(axis=1)
        """Centroids in tissue coordinates [m]."""
        self.areas: Float[np.ndarray, " f"] = np.abs(triangle_areas(place, model.flex_elem.reshape(-1, 3)))
        """Areas at rest [m^2]."""
        self.stiffness: Float[np.ndarray, "f 21"] = model.flex_stiffness.reshape(len(corners), -1)
        """K [N/m^3]; the first six of the 21 numbers are those of a membrane."""
        x, y = np.moveaxis(place[model.flex_edge[self._edges, 1]] - place[model.flex_edge[self._edges, 0]], 2, 0)
        self._strain = np.linalg.inv(2 * np.stack([x**2, y**2, 2 * x * y], axis=2))

    def add(self, elasticity: Float[np.ndarray, "3 3"]) -> None:
        """Add a membrane with the energy density E^T C E / 2, C in N/m, E the Green strain (E_xx, E_yy, E_xy)."""
        energy = np.einsum("f,fpi,pq,fqj->fij", self.areas, self._strain, elasticity, self._strain)
        row, column = np.triu_indices(3)
        self.stiffness[:, :6] += 2 * energy[:, row, column]

    def squared_strain(self) -> Float[np.ndarray, " f"]:
        """Return the squared Frobenius norm of each element's Green strain."""
        s = self._data.flexedge_length[self._edges] ** 2 - self._model.flexedge_length0[self._edges] ** 2
        xx, yy, xy = np.einsum("fij,fj->if", self._strain, s)
        return xx**2 + yy**2 + 2 * xy**2
