"""How long the estimator's parts take, and what one of them finds: the same sheet lifted at a corner, at several sizes.

Each time is a median over repeats of a call that was compiled before; compile time stands apart. The sheet is the
estimator's own engine's, so that nothing but the estimator is needed (no MuJoCo), on whatever device JAX has.
"""

import json
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.resources import files

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jiggle_mj.estimator import EstimatorConfig
from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.estimator.filters.build import build_filter
from jiggle_mj.estimator.filters.evidence import Evidence, Pull
from jiggle_mj.estimator.filters.filter import Filter
from jiggle_mj.estimator.physics.energy import SheetEnergy
from jiggle_mj.estimator.physics.environment import Grip
from jiggle_mj.estimator.physics.equilibrium import equilibrium
from jiggle_mj.estimator.physics.mesh import SheetMesh
from jiggle_mj.estimator.physics.simulator import simulator
from jiggle_mj.estimator.physics.surrogate import surrogate
from jiggle_mj.estimator.planning.controllers import Scales, Situation, displacement_loss, large_step
from jiggle_mj.observation import Declaration

NOISE = 2e-4
"""Standard deviation of each observed coordinate [m]."""
STIFFNESS, RADIUS = 1.0, 0.015
"""Of each attached particle [N/m], and of the attached disc [m]."""
LIFT, STEP = 0.03, 0.005
"""Height of the lifted corner, and by how much it rose since the frame before [m]."""
GRIP = 6e-3
"""Radius of the jaws [m]."""
SIZES = (600, 1200)
REPEATS = 7
LARGEST = 10_000
"""Particles up to which the update is timed; beyond, the belief's dense n x n matrices would fill a GPU's memory."""
SLOWER, WORSE = 3.0, 0.02
"""What the gate lets pass: a time this many times the baseline's, a ratio of times this many times less, and a share
found that is lower by this much."""
Metrics = dict[str, dict[str, float | str]]


@dataclass(frozen=True, kw_only=True)
class Case:
    """One sheet of about n particles, and the frames of a lift."""

    mesh: SheetMesh
    declaration: Declaration
    gripped: SheetEnergy
    """With the jaws where they are in the last frame."""
    frames: tuple[Evidence, ...]
    attached: Bool[np.ndarray, " n"]
    b: Float[Array, " n"]

    @property
    def before(self) -> Float[Array, "n 3"]:
        """Equilibrium one step before the last frame [m]."""
        pull = self.frames[-1].pull
        assert pull is not None
        return pull.before


def equilateral(columns: int, rows: int, spacing: float) -> SheetMesh:
    """Equilateral triangles only: offset rows with a zigzag outline; spacing [m]."""
    place = [(i + 0.5 * (j % 2), j * np.sqrt(0.75), 0.0) for j in range(rows) for i in range(columns)]
    faces = []
    for j in range(rows - 1):
        for i in range(columns - 1):
            a, b, c, d = j * columns + i, j * columns + i + 1, (j + 1) * columns + i, (j + 1) * columns + i + 1
            faces += [(a, b, d), (a, d, c)] if j % 2 else [(a, b, c), (b, d, c)]
    rest = spacing * np.array(place)
    return SheetMesh(rest - rest.mean(axis=0), np.array(faces))


def square(n: int) -> SheetMesh:
    """About n particles at the default spacing."""
    columns = round(np.sqrt(n * np.sqrt(0.75)))
    return equilateral(columns, round(n / columns), EstimatorConfig().spacing)


