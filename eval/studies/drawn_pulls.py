"""A lift of one corner of a sheet whose attachments are drawn, by three references.

- `assumed`: our own engine, with errors of forces and anchors drawn as the implicit filter assumes them. The frames are
  then draws from the filter's own model, up to its linearisation.
- `exact`: our own engine without such errors; the filter is given a small one.
- `mujoco`: the reference tissue.

In all three, each coordinate of each particle is seen with white noise of the declared size.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jiggle_mj.estimator import EstimatorConfig
from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.estimator.effects.terms import DeadLoad
from jiggle_mj.estimator.filter_builder import force_balance
from jiggle_mj.estimator.physics.energy import SheetEnergy
from jiggle_mj.estimator.physics.surrogate import surrogate
from jiggle_mj.observation import Declaration, DeclaredMesh, MeasuredPoints, Observation
from jiggle_mj.options import CalibrationReference
from jiggle_mj.scenes import Reference, Scene
from jiggle_mj.scenes.scene.attachments import Disc

from .same_engine import Moment, executed, lifts, settled, sheet

REFERENCES: tuple[CalibrationReference, ...] = get_args(CalibrationReference)
RIGID = 0.99
"""Largest bounded stiffness of a truth: 99 times the membrane stiffness. Stiffer springs move as little in any lift."""
POINT_SD = 1e-4
"""Standard deviation of each coordinate of a particle [m]."""
EXACT_FORCE_SD = 5e-4
"""Force error that the filter is given where forces are exact [k x spacing]."""
VERTEX_SHARE = 0.1
"""Radius of a disc that attaches a single vertex [spacing]."""


@dataclass(frozen=True, kw_only=True)
class DrawnPull:
    """The lift, without noise."""

    declaration: Declaration
    """What the estimator is given, the mesh included."""
    moments: tuple[Moment, ...]
    """The frames, the first at rest, the second with closed jaws."""

    def observed(self, rng: np.random.Generator) -> Iterator[Observation]:
        """Yield the frames with noise."""
        for index, moment in enumerate(self.moments):
            seen = moment.x + POINT_SD * rng.normal(size=moment.x.shape)
            points = MeasuredPoints(positions=seen, track_id=np.arange(len(seen)), sd=POINT_SD)
            yield Observation(index=index, time=index, tool=moment.tool, points=points)


def estimator_config(reference: CalibrationReference) -> EstimatorConfig:
    """Return the estimator's settings: the defaults, with a small force error where forces are exact."""
    return EstimatorConfig(force_sd=EXACT_FORCE_SD) if reference == "exact" else EstimatorConfig()


def drawn_pull(
    scene: Scene, reference: CalibrationReference, s: Float[np.ndarray, " n"], rng: np.random.Generator
) -> DrawnPull:
    """Lift the first corner of a sheet.

    Args:
        scene: gives the sheet; its attachments are not used.
        reference: computes the truth.
        s: bounded stiffness of each particle of `sheet(scene)`, at most `RIGID`.
        rng: random numbers of the assumed errors.

    Raises:
        RuntimeError: an equilibrium did not converge.
    """
    mesh, _ = sheet(replace(scene, attachments=()))
    declaration = scene.declared.declaration()
    b = declaration.membrane_stiffness * s / (1 - s)
    if reference == "mujoco":
        rest, moments = _by_mujoco(scene, mesh.rest, mesh.spacing, b)
    else:
        with jax.enable_x64(True), one_thread():
            errors = rng if reference == "assumed" else None
            rest, moments = mesh.rest, tuple(_by_own_engine(scene, declaration, b, errors))
    declared = DeclaredMesh(vertices=rest, faces=mesh.faces, track_id=np.arange(mesh.n))
    return DrawnPull(declaration=replace(declaration, mesh=declared), moments=moments)


def _by_own_engine(
    scene: Scene, declaration: Declaration, b: Float[np.ndarray, " n"], errors: np.random.Generator | None
) -> Iterator[Moment]:
    """Yield equilibria of the estimator's own energy; with `errors`, forces and anchors err as the filter assumes.

    With f the gradient of the sheet's energy, e the error of the forces and a that of the anchors, f + b (d - a) = e.
    """
    mesh, _ = sheet(replace(scene, attachments=()))
    energy, config = surrogate(mesh, declaration), EstimatorConfig()
    balance, load = force_balance(mesh, energy, declaration, config), DeadLoad.build(mesh.rest)
    tau = eqx.filter_jit(balance.error)
    stiffness = jnp.asarray(b)

    def step(x, grip):
        force, anchor = np.zeros_like(mesh.rest), np.zeros_like(mesh.rest)
        gripped = SheetEnergy.build(mesh.rest, (*energy.terms, grip, load), energy.layout)
        if errors is not None:
            x = settled(gripped, stiffness, x)
            force = np.asarray(tau(jnp.asarray(x)))[:, None] * errors.normal(size=x.shape)
            anchor = config.anchor_sd * errors.normal(size=x.shape)
        loaded = eqx.tree_at(
            lambda e: (e.rest, e.terms[-1].force), gripped, (jnp.asarray(mesh.rest + anchor), jnp.asarray(force))
        )
        return settled(loaded, stiffness, x)

    yield from executed(lifts(scene, 1), mesh, declaration, step, closed=step)


def _by_mujoco(
    scene: Scene, flat: Float[np.ndarray, "n 3"], spacing: float, b: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 3"], tuple[Moment, ...]]:
    """Return the rest positions of the reference tissue [m], and its state after each action."""
    discs = tuple(
        Disc(centre=(float(x), float(y)), radius=VERTEX_SHARE * spacing, stiffness=float(stiffness))
        for (x, y, _), stiffness in zip(flat, b, strict=True)
        if stiffness > 0
    )
    with Reference(replace(scene, attachments=discs), seed=0, sensing="particles") as tissue:
        rest, moments = tissue.truth().rest, []
        for action in lifts(scene, 1):
            tool = tissue.step(action).tool
            moments.append(Moment(x=tissue.truth_frame().positions, tool=tool))
    return rest, tuple(moments)
