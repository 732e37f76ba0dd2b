"""Lifts by our own engine as recordings, for tests of closing the loop over them."""

import dataclasses
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jiggle_mj.estimator.attribution.close_loop import Closed, close_the_loop
from jiggle_mj.estimator.attribution.dataset import Dataset, collect_dataset
from jiggle_mj.estimator.attribution.discrepancy import discrepancy
from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.estimator.effects import LIBRARY, Effect
from jiggle_mj.estimator.filters.evidence import Evidence
from jiggle_mj.estimator.physics.energy import SheetEnergy
from jiggle_mj.estimator.physics.environment import Tether, Weight
from jiggle_mj.observation import MeasuredForce, MeasuredPoints, Observation, ToolState
from tests.support.small_sheet import (
    DECLARATION,
    GRIP_RADIUS,
    STIFFNESS,
    attached,
    balance_of,
    lifts,
    sheet,
    sheet_energy,
)

NOISE = 1e-4
"""Standard deviation of each observed coordinate [m]."""
FORCE_NOISE = 5e-4
"""Standard deviation of each component of a measured force [N]; the lifts pull with up to 0.03 N."""
OFFSET = np.array([0.02, -0.01, 0.05])
"""What the sensor of the force shows while nothing pulls [N]."""
N_STILL = 10
"""Still frames before the first grasp."""
PERIOD_NS = 250_000_000
"""Time between frames [ns]."""
GRIP_PRECISION = 1e6
"""Precision of the held particles' positions [1/m^2]."""
SMALL_LIBRARY = tuple(
    effect for effect in LIBRARY if effect.name in ("gravity", "stretch", "bending", "friction", "tool_scale", "bed")
)
"""Effects that the tests search for; fewer than the library, to save time."""


def lifted_energy(gravity: float) -> SheetEnergy:
    """Return the energy of the sheet under a share of the declared gravity."""
    kinds = [type(term) for term in sheet_energy().terms]
    return eqx.tree_at(lambda e: e.terms[kinds.index(Weight)].gravity, sheet_energy(), replace_fn=lambda g: gravity * g)


@cache
def lifted(gravity: float, tethering: float = 0.0) -> tuple[np.ndarray, ...]:
    """Return the states of the shared lifts; what is held follows the tip.

    Args:
        gravity: share of the declared gravity.
        tethering: stiffness per area of springs that tie all of the sheet to its rest shape [N/m^3].
    """
    energy = lifted_energy(gravity)
    if tethering:
        springs = tethering * jnp.asarray(sheet().particle_area)[:, None, None] * jnp.eye(3)[None]
        tether = eqx.tree_at(lambda t: t.stiffness, Tether.build(sheet().rest), springs)
        energy = SheetEnergy.build(np.asarray(energy.rest), (*energy.terms, tether), energy.layout)
    balance, k = balance_of(energy, 1e-4), DECLARATION.membrane_stiffness
    s, states = jnp.asarray(attached() * STIFFNESS / (STIFFNESS + k)), []
    first = {lift.grasp: lift.tip for lift in lifts()[::-1]}
    predict = eqx.filter_jit(balance.predict)
    for lift, before in zip(lifts(), (None, *lifts()), strict=False):
        start = sheet().rest if before is None or before.grasp != lift.grasp else states[-1]
        held, to = jnp.asarray(lift.held), sheet().rest + lift.tip - first[lift.grasp]
        precision = jnp.broadcast_to(GRIP_PRECISION * jnp.eye(3)[None], (len(s), 3, 3))
        evidence = Evidence(y=jnp.asarray(to), precision=precision, held=held, force_unknown=held)
        states.append(np.asarray(predict(jnp.asarray(np.where(lift.held[:, None], to, start)), s, evidence)))
    return tuple(states)


def observed(gravity: float, *, tool_scale: float = 1.0, tethering: float = 0.0, repeats: int = 1) -> list[Observation]:
    """Return still frames, then the lifts, each seen `repeats` times: noisy tracked points, and the tool's reports."""
    frames = [(sheet().rest, np.array([0.0, 0.0, 0.05]), 0)] * N_STILL
    states = zip(lifted(gravity, tethering), lifts(), strict=True)
    frames += [(x, lift.tip, lift.grasp) for x, lift in states for _ in range(repeats)]
    first = {grasp: tip for _, tip, grasp in frames[::-1]}
    return [
        Observation(
            index=k,
            time=k * PERIOD_NS,
            tool=ToolState(
                position=first[grasp] + (tip - first[grasp]) / tool_scale,
                quat_wxyz=np.array([1.0, 0, 0, 0]),
                closed=grasp > 0,
                grasp=grasp,
                radius=GRIP_RADIUS,
            ),
            points=MeasuredPoints(
                positions=x + NOISE * np.random.default_rng(k).normal(size=x.shape),
                track_id=np.arange(len(x)),
                sd=NOISE,
            ),
        )
        for k, (x, tip, grasp) in enumerate(frames)
    ]


def with_forces(observations: list[Observation], factor: float) -> list[Observation]:
    """Return lifts with the force on the tool of a sheet that is a factor as stiff and as heavy in everything.

    What the balance of the held particles lacks, with the offset and the noise of a sensor.
    """
    balance, b, draw = balance_of(sheet_energy(), 1e-4), STIFFNESS * attached(), np.random.default_rng(9)
    s = jnp.asarray(b / (b + DECLARATION.membrane_stiffness))
    lacks = eqx.filter_jit(lambda x: balance.unbalanced(x, s) / (1 - s)[:, None])
    lifted_pulls = [np.asarray(lacks(x))[lift.held].sum(axis=0) for x, lift in zip(lifted(1.0), lifts(), strict=True)]
    repeats = (len(observations) - N_STILL) // len(lifted_pulls)
    pulls = np.concatenate([np.zeros((N_STILL, 3)), np.repeat(lifted_pulls, repeats, axis=0)])
    return [
        dataclasses.replace(one, force=MeasuredForce(on_tool=OFFSET - factor * pull + noise, sd=FORCE_NOISE))
        for one, pull, noise in zip(observations, pulls, FORCE_NOISE * draw.normal(size=pulls.shape), strict=True)
    ]


def closed_over(
    observations: list[Observation], library: tuple[Effect, ...] = SMALL_LIBRARY
) -> tuple[Closed, dict, Dataset]:
    """Close the loop over a recording, and return the result, the content of discrepancy.json and the dataset."""
    dataset = collect_dataset(DECLARATION, None, observations)
    with jax.enable_x64(True), one_thread():
        closed = close_the_loop(dataset, library=library)
        return closed, discrepancy(closed, dataset), dataset


def report_further(observation: Observation, distance: float) -> Observation:
    """Return an observation whose tool reports a position that is higher by a distance [m]."""
    tool = observation.tool
    moved = dataclasses.replace(tool, position=tool.position + np.array([0.0, 0.0, distance]))
    return dataclasses.replace(observation, tool=moved)