def case(n: int) -> Case:
    """Lift a corner of a sheet with an attached disc in the middle of the lifted part."""
    mesh, declaration = square(n), Declaration()
    corner = mesh.rest[np.argmin(mesh.rest @ np.array([1.0, 1.0, 0.0]))]
    attached = np.linalg.norm(mesh.rest - corner - np.array([0.03, 0.03, 0.0]), axis=1) < RADIUS
    energy, b = surrogate(mesh, declaration), jnp.asarray(STIFFNESS * attached)
    stiff = EstimatorConfig().grip_stiffness * declaration.membrane_stiffness
    grip = Grip.build(jnp.asarray(mesh.rest), jnp.asarray(corner), radius=GRIP, stiffness=stiff)
    gripped = SheetEnergy.build(mesh.rest, (*energy.terms, grip), energy.layout)
    held, search, x, frames = grip.stiffness > 0, eqx.filter_jit(equilibrium), jnp.asarray(mesh.rest), []
    precision = jnp.broadcast_to(jnp.eye(3) / NOISE**2, (mesh.n, 3, 3))
    draw = np.random.default_rng(0)
    for height in np.arange(STEP, LIFT + STEP / 2, STEP):
        before, tip = x, jnp.asarray(corner + np.array([0.3 * height, 0.3 * height, height]))
        grip = eqx.tree_at(lambda one: one.tip, grip, tip)
        gripped = eqx.tree_at(lambda one: one.terms[-1], gripped, grip)
        x = search(gripped, b, x, force_tolerance=1e-6).x
        noisy = x + NOISE * jnp.asarray(draw.normal(size=x.shape))
        pull = Pull(before=before, tip=tip, length=grip.length)
        frames.append(Evidence(y=noisy, precision=precision, held=held, force_unknown=held, pull=pull))
    return Case(
        mesh=mesh,
        declaration=declaration,
        gripped=gripped,
        frames=tuple(frames),
        attached=attached,
        b=b,
    )


def benchmark(sizes: tuple[int, ...], *, paper: bool, log: Callable[[str], None]) -> Metrics:
    """Times of the update, the equilibrium and an action of SL-D at each size, and of the paper's filter at the first.

    Args:
        sizes: particles, about; beyond `LARGEST` of the equilibrium alone.
        paper: measure the paper's filter and controller too, which takes minutes on a CPU.
        log: told what comes next.
    """
    metrics: Metrics = {"device": {"value": jax.devices()[0].device_kind, "unit": "name"}}
    with jax.enable_x64(True), one_thread():
        cases = {}
        for n in sizes:
            log(f"n = {n}")
            cases[n] = one = case(n)
            compiled, seconds = timed(_equilibrium(one))
            metrics[f"equilibrium_n{n}_s"] = {"value": seconds, "unit": "s"}
            if n > LARGEST:
                continue
            filter = build_filter(one.mesh, one.declaration, EstimatorConfig())
            compiled, seconds = timed(partial(_last_frame, filter, one))
            metrics[f"update_n{n}_s"] = {"value": seconds, "unit": "s"}
            metrics[f"update_n{n}_compile_s"] = {"value": compiled, "unit": "s"}
            if n == sizes[0]:
                metrics["found_share"] = {"value": _found_share(one), "unit": "share"}
            if paper and n == sizes[0]:
                log(f"n = {n}, the paper's filter")
                explicit = build_filter(one.mesh, one.declaration, EstimatorConfig(filter="explicit"))
                _, slow = timed(partial(_last_frame, explicit, one), repeats=3)
                metrics[f"update_explicit_n{n}_s"] = {"value": slow, "unit": "s"}
                metrics["update_explicit_over_implicit"] = {"value": slow / seconds, "unit": "ratio"}
        metrics["peak_memory"] = {"value": peak_memory(), "unit": "GiB"}
        for n in [n for n in sizes if n <= LARGEST] if paper else []:
            log(f"n = {n}, the paper's controller")
            _, seconds = timed(sl_d(cases[n]), repeats=3)
            metrics[f"plan_sl_d_n{n}_s"] = {"value": seconds, "unit": "s"}
    for part in ("equilibrium", "update", "plan_sl_d"):
        times = {n: float(metrics[f"{part}_n{n}_s"]["value"]) for n in sizes if f"{part}_n{n}_s" in metrics}
        metrics |= growth(part, times)
    return metrics


def growth(part: str, times: dict[int, float]) -> Metrics:
    """The exponent with which seconds grow with n, by least squares; nothing of a single size."""
    if len(times) < 2:
        return {}
    slope = np.polyfit(np.log(list(times)), np.log(list(times.values())), 1)[0]
    return {f"{part}_exponent": {"value": float(slope), "unit": "exponent of n"}}


