"""Checks that this machine can run jiggle-mj: versions, JAX devices, offscreen OpenGL, cores and memory, with remedies.

Code that may crash or hang (JAX on a broken driver, OpenGL) runs in a separate process under a time limit. Does not
measure speed, and prints nothing: the command line shows the checks.
"""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from typing import Literal

from .worker_processes import usable_cores

Backend = Literal["egl", "osmesa"]
"""Value of MUJOCO_GL that renders offscreen."""

OPENGL_PACKAGES: dict[Backend, tuple[str, ...]] = {
    "egl": ("libegl1", "libgl1", "libgl1-mesa-dri"),
    "osmesa": ("libosmesa6", "libgl1"),
}
"""Debian and Ubuntu packages that hold the software driver behind each value of MUJOCO_GL."""

MINIMUM_PYTHON = (3, 11)
"""Oldest Python that the package supports."""
PACKAGES = ("mujoco", "mujoco-mjx", "jax", "numpy", "opencv-python-headless", "mcap")
"""Packages whose versions are checked, as nothing works with older ones."""
MINIMUM_MEMORY = 4e9
"""Memory that a full run needs, with a margin [byte]."""
MINIMUM_CORES = 2
"""Cores below which everything runs slower than docs/RESULTS.md says."""
RENDER_LIMIT_S = 10.0
"""Time for a process to render one frame [s]; a driver that hangs never does."""
JAX_LIMIT_S = 60.0
"""Time for a process to import JAX and list its devices [s]; only a driver that hangs takes longer."""

_RENDER_CODE = """
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

_JAX_CODE = """
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
    """Result of one check."""

    name: str
    """Name of what is checked."""
    ok: bool
    """Whether nothing needs to be done."""
    detail: str
    """What was found on this machine."""
    remedy: str = ""
    """What the user can do; empty where nothing needs to be done."""


@dataclass(frozen=True, kw_only=True)
class Probe:
    """Result of code that ran in a separate process."""

    ok: bool
    """Whether it ended without an error."""
    message: str
    """The last line that it printed, or the reason why it failed."""


def doctor() -> list[Check]:
    """Check this machine; takes a few seconds.

    Returns:
        One check per subject, in a fixed order.
    """
    return [_check_python(), *_check_packages(), check_jax(), *check_opengl(), _check_cores(), _check_memory()]


def render_failure(backend: Backend, *, time_limit: float = RENDER_LIMIT_S) -> str | None:
    """Render one frame offscreen in a separate process and return what went wrong; None where it works.

    Args:
        backend: value of MUJOCO_GL to try.
        time_limit: time after which the process is ended [s].
    """
    probe = render_probe(backend, time_limit=time_limit)
    return None if probe.ok else probe.message


def render_probe(backend: Backend, *, time_limit: float = RENDER_LIMIT_S) -> Probe:
    """Render one frame offscreen in a separate process; the message is the driver's name, or the reason it failed.

    Args:
        backend: value of MUJOCO_GL to try.
        time_limit: time after which the process is ended [s].
    """
    return _run(_RENDER_CODE, time_limit=time_limit, MUJOCO_GL=backend, PYOPENGL_PLATFORM=backend)


def _run(code: str, *, time_limit: float, **environment: str) -> Probe:
    """Run Python code in a separate process."""
    try:
        completed = subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, **environment},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=time_limit,
        )
    except subprocess.TimeoutExpired:
        return Probe(ok=False, message=f"no answer within {time_limit:g} s")
    if completed.returncode == 0:
        return Probe(ok=True, message=_last_line(completed.stdout))
    return Probe(ok=False, message=_failure(completed.stderr) or f"the process ended with code {completed.returncode}")


def _last_line(text: str) -> str:
    lines = text.strip().splitlines()
    return lines[-1] if lines else ""


def _failure(stderr: str) -> str:
    """Return the exception's line of a traceback; the lines of exceptions in clean-up code may follow it."""
    before_clean_up = stderr.split("Exception ignored in", maxsplit=1)[0]
    return _last_line(before_clean_up)


def _check_python() -> Check:
    installed = sys.version_info[:3]
    ok = installed[:2] >= MINIMUM_PYTHON
    required = ".".join(map(str, MINIMUM_PYTHON))
    return Check(
        name="python",
        ok=ok,
        detail=".".join(map(str, installed)),
        remedy="" if ok else f"Install Python {required} or newer.",
    )


def _check_packages() -> list[Check]:
    """Check the packages against the lower bounds in the metadata of this distribution."""
    bounds = dict(re.findall(r"^([\w-]+)>=([\d.]+)$", "\n".join(requires("jiggle-mj") or []), flags=re.MULTILINE))
    return [check_package(package, bounds[package]) for package in PACKAGES]


def check_package(package: str, minimum: str) -> Check:
    """Check that a package is installed in a minimum version."""
    requirement = f"{package}>={minimum}"
    try:
        installed = version(package)
    except PackageNotFoundError:
        return Check(name=package, ok=False, detail="not installed", remedy=f"pip install '{requirement}'")
    ok = release_numbers(installed) >= release_numbers(minimum)
    return Check(name=package, ok=ok, detail=installed, remedy="" if ok else f"pip install --upgrade '{requirement}'")


def release_numbers(text: str) -> tuple[int, ...]:
    """Return the leading numbers of a version: (3, 17, 0) of 3.17.0.dev0."""
    return tuple(int(part) for part in re.findall(r"\d+", re.split(r"[^\d.]", text)[0]))


def check_jax() -> Check:
    """Check that JAX finds a device and computes in float64 on request."""
    probe = _run(_JAX_CODE, time_limit=JAX_LIMIT_S)
    return Check(
        name="jax devices",
        ok=probe.ok,
        detail=probe.message,
        remedy="" if probe.ok else "Set JAX_PLATFORMS=cpu, or reinstall jax and jaxlib in matching versions.",
    )


def check_opengl(probe_backend: Callable[[Backend], Probe] = render_probe) -> list[Check]:
    """Check both offscreen OpenGL drivers; one that works is enough, so the other one is then fine as well.

    Args:
        probe_backend: renders a frame with a driver.
    """
    probes: dict[Backend, Probe] = {backend: probe_backend(backend) for backend in OPENGL_PACKAGES}
    one_works = any(probe.ok for probe in probes.values())
    return [
        Check(
            name=f"offscreen OpenGL, {backend}",
            ok=probe.ok or one_works,
            detail=probe.message if probe.ok or not one_works else f"not available ({probe.message}); not needed",
            remedy=""
            if one_works
            else f"apt-get install {' '.join(OPENGL_PACKAGES[backend])}, then set MUJOCO_GL={backend}.",
        )
        for backend, probe in probes.items()
    ]


def _check_cores() -> Check:
    cores = usable_cores()
    ok = cores >= MINIMUM_CORES
    return Check(
        name="cores",
        ok=ok,
        detail=str(cores),
        remedy="" if ok else "Everything works, but slower than docs/RESULTS.md says.",
    )


def _check_memory() -> Check:
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    ok = memory >= MINIMUM_MEMORY
    return Check(
        name="memory",
        ok=ok,
        detail=f"{memory / 1e9:.1f} GB",
        remedy="" if ok else f"A run may need {MINIMUM_MEMORY / 1e9:.0f} GB of memory.",
    )
