"""Draw docs/images/disturbances.jpg: the same lift of the scene `arc` under several disturbances.

Run it in the project's folder: .venv/bin/python tools/draw_disturbances.py
"""

import os
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")

import cv2
import numpy as np

from jiggle_mj.scenes import Reference, disturbed, load_scene, programme

SHOWN_DISTURBANCES = ("", "gravity=0", "grasp_slip", "specular", "haze", "dark_patches", "tool_occlusion")
"""Disturbances of the tiles, as the command line writes them; empty for none."""
CROP = slice(70, 480), slice(20, 567)
"""Rows and columns of the image that are shown: the sheet and the tool [px]."""
TILE_SIZE = (280, 210)
"""Width and height of a tile [px]; the crop has the same proportions."""
JPEG_QUALITY = 85
"""Quality at which the texture is still clear and the file is below 300 kB."""
OUT = Path("docs/images/disturbances.jpg")


def lifted(text: str) -> np.ndarray:
    """Return the left image at the top of the first lift, with the disturbance's name."""
    scene = disturbed(load_scene("arc"), [text] if text else [])
    n_frames = scene.programme.still_frames + 1 + scene.programme.increments
    with Reference(scene, seed=0, sensing="stereo") as reference:
        *_, last = (reference.step(action) for _, action in zip(range(n_frames), programme(scene), strict=False))
    assert last.images is not None
    tile = cv2.resize(last.images.left[CROP], TILE_SIZE, interpolation=cv2.INTER_AREA)
    white, font = (255, 255, 255), cv2.FONT_HERSHEY_SIMPLEX
    return cv2.putText(tile, text or "no disturbance", (6, 16), font, 0.45, white, 1, cv2.LINE_AA)


if __name__ == "__main__":
    row = np.hstack([lifted(text) for text in SHOWN_DISTURBANCES])
    cv2.imwrite(str(OUT), cv2.cvtColor(row, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
