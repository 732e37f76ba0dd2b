"""A truth made by the estimator's own engine, as in the paper's simulated experiments: no model error but the noise.

Mesh, attached vertices and grasps come from a scene; stiffness, height and increments are the paper's or given here.
Every grasp begins at rest, and springs as in the estimator's model hold the grasped particles. Two engines:

- `xpbd`: x_t+1 = f(x_t, u_t, b*), the simulator inside the explicit filter. No weight, no bed.
- `equilibrium`: argmin U(x; b*, u) of the implicit filter's energy, weight and bed included.

The estimator gets the mesh, and which particles are held. It sees every particle with noise, which a seed draws.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

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

STIFFNESS_SHARE = 0.01
"""b* of each attached particle [membrane stiffness].

The paper's 0.1 has no unit, and the stiffness of its membrane is not given.
"""
POINT_SD = 2e-4
"""Standard deviation of each coordinate [m]; the paper gives none."""
LIFT_SHARE = 0.5
"""Height of a lift as a share of the sheet's width, as in the paper."""
LIFT_INCREMENTS = 5
"""Moves of a lift."""
FORCE_TOLERANCE = 1e-6
"""Largest residual force of an equilibrium [N]; a particle weighs 1.6e-4."""
MAX_EQUILIBRIUM_STEPS = 1000
"""Most steps of the search for an equilibrium."""
OPEN_TIP = np.array([0.0, 0.0, 0.5])
"""Place of the tip before the first grasp [m], far above the sheet."""
OPEN_RADIUS = 1e-9
"""Radius of the jaws before the first grasp [m]: no particle is inside."""


@dataclass(frozen=True, kw_only=True)
class SameEngine:
    """Declaration and observations for the estimator, and the truth that only the scoring may read."""

    declaration: Declaration
    observations: tuple[Observation, ...]
    truth: Truth


@dataclass(frozen=True, kw_only=True)
class Moment:
    """One frame without noise."""

    x: Float[np.ndarray, "n 3"]
    tool: ToolState


def same_engine(
    scene: Scene,
    engine: Engine,
    *,
    seed: int,
    grasps: int = 4,
    stiffness: float = STIFFNESS_SHARE,
    noise: float = POINT_SD,
) -> SameEngine:
    """Lift the sheet, and observe it with noise.

    Args:
        scene: gives sheet and shapes; their stiffness is not used.
        engine: computes the truth.
        seed: of the noise, and of nothing else.
        grasps: corners that are lifted, one after the other.
        stiffness: of an attached particle, as a share of the membrane stiffness.
        noise: standard deviation of each observed coordinate [m]; the estimator gets the same number.
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
    """Return the scene's mesh, flat at the height 0, and its attached particles."""
    tissue = scene.tissue
    flat = build_sheet(size=tissue.size, spacing=tissue.spacing, kind=tissue.mesh, seed=tissue.seed)
    rest = np.column_stack([flat.vertices, np.zeros(len(flat.vertices))])
    return SheetMesh(rest, flat.faces), owners(scene.attachments, flat.vertices) >= 0


@cache
def _moments(scene: Scene, engine: Engine, grasps: int, stiffness: float) -> tuple[Declaration, tuple[Moment, ...]]:
    """Return the declaration and all frames; the same for every seed."""
    mesh, attached = sheet(scene)
    declared_mesh = DeclaredMesh(vertices=mesh.rest, faces=mesh.faces, track_id=np.arange(mesh.n))
    declaration = replace(scene.declared.declaration(), mesh=declared_mesh)
    if engine == "xpbd":
        declaration = replace(declaration, gravity=(0.0, 0.0, 0.0), bed=False)
    with jax.enable_x64(True), one_thread():
        b = jnp.asarray(stiffness * declaration.membrane_stiffness * attached)
        step = (_xpbd if engine == "xpbd" else _equilibrium)(mesh, declaration, b)
        return declaration, tuple(executed(lifts(scene, grasps), mesh, declaration, step))


def lifts(scene: Scene, grasps: int) -> Iterator[Action]:
    """Yield the scene's programme with the paper's lifts."""
    height = LIFT_SHARE * scene.tissue.size[0]
    plan = replace(scene.programme, height=height, increments=LIFT_INCREMENTS, still_frames=1, lowering=0)
    n_grasps = 0
    for action in programme(replace(scene, programme=plan)):
        n_grasps += isinstance(action, Grasp)
        if n_grasps > grasps:
            return
        if not isinstance(action, Release):
            yield action


Step = Callable[[Float[np.ndarray, "n 3"], Grip], Float[np.ndarray, "n 3"]]
"""Function that returns the positions after a move of the grip from those before it [m]."""


def executed(
    actions: Iterator[Action],
    mesh: SheetMesh,
    declaration: Declaration,
    step: Step,
    *,
    closed: Step = lambda rest, _: rest,
) -> Iterator[Moment]:
    """Yield the frame after each action.

    Args:
        actions: what the tool does.
        mesh: the sheet.
        declaration: its membrane stiffness gives that of the grip.
        step: moves the sheet after each move of the tip.
        closed: moves the sheet when the jaws close; by default it stays at rest.
    """
    grip, x, stiff = None, mesh.rest, EstimatorConfig().grip_stiffness * declaration.membrane_stiffness
    tool = ToolState(position=OPEN_TIP, quat_wxyz=np.eye(4)[0], closed=False, grasp=0, radius=OPEN_RADIUS)
    for action in actions:
        if isinstance(action, Grasp):
            x = mesh.rest
            grip = Grip.build(jnp.asarray(x), jnp.asarray(action.point), radius=action.radius, stiffness=stiff)
            held = tuple(np.flatnonzero(grip.stiffness).tolist())
            tool = replace(
                tool, position=action.point, closed=True, grasp=tool.grasp + 1, radius=action.radius, held_tracks=held
            )
            x = closed(x, grip)
        elif isinstance(action, Move) and grip is not None:
            tool = replace(tool, position=action.to)
            x = step(x, eqx.tree_at(lambda g: g.tip, grip, jnp.asarray(action.to)))
        yield Moment(x=x, tool=tool)


def _xpbd(mesh: SheetMesh, declaration: Declaration, b):
    """Return the explicit filter's f."""
    f = eqx.filter_jit(simulator(mesh, declaration).step)
    return lambda x, grip: np.asarray(f(jnp.asarray(x), b, grip, sweeps=SWEEPS_PER_STEP))


def _equilibrium(mesh: SheetMesh, declaration: Declaration, b):
    """Return the search for argmin U from the frame before."""
    energy = surrogate(mesh, declaration)
    return lambda x, grip: settled(SheetEnergy.build(mesh.rest, (*energy.terms, grip), energy.layout), b, x)


_search = eqx.filter_jit(equilibrium)


def settled(energy: SheetEnergy, b: Float[Array, " n"], x: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the equilibrium that a search from x reaches [m].

    Raises:
        RuntimeError: it did not converge.
    """
    found = _search(energy, b, jnp.asarray(x), force_tolerance=FORCE_TOLERANCE, max_steps=MAX_EQUILIBRIUM_STEPS)
    if not found.converged:
        raise RuntimeError(
            f"the equilibrium of the truth did not converge: the residual is {float(found.force):.2g} N after "
            f"{found.steps} steps; {FORCE_TOLERANCE:g} N is allowed."
        )
    return np.asarray(found.x)
