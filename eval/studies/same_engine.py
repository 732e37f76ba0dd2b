"""A truth made by the estimator's own engine, as in the paper's simulated experiments: no gap but the noise.

Mesh, attached vertices and grasps are a scene's; stiffness, height and increments are the paper's or stated here. Every
grasp begins at rest, and the held particles hang on the estimator's own springs. Two engines:

- `xpbd`: x_t+1 = f(x_t, u_t, b*), the simulator inside the explicit filter. No weight, no bed.
- `equilibrium`: argmin U(x; b*, u) of the implicit filter's energy, weight and bed included.

The estimator is told the mesh, and which particles are held; it sees every particle with noise, which a seed draws.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jiggle_mj.actions import Action, Grasp, Move, Release
from jiggle_mj.estimator import EstimatorConfig
from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.estimator.physics.energy import SheetEnergy
from jiggle_mj.estimator.physics.environment import Grip
from jiggle_mj.estimator.physics.equilibrium import equilibrium
from jiggle_mj.estimator.physics.mesh import SheetMesh
from jiggle_mj.estimator.physics.simulator import SWEEPS_PER_STEP, simulator
from jiggle_mj.estimator.physics.surrogate import surrogate
from jiggle_mj.observation import Declaration, DeclaredMesh, MeasuredPoints, Observation, ToolState
from jiggle_mj.scenes import Scene, programme
from jiggle_mj.scenes.scene.attachments import owners
from jiggle_mj.scenes.tissue.mesh import build_sheet
from jiggle_mj.truth import Truth, TruthFrame

Engine = Literal["xpbd", "equilibrium"]

STIFFNESS = 0.01
"""b* of each attached particle [membrane stiffness]; the paper's 0.1 has no unit, and its membrane's is not stated."""
NOISE = 2e-4
"""Standard deviation of each coordinate [m]; the paper states none."""
HEIGHT, INCREMENTS = 0.5, 5
"""Of a lift: share of the sheet's width, as in the paper, and number of moves."""
FORCE_TOLERANCE = 1e-6
"""Of an equilibrium [N]; a particle weighs 1.6e-4."""
AWAY = np.array([0.0, 0.0, 0.5])
"""The tip before the first grasp [m]."""


@dataclass(frozen=True, kw_only=True)
class SameEngine:
    """What the estimator is told, what it sees, and what only the scoring may read."""

    declaration: Declaration
    observations: tuple[Observation, ...]
    truth: Truth


@dataclass(frozen=True, kw_only=True)
class _Moment:
    """One frame without noise."""

    x: Float[np.ndarray, "n 3"]
    tool: ToolState


def same_engine(
    scene: Scene, engine: Engine, *, seed: int, grasps: int = 4, stiffness: float = STIFFNESS, noise: float = NOISE
) -> SameEngine:
    """Lift the sheet, and observe it with noise.

    Args:
        scene: whose sheet and shapes; their stiffness is not used.
        engine: what computes the truth.
        seed: of the noise, and of nothing else.
        grasps: corners that are lifted, one after the other.
        stiffness: of an attached particle, as a share of the membrane stiffness.
        noise: standard deviation of each observed coordinate [m]; stated as such to the estimator.
    """
    mesh, attached = sheet(scene)
    declaration, moments = _moments(scene, engine, grasps, stiffness)
    b, rng = stiffness * declaration.membrane_stiffness * attached, np.random.default_rng(seed)
    ids, observations, frames = np.arange(mesh.n), [], []
    for index, moment in enumerate(moments):
        seen = MeasuredPoints(positions=moment.x + noise * rng.normal(size=moment.x.shape), track_id=ids, sd=noise)
        observations.append(Observation(index=index, time=index, tool=moment.tool, points=seen))
        load = b * np.linalg.norm(moment.x - mesh.rest, axis=1)
        frames.append(
            TruthFrame(index=index, time=index, positions=moment.x, stiffness=b, tip=moment.tool.position, load=load)
        )
    details = {"engine": engine, "stiffness": stiffness, "noise": noise, "seed": seed, "grasps": grasps}
    truth = Truth(
        rest=mesh.rest, faces=mesh.faces, attached=attached, frames=tuple(frames), scene=scene.name, details=details
    )
    return SameEngine(declaration=declaration, observations=tuple(observations), truth=truth)


