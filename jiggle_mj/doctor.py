"""Checks that this machine can run jiggle-mj: versions, processor, JAX, rendering, cores and memory, with remedies.

Everything is tried in the user's own environment. Code that may crash or hang (JAX on a broken driver, OpenGL) runs in
a separate process under a time limit. Does not measure speed, and prints nothing: the command line shows the checks.
"""

import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Literal

from .worker_processes import usable_cores

Backend = Literal["egl", "osmesa"]
"""Value of MUJOCO_GL that renders offscreen."""
Ability = Literal["everything", "estimates", "images", "speed"]
"""What a failed check prevents: all verbs, estimates, rendered images; or nothing but the usual speed."""

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
CPUINFO = Path("/proc/cpuinfo")
"""Where Linux lists the instructions that a processor has."""

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
    prevents: Ability = "everything"
    """What does not work where the check fails."""


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
    return [
        _check_python(),
        *_check_packages(),
        check_processor(),
        check_jax(),
        check_rendering(),
        _check_cores(),
        _check_memory(),
    ]


def can_run(checks: Iterable[Check]) -> bool:
    """Return whether everything works, if perhaps slowly."""
    return all(check.ok or check.prevents == "speed" for check in checks)


def verdict(checks: Iterable[Check]) -> str:
    """Return in one line what cannot be done on this machine, and what can."""
    prevented = {check.prevents for check in checks if not check.ok}
    if not prevented:
        return "ready"
    if prevented == {"speed"}:
        return "ready, but slower than documented"
    if "everything" in prevented:
        return "not ready: nothing is sure to run until what is marked above is mended"
    if {"estimates", "images"} <= prevented:
        return (
            "not ready: nothing can be estimated, and images cannot be rendered; "
            "'record --sensing points' and 'import' run"
        )
    if "estimates" in prevented:
        return "not ready: nothing can be estimated; 'record' and 'import' run"
    return (
        "not ready: images cannot be rendered; everything else runs: estimates from any recording, and "
        "'run' and 'record' with --sensing points, particles or cloud"
    )


def render_failure(backend: Backend, *, time_limit: float = RENDER_LIMIT_S) -> str | None:
    """Render one frame offscreen in a separate process and return what went wrong; None where it works.

    Args:
        backend: value of MUJOCO_GL to try.
        time_limit: time after which the process is ended [s].
    """
    probe = render_probe(backend, time_limit=time_limit)
    return None if probe.ok else probe.message


def render_probe(backend: str, *, platform: str | None = None, time_limit: float = RENDER_LIMIT_S) -> Probe:
    """Render one frame offscreen in a separate process; the message is the driver's name, or the reason it failed.

    Args:
        backend: value of MUJOCO_GL to try.
        platform: value of PYOPENGL_PLATFORM; that of the backend if None.
        time_limit: time after which the process is ended [s].
    """
    environment = {"MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend if platform is None else platform}
    return _run(_RENDER_CODE, time_limit=time_limit, **environment)


def _run(code: str, *, time_limit: float, **environment: str) -> Probe:
    """Run Python code in a separate process."""
    try:
        completed = subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, **environment},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
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
    """Return the line that says why: XLA's fatal one, or a traceback's last before the lines of clean-up code."""
    fatal = re.search(r"^F\d{4} [^\]]*\] (.*)$", stderr, flags=re.MULTILINE)
    if fatal is not None:
        return fatal[1].strip()
    return _last_line(stderr.split("Exception ignored in", maxsplit=1)[0])


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


def check_processor(cpuinfo: Path = CPUINFO, machine: str | None = None) -> Check:
    """Check that an x86 processor has AVX, without which jaxlib ends the process.

    Args:
        cpuinfo: Linux's list of the processor's flags; where there is none the check passes.
        machine: the architecture; this machine's if None.
    """
    machine = machine or platform.machine()
    try:
        flags = re.search(r"^flags\s*:(.*)$", cpuinfo.read_text(errors="replace"), flags=re.MULTILINE)
    except OSError:
        flags = None
    lacks = machine.lower() in ("x86_64", "amd64") and flags is not None and "avx" not in flags[1].split()
    return Check(
        name="processor",
        ok=not lacks,
        detail=f"{machine}{', without AVX' if lacks else ''}",
        remedy="jaxlib needs a processor with AVX; in a virtual machine, pass the host's through." if lacks else "",
        prevents="estimates",
    )


