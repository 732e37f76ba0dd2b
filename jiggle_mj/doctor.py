"""Whether this machine can run jiggle-mj: versions, JAX devices, offscreen OpenGL, cores and memory, with remedies.

What may crash or hang (JAX on a broken driver, OpenGL) is tried in a process of its own under a time limit.
Does not measure speed, and prints nothing: the command line shows the checks.
"""

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from typing import Literal

OPENGL_PACKAGES = {"egl": ("libegl1", "libgl1", "libgl1-mesa-dri"), "osmesa": ("libosmesa6", "libgl1")}
"""Debian and Ubuntu packages that hold the software driver behind each value of MUJOCO_GL."""

MINIMUM_PYTHON = (3, 11)
PACKAGES = ("mujoco", "mujoco-mjx", "jax", "numpy", "opencv-python-headless", "mcap")
"""Those whose version decides whether anything works."""
MINIMUM_MEMORY = 4e9
"""What a full run needs with some room [B]."""
MINIMUM_CORES = 2

_RENDER = """
import mujoco
model = mujoco.MjModel.from_xml_string(
    '<mujoco><worldbody><light pos="0 0 3"/><geom type="sphere" size="1" rgba="1 0 0 1"/></worldbody></mujoco>')
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 48, 64) as renderer:
    renderer.update_scene(data)
    image = renderer.render()
    from OpenGL import GL
    driver = GL.glGetString(GL.GL_RENDERER).decode()
if not image[24, 32, 0] > image[24, 32, 2]:
    raise SystemExit(f"{driver} drew a red ball as {image[24, 32].tolist()}")
print(driver)
"""

_JAX = """
import jax, jax.numpy as jnp
kinds = [f"{device.platform} ({device.device_kind})" for device in jax.devices()]
single = jnp.ones(3).sum().dtype
with jax.enable_x64(True):
    double = jnp.ones(3).sum().dtype
if str(double) != "float64":
    raise SystemExit(f"float64 was asked for and {double} came back")
print(", ".join(kinds) + f"; {single} by default, {double} where asked for")
"""


@dataclass(frozen=True, kw_only=True)
class Check:
    """One thing looked at."""

    name: str
    ok: bool
    detail: str
    """What was found."""
    remedy: str = ""
    """What to do about it; empty where nothing needs doing."""


@dataclass(frozen=True, kw_only=True)
class _Probe:
    """How a trial in a process of its own ended."""

    ok: bool
    said: str
    """The last line it printed, or why it failed."""


def doctor() -> list[Check]:
    """Look at everything; takes a few seconds.

    Returns:
        One check per subject, in a fixed order. Offscreen OpenGL is fine when one of its two drivers is.
    """
    return [_python(), *_versions(), _jax(), *_offscreen_opengl(), _cores(), _memory()]


def render_failure(backend: Literal["egl", "osmesa"], *, time_limit: float = 10.0) -> str | None:
    """Render one frame offscreen in a process of its own.

    Args:
        backend: value of MUJOCO_GL to try.
        time_limit: when to give up [s].

    Returns:
        None where it works, else what went wrong.
    """
    probe = _render(backend, time_limit=time_limit)
    return None if probe.ok else probe.said


def _render(backend: str, *, time_limit: float) -> _Probe:
    return _try(_RENDER, time_limit=time_limit, MUJOCO_GL=backend, PYOPENGL_PLATFORM=backend)


def _try(code: str, *, time_limit: float, **environment: str) -> _Probe:
    """Run Python code in a process of its own."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, **environment},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=time_limit,
        )
    except subprocess.TimeoutExpired:
        return _Probe(ok=False, said=f"no answer within {time_limit:g} s")
    if done.returncode == 0:
        return _Probe(ok=True, said=_last_line(done.stdout))
    return _Probe(ok=False, said=_failure(done.stderr) or f"the process ended with code {done.returncode}")


def _last_line(text: str) -> str:
    lines = text.strip().splitlines()
    return lines[-1] if lines else ""


def _failure(stderr: str) -> str:
    """The exception's line of a traceback, which clean-up code may have followed with others of its own."""
    before_clean_up = stderr.split("Exception ignored in", maxsplit=1)[0]
    return _last_line(before_clean_up)


def _python() -> Check:
    found = sys.version_info[:3]
    ok = found[:2] >= MINIMUM_PYTHON
    wanted = ".".join(map(str, MINIMUM_PYTHON))
    return Check(
        name="python",
        ok=ok,
        detail=".".join(map(str, found)),
        remedy="" if ok else f"Install Python {wanted} or newer.",
    )


def _versions() -> list[Check]:
    """The packages against the lower bounds in this distribution's own metadata."""
    bounds = dict(re.findall(r"^([\w-]+)>=([\d.]+)$", "\n".join(requires("jiggle-mj") or []), flags=re.MULTILINE))
    return [_version(package, bounds[package]) for package in PACKAGES]


def _version(package: str, minimum: str) -> Check:
    wanted = f"{package}>={minimum}"
    try:
        found = version(package)
    except PackageNotFoundError:
        return Check(name=package, ok=False, detail="not installed", remedy=f"pip install '{wanted}'")
    ok = _release(found) >= _release(minimum)
    return Check(name=package, ok=ok, detail=found, remedy="" if ok else f"pip install --upgrade '{wanted}'")


def _release(text: str) -> tuple[int, ...]:
    """The leading numbers of a version: (3, 17, 0) of 3.17.0.dev0."""
    return tuple(int(part) for part in re.findall(r"\d+", re.split(r"[^\d.]", text)[0]))


def _jax() -> Check:
    probe = _try(_JAX, time_limit=60.0)
    return Check(
        name="jax devices",
        ok=probe.ok,
        detail=probe.said,
        remedy="" if probe.ok else "Set JAX_PLATFORMS=cpu, or reinstall jax and jaxlib in matching versions.",
    )


def _offscreen_opengl() -> list[Check]:
    """Both drivers; the second is a fall-back, so its absence beside a working first is no fault."""
    probes = {backend: _render(backend, time_limit=10.0) for backend in OPENGL_PACKAGES}
    some = any(probe.ok for probe in probes.values())
    return [
        Check(
            name=f"offscreen OpenGL, {backend}",
            ok=probe.ok or some,
            detail=probe.said if probe.ok or not some else f"not available ({probe.said}); not needed",
            remedy=""
            if some
            else f"apt-get install {' '.join(OPENGL_PACKAGES[backend])}, then set MUJOCO_GL={backend}.",
        )
        for backend, probe in probes.items()
    ]


def _cores() -> Check:
    found = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    ok = found >= MINIMUM_CORES
    return Check(
        name="cores",
        ok=ok,
        detail=str(found),
        remedy="" if ok else "Everything works, slower than the figures of docs/RESULTS.md.",
    )


def _memory() -> Check:
    found = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    ok = found >= MINIMUM_MEMORY
    return Check(
        name="memory",
        ok=ok,
        detail=f"{found / 1e9:.1f} GB",
        remedy="" if ok else f"A run may need {MINIMUM_MEMORY / 1e9:.0f} GB.",
    )
