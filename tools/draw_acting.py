"""Draw docs/images/acting.webp from a run with images: P(attached) in every frame, and the path of the grip.

Run from the project's folder, after `jiggle-mj run arc --policy information --out out/acting`:
.venv/bin/python tools/draw_acting.py out/acting
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from jiggle_mj.eval.metrics.truth_transfer import transfer
from jiggle_mj.recording.estimate import read_estimate
from jiggle_mj.recording.reader import Recording
from jiggle_mj.recording.truth import read_truth

OUT = Path("docs/images/acting.webp")
SHOWN = slice(60, 480), slice(100, 580)
"""Rows and columns of the image that are shown."""
SCALE = 0.75
"""Scale of the picture; pictures in the docs are small."""
FRAME_MS = 350
"""Time that a frame is shown [ms]."""
LAST_FRAMES = 5
"""Times longer that the last frame is shown."""
WEBP_QUALITY = 25
"""Quality of the pictures, for a file below the limit of tests/project/test_readme.py."""
WHITE, RED = (255, 255, 255), (40, 40, 230)
FONT = cv2.FONT_HERSHEY_SIMPLEX


def frames(folder: Path) -> list[np.ndarray]:
    """Return left images with particles coloured by P(attached), true attachments ringed, and the path of the grip."""
    recording, estimated = Recording.open(folder / "run.mcap"), read_estimate(folder / "estimate.mcap")
    truth = transfer(estimated.sheet, read_truth(folder / "run.truth.mcap"), estimated.estimates[0].index)
    estimates, drawn = {estimate.index: estimate for estimate in estimated.estimates}, []
    paths: dict[int, list[np.ndarray]] = {}
    camera = recording.camera
    assert camera is not None
    for seen in recording:
        if seen.images is None or seen.index not in estimates:
            continue
        estimate, image = estimates[seen.index], cv2.cvtColor(seen.images.left, cv2.COLOR_RGB2BGR)
        pixel = camera.project(estimate.positions)[:, :2].round().astype(int)
        paths.setdefault(seen.tool.grasp, []).append(pixel[estimate.held].mean(axis=0).round().astype(int))
        level = (255 * np.clip(np.nan_to_num(estimate.probability), 0, 1)).astype(np.uint8)
        colour = cv2.applyColorMap(level[:, None], cv2.COLORMAP_VIRIDIS)[:, 0]
        for place, bgr, attached in zip(pixel.tolist(), colour.tolist(), truth.attached, strict=True):
            cv2.circle(image, place, 3, bgr, -1, cv2.LINE_AA)
            if attached:
                cv2.circle(image, place, 5, WHITE, 1, cv2.LINE_AA)
        cv2.polylines(image, [np.array(path) for path in paths.values()], False, RED, 2, cv2.LINE_AA)
        words = f"frame {seen.index}: entropy {estimate.entropy:.0f} nat"
        cv2.putText(image, words, (SHOWN[1].start + 10, SHOWN[0].start + 24), FONT, 0.6, WHITE, 1, cv2.LINE_AA)
        drawn.append(cv2.resize(image[SHOWN], None, fx=SCALE, fy=SCALE, interpolation=cv2.INTER_AREA))
    return drawn


if __name__ == "__main__":
    animation = cv2.Animation()
    animation.frames = frames(Path(sys.argv[1]))
    animation.durations = [FRAME_MS] * (len(animation.frames) - 1) + [LAST_FRAMES * FRAME_MS]
    cv2.imwriteanimation(str(OUT), animation, [cv2.IMWRITE_WEBP_QUALITY, WEBP_QUALITY])
