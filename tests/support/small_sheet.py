"""A small sheet that several tests share, so that JAX compiles its shapes once, and its lifts by our own engine."""

from dataclasses import dataclass, replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jiggle_mj.estimate import Belief
from jiggle_mj.estimator.belief.attachment_belief import AttachmentBelief
from jiggle_mj.estimator.belief.prior import prior_belief
from jiggle_mj.estimator.effects.sheet_model import FrameContext, SheetModel, centred, nominal_energy
from jiggle_mj.estimator.filters.config import FilterConfig
from jiggle_mj.estimator.filters.evidence import Evidence
from jiggle_mj.estimator.filters.force_balance import ForceBalance
from jiggle_mj.estimator.filters.implicit import ImplicitFilter, ImplicitState
from jiggle_mj.estimator.filters.posterior_summary import PosteriorSummary, Update
from jiggle_mj.estimator.physics.block_tridiagonal import BlockTridiagonal, Layout
from jiggle_mj.estimator.physics.energy import SheetEnergy
from jiggle_mj.estimator.physics.environment import Grip
from jiggle_mj.estimator.physics.equilibrium import equilibrium
from jiggle_mj.estimator.physics.mesh import SheetMesh
from jiggle_mj.estimator.physics.surrogate import surrogate
from jiggle_mj.eval.benchmark import estimator_benchmark as benchmark
from jiggle_mj.eval.metrics.calibration import nees_per_dof
from jiggle_mj.observation import Declaration

SPACING = 7e-3
DECLARATION = Declaration()
STIFFNESS = 3.0
"""Stiffness of each attached particle [N/m], a tenth of the membrane's."""
GRIP_RADIUS = 8e-3
STOOD = (np.zeros(1), np.zeros((1, 3)))
"""Time of the tool's report [s], and its displacement [m]."""
FORCE_TOLERANCE = 1e-8
"""Residual force of an equilibrium [N]; the weight of one particle is 4e-4."""

WELD = 1e6
"""Stiffness that stands for a weld [N/m]."""
NOISE, GRIP_SD = 1e-4, 1.5e-3
"""Standard deviations of the position of a seen particle, and of a held one [m]."""

OUTWARD = ((-1, -1), (1, -1), (1, 1), (-1, 1))
"""Directions of the four corners."""

search = eqx.filter_jit(equilibrium)


def equilateral(columns: int, rows: int, spacing: float = SPACING) -> SheetMesh:
    """Return the benchmark's mesh of equilateral triangles, at this file's spacing [m]."""
    return benchmark.equilateral(columns, rows, spacing)


def jittered(mesh: SheetMesh, share: float, seed: int = 0) -> SheetMesh:
    """Return the same triangles with every particle moved in the plane by up to `share` of the spacing."""
    move = np.random.default_rng(seed).uniform(-share, share, (mesh.n, 2)) * mesh.spacing
    return SheetMesh(mesh.rest + np.column_stack([move, np.zeros(mesh.n)]), mesh.faces)


def dense(layout: Layout, matrix: BlockTridiagonal) -> np.ndarray:
    """Return the 3n x 3n matrix in particle order."""
    nb, m = matrix.diagonal.shape[:2]
    whole = np.zeros((nb * m, nb * m))
    for k in range(nb):
        whole[k * m : (k + 1) * m, k * m : (k + 1) * m] = matrix.diagonal[k]
    for k in range(nb - 1):
        whole[(k + 1) * m : (k + 2) * m, k * m : (k + 1) * m] = matrix.lower[k]
        whole[k * m : (k + 1) * m, (k + 1) * m : (k + 2) * m] = np.asarray(matrix.lower[k]).T
    rows = (3 * np.asarray(layout.slot)[:, None] + np.arange(3)).ravel()
    return whole[np.ix_(rows, rows)]


@dataclass(frozen=True, kw_only=True)
class Lift:
    """One frame of a lifted sheet, without noise."""

    x: np.ndarray
    tip: np.ndarray
    held: np.ndarray
    grasp: int