def peak_memory() -> float:
    """Most that was taken so far of a GPU's memory, or by this process where there is none [GiB]."""
    of_device = jax.devices()[0].memory_stats()
    if of_device is None:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return of_device["peak_bytes_in_use"] / 2**30


def timed(call: Callable[[], object], *, repeats: int = REPEATS) -> tuple[float, float]:
    """Seconds that the first call takes longer than the median of the others, and that median."""
    seconds = []
    for _ in range(repeats + 1):
        began = time.perf_counter()
        jax.block_until_ready(call())
        seconds.append(time.perf_counter() - began)
    median = float(np.median(seconds[1:]))
    return max(seconds[0] - median, 0.0), median


def regressions(metrics: Metrics, baseline: Metrics) -> list[str]:
    """What became worse than the baseline allows, in words."""
    worse = []
    for name, entry in baseline.items():
        if name not in metrics or entry["unit"] not in ("s", "share", "ratio") or "compile" in name:
            continue
        now, then = float(metrics[name]["value"]), float(entry["value"])
        if entry["unit"] == "s" and now > SLOWER * then:
            worse.append(f"{name} is {now:.3g} s; the baseline is {then:.3g} s, and {SLOWER:g} times that is allowed.")
        if entry["unit"] == "ratio" and now < then / SLOWER:
            worse.append(f"{name} is {now:.3g}; the baseline is {then:.3g}, and one {SLOWER:g}th of that is allowed.")
        if entry["unit"] == "share" and now < then - WORSE:
            worse.append(f"{name} is {now:.3f}; the baseline is {then:.3f}, and {WORSE:g} less is allowed.")
    return worse


def baseline() -> Metrics:
    """The committed one, of two CPU cores."""
    return json.loads((files(__package__) / "baseline.json").read_text("utf-8"))


def _equilibrium(one: Case) -> Callable[[], object]:
    tolerance = EstimatorConfig().force_sd * one.declaration.membrane_stiffness * one.mesh.spacing / 4
    search = eqx.filter_jit(equilibrium)
    return lambda: search(one.gripped, one.b, one.before, force_tolerance=tolerance).x


def sl_d(one: Case) -> Callable[[], object]:
    """The search for one action, before the last frame, with a belief that is still the prior."""
    pull, held = one.frames[-1].pull, one.frames[-1].held
    assert pull is not None
    f, covariance = simulator(one.mesh, one.declaration), 0.1 * STIFFNESS**2 * jnp.eye(one.mesh.n)
    scales = Scales.at_prior(f.rest, covariance, energy=1e-6, noise=NOISE)
    situation = Situation(
        x=pull.before,
        tip=pull.tip,
        length=pull.length,
        stiffness=jnp.where(held, EstimatorConfig().grip_stiffness * one.declaration.membrane_stiffness, 0.0),
        b=one.b,
        covariance=covariance,
    )
    low, high = jnp.min(f.rest, axis=0), jnp.max(f.rest, axis=0) + jnp.array([0.0, 0.0, LIFT])

    @eqx.filter_jit
    def search(f, situation, scales, key):
        return large_step(displacement_loss(f, situation, scales), low, high, key)

    return lambda: search(f, situation, scales, jax.random.key(0))


def _last_frame(filter: Filter, one: Case) -> object:
    return filter.update(filter.init(jax.random.key(0)), one.frames[-1], one.before)[1]


def _found_share(one: Case) -> float:
    """Share of particles rightly called attached or free after all frames."""
    filter = build_filter(one.mesh, one.declaration, EstimatorConfig())
    state, x = filter.init(jax.random.key(0)), jnp.asarray(one.mesh.rest)
    for frame in one.frames:
        state, update = filter.update(state, frame, x)
        x = update.x
    _, summary = filter.release(state)
    assert summary is not None
    return float(np.mean((np.asarray(summary.probability) > 0.5) == one.attached))
