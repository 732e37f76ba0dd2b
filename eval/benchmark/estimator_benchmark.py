"""Time of the estimator's parts, and what one of them finds: the same sheet lifted at a corner, at several sizes.

Each time is a median over repeats of a call that was compiled before; compile time is reported apart. The sheet is
simulated by the estimator's own engine. So nothing but the estimator is needed (no MuJoCo), on whatever device JAX has.
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
from jiggle_mj.estimator.filter_builder import build_filter
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

POINT_SD = 2e-4
"""Standard deviation of each observed coordinate [m]."""
DISC_STIFFNESS = 1.0
"""Stiffness of each attached particle [N/m], that of the shipped scenes."""
DISC_RADIUS = 0.015
"""Radius of the attached disc [m]."""
LIFT_HEIGHT = 0.03
"""Height of the lifted corner in the last frame [m]."""
LIFT_STEP = 0.005
"""Rise of the corner from one frame to the next [m], the longest step of a policy."""
JAW_RADIUS = 6e-3
"""Radius of the jaws [m]."""
SIZES = (600, 1200)
"""About how many particles are timed: the two sizes that the paper reports."""
REPEATS = 7
"""Calls of which the median is reported."""
SLOW_REPEATS = 3
"""Calls of which the median is reported, for calls that take seconds to minutes."""
MAX_BELIEF_PARTICLES = 10_000
"""Particles up to which the update is timed; beyond, the belief's dense n x n matrices would fill a GPU's memory."""
MAX_SAMPLED_PARTICLES = 2500
"""Particles up to which the second look is timed; beyond, samples of six frames take minutes."""
MAX_SLOWDOWN = 3.0
"""Factor that the gate allows on a time, and on the inverse of a ratio of times; machines differ."""
MAX_SHARE_LOSS = 0.02
"""Loss that the gate allows on the share of particles that is classified correctly."""
PRIOR_VARIANCE = 0.1 * DISC_STIFFNESS**2
"""Variance of each particle's stiffness in the belief that SL-D plans with [N^2/m^2]."""
ENERGY_SCALE = 1e-6
"""Energy scale of SL-D's loss [J]."""
Metrics = dict[str, dict[str, float | str]]
"""Value and unit of each figure, by name."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """One sheet of about n particles, and the frames of a lift."""

    mesh: SheetMesh
    declaration: Declaration
    gripped: SheetEnergy
    """Energy with the jaws where they are in the last frame."""
    frames: tuple[Evidence, ...]
    attached: Bool[np.ndarray, " n"]
    b: Float[Array, " n"]
    """True attachment stiffness [N/m]."""

    @property
    def before(self) -> Float[Array, "n 3"]:
        """Equilibrium one step before the last frame [m]."""
        pull = self.frames[-1].pull
        assert pull is not None
        return pull.before


def equilateral(columns: int, rows: int, spacing: float) -> SheetMesh:
    """Return a sheet of equilateral triangles: offset rows with a zigzag outline; spacing [m]."""
    place = [(i + 0.5 * (j % 2), j * np.sqrt(0.75), 0.0) for j in range(rows) for i in range(columns)]
    faces = []
    for j in range(rows - 1):
        for i in range(columns - 1):
            a, b, c, d = j * columns + i, j * columns + i + 1, (j + 1) * columns + i, (j + 1) * columns + i + 1
            faces += [(a, b, d), (a, d, c)] if j % 2 else [(a, b, c), (b, d, c)]
    rest = spacing * np.array(place)
    return SheetMesh(rest - rest.mean(axis=0), np.array(faces))


def square(n: int) -> SheetMesh:
    """Return a sheet of about n particles at the default spacing."""
    columns = round(np.sqrt(n * np.sqrt(0.75)))
    return equilateral(columns, round(n / columns), EstimatorConfig().spacing)


def case(n: int) -> Case:
    """Return the lift of a corner of a sheet with an attached disc in the middle of the lifted part."""
    mesh, declaration = square(n), Declaration()
    corner = mesh.rest[np.argmin(mesh.rest @ np.array([1.0, 1.0, 0.0]))]
    attached = np.linalg.norm(mesh.rest - corner - np.array([0.03, 0.03, 0.0]), axis=1) < DISC_RADIUS
    energy, b = surrogate(mesh, declaration), jnp.asarray(DISC_STIFFNESS * attached)
    stiff = EstimatorConfig().grip_stiffness * declaration.membrane_stiffness
    grip = Grip.build(jnp.asarray(mesh.rest), jnp.asarray(corner), radius=JAW_RADIUS, stiffness=stiff)
    gripped = SheetEnergy.build(mesh.rest, (*energy.terms, grip), energy.layout)
    held, search, x, frames = grip.stiffness > 0, eqx.filter_jit(equilibrium), jnp.asarray(mesh.rest), []
    precision = jnp.broadcast_to(jnp.eye(3) / POINT_SD**2, (mesh.n, 3, 3))
    draw = np.random.default_rng(0)
    for height in np.arange(LIFT_STEP, LIFT_HEIGHT + LIFT_STEP / 2, LIFT_STEP):
        before, tip = x, jnp.asarray(corner + np.array([0.3 * height, 0.3 * height, height]))
        grip = eqx.tree_at(lambda jaws: jaws.tip, grip, tip)
        gripped = eqx.tree_at(lambda energy: energy.terms[-1], gripped, grip)
        x = search(gripped, b, x, force_tolerance=1e-6).x
        noisy = x + POINT_SD * jnp.asarray(draw.normal(size=x.shape))
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


def benchmark(
    sizes: tuple[int, ...],
    *,
    paper: bool,
    log: Callable[[str], None],
    max_belief_particles: int = MAX_BELIEF_PARTICLES,
) -> Metrics:
    """Time update, second look, equilibrium and an action of SL-D at each size, and the paper's filter at the first.

    Args:
        sizes: particles, about.
        paper: measure the paper's filter and controller too, which takes minutes on a CPU.
        log: gets a line before each part.
        max_belief_particles: of more particles the equilibrium alone is timed.
    """
    metrics: Metrics = {"device": {"value": jax.devices()[0].device_kind, "unit": "name"}}
    with jax.enable_x64(True), one_thread():
        cases = {}
        for n in sizes:
            log(f"n = {n}")
            cases[n] = lift = case(n)
            compiled, seconds = timed(_equilibrium(lift))
            metrics[f"equilibrium_n{n}_s"] = {"value": seconds, "unit": "s"}
            if n > max_belief_particles:
                continue
            filter = build_filter(lift.mesh, lift.declaration, EstimatorConfig())
            compiled, seconds = timed(partial(_last_frame, filter, lift))
            metrics[f"update_n{n}_s"] = {"value": seconds, "unit": "s"}
            metrics[f"update_n{n}_compile_s"] = {"value": compiled, "unit": "s"}
            if n <= MAX_SAMPLED_PARTICLES:
                _, again = timed(_second_look(filter, lift))
                metrics[f"second_look_n{n}_s"] = {"value": again, "unit": "s"}
            if n == sizes[0]:
                metrics["found_share"] = {"value": _found_share(lift), "unit": "share"}
            if paper and n == sizes[0]:
                log(f"n = {n}, the paper's filter")
                explicit = build_filter(lift.mesh, lift.declaration, EstimatorConfig(filter="explicit"))
                _, slow = timed(partial(_last_frame, explicit, lift), repeats=SLOW_REPEATS)
                metrics[f"update_explicit_n{n}_s"] = {"value": slow, "unit": "s"}
                metrics["update_explicit_over_implicit"] = {"value": slow / seconds, "unit": "ratio"}
        metrics["peak_memory"] = {"value": peak_memory(), "unit": "GiB"}
        for n in [n for n in sizes if n <= max_belief_particles] if paper else []:
            log(f"n = {n}, the paper's controller")
            _, seconds = timed(sl_d(cases[n]), repeats=SLOW_REPEATS)
            metrics[f"plan_sl_d_n{n}_s"] = {"value": seconds, "unit": "s"}
    for part in ("equilibrium", "update", "second_look", "plan_sl_d"):
        times = {n: float(metrics[f"{part}_n{n}_s"]["value"]) for n in sizes if f"{part}_n{n}_s" in metrics}
        metrics |= growth(part, times)
    return metrics


def growth(part: str, times: dict[int, float]) -> Metrics:
    """Return the exponent with which seconds grow with n, by least squares; nothing for a single size."""
    if len(times) < 2:
        return {}
    exponent = np.polyfit(np.log(list(times)), np.log(list(times.values())), 1)[0]
    return {f"{part}_exponent": {"value": float(exponent), "unit": "exponent of n"}}


def peak_memory() -> float:
    """Return the most memory taken so far on the GPU, or by this process where there is none [GiB]."""
    of_device = jax.devices()[0].memory_stats()
    if of_device is None:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return of_device["peak_bytes_in_use"] / 2**30


def timed(call: Callable[[], object], *, repeats: int = REPEATS) -> tuple[float, float]:
    """Return the seconds that the first call takes longer than the median of the others, and that median."""
    seconds = []
    for _ in range(repeats + 1):
        began = time.perf_counter()
        jax.block_until_ready(call())
        seconds.append(time.perf_counter() - began)
    median = float(np.median(seconds[1:]))
    return max(seconds[0] - median, 0.0), median


def regressions(metrics: Metrics, baseline: Metrics) -> list[str]:
    """Return a sentence for each figure that is worse than the baseline allows."""
    worse = []
    for name, entry in baseline.items():
        if name not in metrics or entry["unit"] not in ("s", "share", "ratio") or "compile" in name:
            continue
        now, then = float(metrics[name]["value"]), float(entry["value"])
        if entry["unit"] == "s" and now > MAX_SLOWDOWN * then:
            worse.append(
                f"{name} is {now:.3g} s; the baseline is {then:.3g} s, and {MAX_SLOWDOWN:g} times it is allowed."
            )
        if entry["unit"] == "ratio" and now < then / MAX_SLOWDOWN:
            worse.append(f"{name} is {now:.3g}; the baseline is {then:.3g}, and one {MAX_SLOWDOWN:g}th is allowed.")
        if entry["unit"] == "share" and now < then - MAX_SHARE_LOSS:
            worse.append(f"{name} is {now:.3f}; the baseline is {then:.3f}, and {MAX_SHARE_LOSS:g} less is allowed.")
    return worse


def baseline() -> Metrics:
    """Return the committed baseline, measured on two CPU cores."""
    return json.loads((files("jiggle_mj.eval.benchmark") / "baseline.json").read_text("utf-8"))


def _equilibrium(lift: Case) -> Callable[[], object]:
    tolerance = EstimatorConfig().force_sd * lift.declaration.membrane_stiffness * lift.mesh.spacing / 4
    search = eqx.filter_jit(equilibrium)
    return lambda: search(lift.gripped, lift.b, lift.before, force_tolerance=tolerance).x


def sl_d(lift: Case) -> Callable[[], object]:
    """Return a call that searches one action of SL-D, before the last frame, with the prior as belief."""
    pull, held = lift.frames[-1].pull, lift.frames[-1].held
    assert pull is not None
    f, covariance = simulator(lift.mesh, lift.declaration), PRIOR_VARIANCE * jnp.eye(lift.mesh.n)
    scales = Scales.at_prior(f.rest, covariance, energy=ENERGY_SCALE, noise=POINT_SD)
    situation = Situation(
        x=pull.before,
        tip=pull.tip,
        length=pull.length,
        stiffness=jnp.where(held, EstimatorConfig().grip_stiffness * lift.declaration.membrane_stiffness, 0.0),
        b=lift.b,
        covariance=covariance,
    )
    low, high = jnp.min(f.rest, axis=0), jnp.max(f.rest, axis=0) + jnp.array([0.0, 0.0, LIFT_HEIGHT])

    @eqx.filter_jit
    def search(f, situation, scales, key):
        return large_step(displacement_loss(f, situation, scales), low, high, key)

    return lambda: search(f, situation, scales, jax.random.key(0))


def _last_frame(filter: Filter, lift: Case) -> object:
    return filter.update(filter.init(jax.random.key(0)), lift.frames[-1], lift.before)[1]


def _second_look(filter: Filter, lift: Case) -> Callable[[], object]:
    """Return a call that samples after the last frame, as a policy needs it, with samples after those before."""
    state, x = filter.init(jax.random.key(0)), jnp.asarray(lift.mesh.rest)
    for frame in lift.frames:
        state, update = filter.update(state, frame, x)
        state, x = filter.resample(state), update.x
    return lambda: filter.resample(state).summary


def _found_share(lift: Case) -> float:
    """Return the share of particles that is classified correctly, attached or free, after all frames."""
    filter = build_filter(lift.mesh, lift.declaration, EstimatorConfig())
    state, x = filter.init(jax.random.key(0)), jnp.asarray(lift.mesh.rest)
    for frame in lift.frames:
        state, update = filter.update(state, frame, x)
        x = update.x
    _, summary = filter.release(state)
    assert summary is not None
    return float(np.mean((np.asarray(summary.probability) > 0.5) == lift.attached))