@cache
def sheet() -> SheetMesh:
    """Return 81 particles, 60 mm x 48 mm, slightly irregular."""
    return jittered(equilateral(9, 9), 0.1)


@cache
def sheet_energy() -> SheetEnergy:
    """Return the energy of membrane, bending, weight and bed."""
    return surrogate(sheet(), DECLARATION)


@cache
def sheet_balance(force_sd: float, force_level: float = np.inf) -> ForceBalance:
    """Return the balance of forces that the implicit filter linearises, for forces in N."""
    return balance_of(sheet_energy(), force_sd, force_level)


def balance_of(energy: SheetEnergy, force_sd: float, force_level: float = np.inf) -> ForceBalance:
    """Return the balance of forces of the sheet with some energy.

    For data of its own model on its own mesh, no share of the forces is wrong: `force_level` is infinite.
    """
    k = DECLARATION.membrane_stiffness
    return ForceBalance.build(
        sheet(),
        energy,
        reference=k,
        force_sd=force_sd / FilterConfig().force_sd_floor,
        force_level=force_level,
        anchor_sd=1e-4,
        grip_stiffness=3 * k,
    )


@cache
def sheet_prior() -> AttachmentBelief:
    """Return the implicit filter's prior."""
    return prior_belief(sheet(), reference=DECLARATION.membrane_stiffness)


def at_rest(
    mesh: SheetMesh,
    declared: Declaration,
    *,
    at: float = 0.0,
    times: np.ndarray = STOOD[0],
    ways: np.ndarray = STOOD[1],
) -> tuple[SheetModel, FrameContext]:
    """Return a sheet's model without effects, and a moment at which it lies at rest whatever the tool reports."""
    x = jnp.asarray(mesh.rest)
    model = SheetModel(
        energy=nominal_energy(mesh, declared), tool=jnp.zeros(3), view=centred(mesh), time=jnp.asarray(at)
    )
    moment = FrameContext(
        rest=x,
        time=jnp.asarray(at),
        gap=jnp.asarray(0.1),
        earlier_gap=jnp.asarray(0.1),
        closed=jnp.asarray(at),
        now=x,
        before=x,
        earlier=x,
        report_times=jnp.asarray(times),
        reports=jnp.asarray(ways),
        past=x[None],
        began=jnp.zeros(1),
        ended=jnp.zeros(1),
    )
    return model, moment


def gripped(energy: SheetEnergy, x: np.ndarray, corner: np.ndarray, tip: np.ndarray) -> SheetEnergy:
    """Return the energy with jaws that closed at a corner around particles at x [m], and moved to `tip` since [m]."""
    grip = Grip.build(jnp.asarray(x), jnp.asarray(corner), radius=GRIP_RADIUS, stiffness=100.0)
    grip = eqx.tree_at(lambda g: g.tip, grip, jnp.asarray(tip))
    return SheetEnergy.build(np.asarray(energy.rest), (*energy.terms, grip), energy.layout)


def attached() -> np.ndarray:
    """Return which particles are attached: a disc in the middle."""
    return np.linalg.norm(sheet().rest, axis=1) < 11e-3


def corners() -> list[np.ndarray]:
    """Return where the jaws close [m]."""
    flat = sheet().rest[:, :2]
    return [sheet().rest[np.argmax(flat @ np.array(outward))] + 1e-3 for outward in OUTWARD]


@cache
def lifts(stiffness: float = STIFFNESS) -> tuple[Lift, ...]:
    """Return a closing and three lifted frames at each of four corners, with attachments of the given stiffness [N/m].

    Infinity is a weld: a spring so stiff that nothing moves by a micrometre.
    """
    energy, b = sheet_energy(), jnp.asarray(min(stiffness, WELD) * attached())
    frames = []
    for grasp, corner in enumerate(corners(), start=1):
        x = sheet().rest
        held = np.linalg.norm(x - corner, axis=1) <= GRIP_RADIUS
        for height in (0.0, 6e-3, 12e-3, 18e-3):
            tip = corner + np.array([0.0, 0.0, height]) - 0.3 * height * corner / np.linalg.norm(corner)
            found = search(gripped(energy, sheet().rest, corner, tip), b, jnp.asarray(x))
            assert found.converged, (grasp, height, found.force)
            x = np.asarray(found.x)
            frames.append(Lift(x=x, tip=tip, held=held, grasp=grasp))
    return tuple(frames)


