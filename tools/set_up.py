"""Set up this checkout: a virtual environment from the lock file, the package in it, and offscreen OpenGL.

Needs a bare Python >= 3.11 and nothing else. What the machine lacks comes from its own package manager, apt: the
venv module when Python has none, Mesa's software driver when an offscreen render fails. `make` calls this whenever
the lock file or pyproject.toml has changed. Does not upgrade anything on its own: versions come from the lock.
"""

import argparse
import functools
import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

if sys.version_info < (3, 11):  # noqa: UP036  # whoever runs this may have any Python 3
    found = "{}.{}".format(*sys.version_info[:2])
    sys.exit("jiggle-mj needs Python 3.11 or newer; " + found + " was given (try 'make PYTHON=python3.11 ...').")

ROOT = Path(__file__).resolve().parent.parent
VENV_PACKAGE = f"python{sys.version_info.major}.{sys.version_info.minor}-venv"


def log(text: str) -> None:
    """Tell progress on stderr."""
    print(f"set-up: {text}", file=sys.stderr, flush=True)


def run(*command: str | Path, **options) -> None:
    """Run a command without standard input, its output on stderr, and stop where it fails."""
    done = subprocess.run([str(word) for word in command], stdin=subprocess.DEVNULL, stdout=sys.stderr, **options)
    if done.returncode:
        sys.exit(f"set-up: '{' '.join(map(str, command))}' failed with exit code {done.returncode}; see above.")


def apt_command() -> list[str] | None:
    """How this user can run apt-get: as root, through a sudo that asks nothing, or not at all."""
    if not shutil.which("apt-get"):
        return None
    if os.geteuid() == 0:
        return ["apt-get"]
    if shutil.which("sudo") and subprocess.run(["sudo", "-n", "true"], capture_output=True).returncode == 0:
        return ["sudo", "-n", "apt-get"]
    return None


@functools.cache
def refresh_package_lists(*apt: str) -> None:
    """Run apt-get update, once."""
    run(*apt, "-qq", "update")


def install_packages(packages: list[str], purpose: str) -> None:
    """Install Debian packages, or say which ones the user has to install."""
    apt = apt_command()
    if apt is None:
        sys.exit(
            f"set-up: {purpose} needs the Debian package(s) {' '.join(packages)}, and this user cannot install them "
            f"here. Run 'sudo apt-get install {' '.join(packages)}' (or your system's equivalent), then try again."
        )
    log(f"{purpose}: installing {' '.join(packages)} with apt-get")
    refresh_package_lists(*apt)
    options = ["-o", "DPkg::Lock::Timeout=300", "-o", "Dpkg::Use-Pty=0", "-qq", "-y", "--no-install-recommends"]
    run(*apt, *options, "install", *packages, env={**os.environ, "DEBIAN_FRONTEND": "noninteractive"})


def make_environment(venv: Path) -> Path:
    """Make the virtual environment, unless there is a usable one; return its interpreter."""
    python = venv / "bin" / "python"
    usable = "import sys; sys.exit(sys.version_info < (3, 11))"
    if not python.exists() or subprocess.run([python, "-c", usable]).returncode:
        if importlib.util.find_spec("ensurepip") is None:
            install_packages([VENV_PACKAGE], "Python's venv module")
        log(f"making {venv} with Python {sys.version.split()[0]}")
        run(sys.executable, "-m", "venv", "--clear", venv)
    if subprocess.run([python, "-c", "import pip"], capture_output=True).returncode:
        run(python, "-m", "ensurepip")
    return python


def install_project(python: Path) -> None:
    """Install the locked dependencies, each checked against its hash, and the project itself, editable."""
    pip = [python, "-m", "pip", "--disable-pip-version-check", "install", "--quiet"]
    log("installing the locked packages (about 330 MB to download the first time)")
    run(*pip, "--require-hashes", "--only-binary", ":all:", "--requirement", ROOT / "requirements-dev.lock")
    run(*pip, "--no-deps", "--no-build-isolation", "--editable", ROOT)


def render_failure(python: Path, backend: str) -> str | None:
    """Try one offscreen frame; None where it works, else what went wrong."""
    code = f"from jiggle_mj.doctor import render_failure as f; print(f({backend!r}, time_limit=60) or '')"
    done = subprocess.run([python, "-c", code], capture_output=True, text=True, stdin=subprocess.DEVNULL)
    return (done.stdout or done.stderr).strip() or None


def set_up_opengl(python: Path) -> None:
    """Install a software driver where nothing renders offscreen."""
    backend = os.environ.get("MUJOCO_GL") or "egl"
    failure = render_failure(python, backend)
    if failure is None:
        return
    log(f"no offscreen OpenGL yet ({failure})")
    code = f"from jiggle_mj.doctor import OPENGL_PACKAGES; print(*OPENGL_PACKAGES.get({backend!r}, ()))"
    packages = subprocess.run([python, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    if not packages:
        sys.exit(f"set-up: MUJOCO_GL={backend} does not render on this machine; unset it to use egl.")
    install_packages(packages, "offscreen OpenGL")
    failure = render_failure(python, backend)
    if failure:
        sys.exit(f"set-up: MUJOCO_GL={backend} does not render, with {' '.join(packages)} installed: {failure}")


def main() -> None:
    """Do each step that is still to be done."""
    parser = argparse.ArgumentParser(description="Set up this checkout.")
    parser.add_argument("--venv", type=Path, default=ROOT / ".venv", help="where the virtual environment goes")
    venv = parser.parse_args().venv.resolve()
    python = make_environment(venv)
    install_project(python)
    set_up_opengl(python)
    log(f"done: {venv}")


if __name__ == "__main__":
    main()