def sheet(scene: Scene) -> tuple[SheetMesh, Bool[np.ndarray, " n"]]:
    """The scene's mesh, flat at the height 0, and its attached particles."""
    tissue = scene.tissue
    flat = build_sheet(size=tissue.size, spacing=tissue.spacing, kind=tissue.mesh, seed=tissue.seed)
    rest = np.column_stack([flat.vertices, np.zeros(len(flat.vertices))])
    return SheetMesh(rest, flat.faces), owners(scene.attachments, flat.vertices) >= 0


@cache
def _moments(scene: Scene, engine: Engine, grasps: int, stiffness: float) -> tuple[Declaration, tuple[_Moment, ...]]:
    """The declaration and all frames; the same for every seed."""
    mesh, attached = sheet(scene)
    named = DeclaredMesh(vertices=mesh.rest, faces=mesh.faces, track_id=np.arange(mesh.n))
    declaration = replace(scene.declared.declaration(), mesh=named)
    if engine == "xpbd":
        declaration = replace(declaration, gravity=(0.0, 0.0, 0.0), bed=False)
    with jax.enable_x64(True), one_thread():
        b = jnp.asarray(stiffness * declaration.membrane_stiffness * attached)
        step = (_xpbd if engine == "xpbd" else _equilibrium)(mesh, declaration, b)
        return declaration, tuple(_carried_out(_actions(scene, grasps), mesh, declaration, step))


def _actions(scene: Scene, grasps: int) -> Iterator[Action]:
    """The scene's programme with the paper's lifts."""
    height = HEIGHT * scene.tissue.size[0]
    plan = replace(scene.programme, height=height, increments=INCREMENTS, still_frames=1, lowering=0)
    begun = 0
    for action in programme(replace(scene, programme=plan)):
        begun += isinstance(action, Grasp)
        if begun > grasps:
            return
        if not isinstance(action, Release):
            yield action


def _carried_out(actions: Iterator[Action], mesh: SheetMesh, declaration: Declaration, step) -> Iterator[_Moment]:
    grip, x, stiff = None, mesh.rest, EstimatorConfig().grip_stiffness * declaration.membrane_stiffness
    tool = ToolState(position=AWAY, quat_wxyz=np.eye(4)[0], closed=False, grasp=0, radius=1e-9)
    for action in actions:
        if isinstance(action, Grasp):
            x = mesh.rest
            grip = Grip.build(jnp.asarray(x), jnp.asarray(action.point), radius=action.radius, stiffness=stiff)
            held = tuple(np.flatnonzero(grip.stiffness).tolist())
            tool = replace(
                tool, position=action.point, closed=True, grasp=tool.grasp + 1, radius=action.radius, held_tracks=held
            )
        elif isinstance(action, Move) and grip is not None:
            tool = replace(tool, position=action.to)
            x = step(x, eqx.tree_at(lambda g: g.tip, grip, jnp.asarray(action.to)))
        yield _Moment(x=x, tool=tool)


def _xpbd(mesh: SheetMesh, declaration: Declaration, b):
    """The explicit filter's f."""
    f = eqx.filter_jit(simulator(mesh, declaration).step)
    return lambda x, grip: np.asarray(f(jnp.asarray(x), b, grip, sweeps=SWEEPS_PER_STEP))


def _equilibrium(mesh: SheetMesh, declaration: Declaration, b):
    """Argmin U, searched from the frame before."""
    energy, search = surrogate(mesh, declaration), eqx.filter_jit(equilibrium)

    def step(x, grip):
        gripped = SheetEnergy.build(mesh.rest, (*energy.terms, grip), energy.layout)
        found = search(gripped, b, jnp.asarray(x), force_tolerance=FORCE_TOLERANCE, max_steps=1000)
        if not found.converged:
            raise RuntimeError(
                f"the truth's equilibrium stopped at {float(found.force):.2g} N after {found.steps} steps."
            )
        return np.asarray(found.x)

    return step