def sheet_filter(force_sd: float, *, learns_noise: bool = True) -> ImplicitFilter:
    """Return the implicit filter for this sheet; the force error holds everywhere [N]."""
    return ImplicitFilter(declared_balance=sheet_balance(force_sd), prior=sheet_prior(), learns_noise=learns_noise)


def follow(
    filter: ImplicitFilter, frames: tuple[Lift, ...], seen: list[Evidence]
) -> tuple[ImplicitState, Update, PosteriorSummary]:
    """Take all frames, with the jaws opening after each lift; return state, last update and posterior."""
    state, grasp, update = filter.init(jax.random.key(0)), 1, None
    for frame, evidence in zip(frames, seen, strict=True):
        if frame.grasp != grasp:
            state, summary = filter.release(state)
            assert summary is not None
            grasp = frame.grasp
        state, update = filter.update(state, evidence, evidence.y)
    state, summary = filter.release(state)
    assert update is not None and summary is not None
    return state, update, summary


def nees(belief: AttachmentBelief) -> float:
    """Return the NEES per degree of freedom of the attached particles' s, where the truth is `STIFFNESS`.

    Free particles are left out: their truth lies exactly at the peak of the prior.
    """
    mean, covariance = (np.asarray(part) for part in belief.moments())
    summary = Belief(mean=mean, covariance=covariance, reference=float(belief.reference))
    found = nees_per_dof(summary, STIFFNESS * attached(), among=attached())
    assert found is not None
    return found


def cloud(x: np.ndarray, seed: int, sd: float) -> np.ndarray:
    """Return 1500 points anywhere on the sheet at x [m], with noise of standard deviation `sd` [m], in no order."""
    rng = np.random.default_rng(seed)
    corner = sheet().faces[rng.integers(len(sheet().faces), size=1500)]
    weights = rng.dirichlet(np.ones(3), len(corner))
    return np.einsum("pk,pki->pi", weights, x[corner]) + sd * rng.normal(size=(len(corner), 3))


def fields() -> np.ndarray:
    """Return six smooth fields over the sheet, some of them alike, as noise that neighbours share [m]."""
    along = (sheet().rest[:, :2] - sheet().rest[:, :2].min(axis=0)) / np.ptp(sheet().rest[:, :2], axis=0)
    waves = np.cos(np.pi * along[:, :1] * np.arange(3)), np.cos(np.pi * along[:, 1:] * np.arange(2))
    return NOISE * np.einsum("na,nb->nab", *waves).reshape(len(along), 6) @ np.triu(np.ones((6, 6)))


def sharing(evidence: Evidence) -> Evidence:
    """Return the evidence with more noise, which neighbours share."""
    shown = np.where(np.asarray(evidence.seen & ~evidence.held)[:, None], fields(), 0.0)
    covariance = np.linalg.inv(evidence.precision) + np.sum(shown**2, axis=1)[:, None, None] * np.eye(3)
    return replace(evidence, precision=jnp.asarray(np.linalg.inv(covariance)), fields=jnp.asarray(fields()))


def observed(frame: Lift, seed: int, unseen: np.ndarray | None = None) -> Evidence:
    """Return the evidence of noisy positions; held particles have the grip's precision."""
    noisy = frame.x + NOISE * np.random.default_rng(seed).normal(size=frame.x.shape)
    sd = np.where(frame.held, GRIP_SD, NOISE)
    precision = np.eye(3) / sd[:, None, None] ** 2
    if unseen is not None:
        precision = np.where(unseen[:, None, None], 0.0, precision)
    held = jnp.asarray(frame.held)
    return Evidence(y=jnp.asarray(noisy), precision=jnp.asarray(precision), held=held, force_unknown=held)