def check_jax() -> Check:
    """Check that JAX finds a device and computes in float64 on request."""
    probe = _run(_JAX_CODE, time_limit=JAX_LIMIT_S)
    return Check(
        name="jax devices",
        ok=probe.ok,
        detail="no platform can be used" if probe.message == "AssertionError" else probe.message,
        remedy="" if probe.ok else jax_remedy(probe.message, os.environ),
        prevents="estimates",
    )


def jax_remedy(reason: str, environment: Mapping[str, str]) -> str:
    """Return what to do where JAX does not start, by the reason and by the variables that it reads."""
    platforms = environment.get("JAX_PLATFORMS", "")
    if platforms not in ("", "cpu"):
        cuda = (
            ", or pip install 'jiggle-mj[cuda]' for an NVIDIA GPU" if "cuda" in platforms or "gpu" in platforms else ""
        )
        return f"JAX_PLATFORMS={platforms} is set: unset it or set JAX_PLATFORMS=cpu{cuda}."
    read = [name for name in environment if name.startswith("JAX_") or name == "XLA_FLAGS"]
    named = [name for name in read if name.lower() in reason.lower()] or read
    if named:
        return f"Unset or correct {' or '.join(named)}."
    return "Reinstall jax and jaxlib in matching versions."


def jax_failure() -> str | None:
    """Start JAX in this process and return in one line why it does not, with the remedy; None where it does.

    Wrong XLA_FLAGS end a process without an exception, so they are first tried in another one.
    """
    processor = check_processor()
    if not processor.ok:
        return f"this processor has no AVX: {processor.remedy}"
    if os.environ.get("XLA_FLAGS") and "jax" not in sys.modules:
        probe = _run("import jax; jax.devices()", time_limit=JAX_LIMIT_S)
        if not probe.ok:
            return _jax_refusal(probe.message)
    try:
        import jax

        jax.devices()
    except Exception as failure:
        return _jax_refusal(str(failure))
    return None


def _jax_refusal(message: str) -> str:
    """Return reason and remedy in one line; where no platform can be used, JAX may fail without a message."""
    reason = " ".join(message.split()).rstrip(".") or "it can use none of the requested platforms"
    return f"JAX does not start: {reason}. {jax_remedy(reason, os.environ)}"


def check_rendering(environment: Mapping[str, str] | None = None, probe: Callable[..., Probe] = render_probe) -> Check:
    """Check that images render as a recording would render them, by the user's own MUJOCO_GL and PYOPENGL_PLATFORM.

    Where they do not, both offscreen drivers are tried without these variables, to name the right remedy.

    Args:
        environment: the variables; this process's if None.
        probe: renders a frame.
    """
    environment = os.environ if environment is None else environment
    backend, platform = environment.get("MUJOCO_GL", ""), environment.get("PYOPENGL_PLATFORM", "")
    own = probe(backend or "egl", platform=platform)
    given = [f"{name}={value}" for name, value in (("MUJOCO_GL", backend), ("PYOPENGL_PLATFORM", platform)) if value]
    used = " and ".join(given) or "egl"
    return Check(
        name="rendering",
        ok=own.ok,
        detail=f"{own.message} ({used})",
        remedy="" if own.ok else _render_remedy(backend, platform, probe),
        prevents="images",
    )


def _render_remedy(backend: str, platform: str, probe: Callable[..., Probe]) -> str:
    """Return the shell command after which images render."""
    unset = f"unset {' '.join(['MUJOCO_GL'] * bool(backend) + ['PYOPENGL_PLATFORM'] * bool(platform))}"
    if (backend or platform) and probe("egl").ok:
        return unset
    if backend != "osmesa" and probe("osmesa").ok:
        return "unset PYOPENGL_PLATFORM; export MUJOCO_GL=osmesa" if platform else "export MUJOCO_GL=osmesa"
    install = f"apt-get install {' '.join(OPENGL_PACKAGES['egl'])}"
    return f"{install}, then {unset}" if backend or platform else install


def _check_cores() -> Check:
    cores = usable_cores()
    ok = cores >= MINIMUM_CORES
    return Check(
        name="cores",
        ok=ok,
        detail=str(cores),
        remedy="" if ok else "Everything works, but slower than docs/RESULTS.md says.",
        prevents="speed",
    )


def _check_memory() -> Check:
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    ok = memory >= MINIMUM_MEMORY
    return Check(
        name="memory",
        ok=ok,
        detail=f"{memory / 1e9:.1f} GB",
        remedy="" if ok else f"A run may need {MINIMUM_MEMORY / 1e9:.0f} GB of memory.",
        prevents="speed",
    )
