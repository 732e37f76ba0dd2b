"""Imports MuJoCo with offscreen OpenGL, or without any where the machine has none: physics needs no picture.

MuJoCo reads MUJOCO_GL and loads the driver's libraries while it is imported, so this runs before any other import of
it. Whether a context can be made is known only when a renderer is built: see `stereo`.
"""

import os
import sys

TOO_LATE = "mujoco" in sys.modules and not os.environ.get("MUJOCO_GL")
"""MuJoCo was imported without a backend before this package was."""
os.environ["MUJOCO_GL"] = os.environ.get("MUJOCO_GL") or "egl"

BACKEND = os.environ["MUJOCO_GL"]
"""The OpenGL backend that was asked for."""

IMPORT_ERROR: Exception | None = None
"""Why the backend's libraries could not be loaded; None if they were."""

try:
    import mujoco
except (AttributeError, ImportError, OSError, RuntimeError) as error:
    IMPORT_ERROR = error
    os.environ["MUJOCO_GL"] = "disabled"
    import mujoco  # noqa: F401

    os.environ["MUJOCO_GL"] = BACKEND


def no_opengl(error: Exception) -> str:
    """What to tell someone whose machine has no offscreen OpenGL, in one line."""
    if TOO_LATE:
        return (
            "No offscreen OpenGL: mujoco was imported before jiggle_mj. Import jiggle_mj first, or set MUJOCO_GL=egl."
        )
    cause = error.__cause__ or error
    reason = (str(cause).splitlines() or [type(cause).__name__])[0].rstrip(".")
    return (
        f"No offscreen OpenGL: MUJOCO_GL={BACKEND} failed ({reason}). Install libegl1 libgl1 "
        "libgl1-mesa-dri, or set MUJOCO_GL=osmesa with libosmesa6; see 'jiggle-mj doctor'."
    )
