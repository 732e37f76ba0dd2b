"""Import of MuJoCo with offscreen OpenGL, or without any where the machine has none: the physics needs no images.

MuJoCo reads MUJOCO_GL and loads the driver's libraries while it is imported, so this module runs before any other
import of it. Only a renderer shows whether a context can be made: see `sensing/stereo.py`.
"""

import os
import sys
import warnings

MUJOCO_CAME_FIRST = "mujoco" in sys.modules and not os.environ.get("MUJOCO_GL")
"""Whether MuJoCo was imported, without a backend, before this package."""
os.environ["MUJOCO_GL"] = os.environ.get("MUJOCO_GL") or "egl"

OFFSCREEN = ("egl", "osmesa")
"""Backends that render without a window."""
BACKEND = os.environ["MUJOCO_GL"]
"""OpenGL backend that was requested."""

warnings.filterwarnings("ignore", module="glfw")  # the error that follows says the same, in one line
IMPORT_ERROR: Exception | None = None
"""Error from loading the backend's libraries; None if they were loaded."""

try:
    import mujoco
except (AttributeError, ImportError, OSError, RuntimeError) as error:
    IMPORT_ERROR = error
    os.environ["MUJOCO_GL"] = "disabled"
    import mujoco  # noqa: F401

    os.environ["MUJOCO_GL"] = BACKEND


def no_opengl(error: Exception) -> str:
    """Return the message for a machine without offscreen OpenGL, in one line."""
    if MUJOCO_CAME_FIRST:
        return (
            "No offscreen OpenGL: mujoco was imported before jiggle_mj. Import jiggle_mj first, or set MUJOCO_GL=egl."
        )
    cause = error.__cause__ or error
    reason = (str(cause).splitlines() or [type(cause).__name__])[0].rstrip(".")
    platform = os.environ.get("PYOPENGL_PLATFORM") or BACKEND
    if BACKEND not in OFFSCREEN or platform != BACKEND:
        names = ["MUJOCO_GL"] * (BACKEND not in OFFSCREEN) + ["PYOPENGL_PLATFORM"] * (platform != BACKEND)
        given = " and ".join(f"{name}={os.environ[name]}" for name in names)
        return f"No offscreen OpenGL: {given} failed ({reason}). Unset {' and '.join(names)}; see 'jiggle-mj doctor'."
    return (
        f"No offscreen OpenGL: MUJOCO_GL={BACKEND} failed ({reason}). Install libegl1 libgl1 "
        "libgl1-mesa-dri, or set MUJOCO_GL=osmesa with libosmesa6; see 'jiggle-mj doctor'."
    )
