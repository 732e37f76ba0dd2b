"""Images that cannot be a stereo pair of one moment are named; a right pair is not."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from jiggle_mj.camera import StereoCamera
from jiggle_mj.observation import IDENTITY_WXYZ, Declaration, Observation, StereoPair, ToolState
from jiggle_mj.plausibility.problems import problems
from jiggle_mj.plausibility.survey import survey
from jiggle_mj.recording.reader import Recording
from jiggle_mj.recording.writer import RecordingWriter

WIDTH, HEIGHT, DISPARITY, MOTION, FRAMES = 320, 240, 12, 4, 8
"""Size of the images, disparity of the scene, and rows that its middle third moves from frame to frame [px]."""


def texture() -> np.ndarray:
    """Blobs of a few pixels, as skin has."""
    noise = np.random.default_rng(5).normal(size=(HEIGHT, WIDTH + DISPARITY))
    blobs = cv2.GaussianBlur(noise, (0, 0), 2.0)
    grey = np.clip(128 + 40 * blobs / blobs.std(), 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def scene(frame: int) -> np.ndarray:
    """The texture, its middle third moved along the columns."""
    picture = texture()
    third = slice(WIDTH // 3, 2 * WIDTH // 3)
    picture[:, third] = np.roll(picture[:, third], MOTION * frame, axis=0)
    return picture


@dataclass(frozen=True, kw_only=True)
class Pair:
    """A pair of cameras before a plane; each field makes one mistake."""

    late: dict[str, int]
    """Frames by which a side is late."""
    change: Callable[[np.ndarray], np.ndarray] = lambda image: image
    """What is done with the right images."""
    both: Callable[[np.ndarray], np.ndarray] = lambda image: image
    """What is done with all images."""
    swapped: bool = False

    def at(self, frame: int) -> StereoPair:
        left = scene(max(frame - self.late.get("left", 0), 0))[:, :WIDTH]
        right = self.change(scene(max(frame - self.late.get("right", 0), 0))[:, DISPARITY:])
        sides = (right, left) if self.swapped else (left, right)
        first, second = (np.ascontiguousarray(self.both(each)) for each in sides)
        return StereoPair(left=first, right=second)


def moved_down(rows: float, degrees: float = 0.0) -> Callable[[np.ndarray], np.ndarray]:
    M = cv2.getRotationMatrix2D((WIDTH / 2, HEIGHT / 2), degrees, 1.0)
    M[1, 2] += rows
    return lambda image: cv2.warpAffine(image, M, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT)


def covered(image: np.ndarray) -> np.ndarray:
    """A black image with the noise of a camera at full gain."""
    return np.clip(np.random.default_rng(1).normal(8, 6, image.shape), 0, 255).astype(np.uint8)


def found(path, pair: Pair) -> dict[str, bool]:
    """Return the names of the problems of the images, each with whether it refuses."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = 0.2
    camera = StereoCamera.rectified(
        width=WIDTH, height=HEIGHT, focal=300.0, baseline=DISPARITY * 0.2 / 300, T_world_camera=T
    )
    with RecordingWriter(path / "run.mcap", camera=camera, declaration=Declaration(), metadata={}) as writer:
        for frame in range(FRAMES):
            tool = ToolState(
                position=np.array([0, 0, 1e-3 * frame]), quat_wxyz=IDENTITY_WXYZ, closed=True, grasp=1, radius=2e-3
            )
            writer.write(Observation(index=frame, time=frame * 10**8, tool=tool, images=pair.at(frame)))
    surveyed = survey(Recording.open(path / "run.mcap"))
    assert set(surveyed.doubts) <= set(problems(surveyed))
    return {each.name: each.refuses for each in surveyed.doubts}


def test_a_right_pair_has_no_problem(tmp_path):
    assert found(tmp_path, Pair(late={})) == {}


@pytest.mark.parametrize("side", ("left", "right"))
def test_images_of_the_frame_before_are_named(tmp_path, side: str):
    """Even where the calibration is 0.8 px wrong in the rows."""
    assert found(tmp_path, Pair(late={side: 1}, change=moved_down(0.8))) == {"images-late": True}


def test_a_covered_lens_is_named(tmp_path):
    assert found(tmp_path, Pair(late={}, change=covered)) == {"images-blank": True}


def test_swapped_images_are_named(tmp_path):
    assert found(tmp_path, Pair(late={}, swapped=True)) == {"images-swapped": True}


@pytest.mark.parametrize(
    ("rows", "degrees", "refuses"),
    [
        (1.5, 0.0, {"image-rows": False}),
        (-4.0, 0.0, {"image-rows": True}),
        (30.0, 0.0, {"image-rows": True}),
        (0.0, 3.0, {"image-rows": True}),  # 3 degrees over a quarter of the width: 4.2 px
    ],
)
def test_rows_that_do_not_fit_are_named(tmp_path, rows: float, degrees: float, refuses: dict):
    assert found(tmp_path, Pair(late={}, change=moved_down(rows, degrees))) == refuses


def test_unlike_images_and_images_without_features_are_not_judged(tmp_path):
    (tmp_path / "other").mkdir()
    assert found(tmp_path / "other", Pair(late={}, change=lambda image: image[::-1, ::-1])) == {}
    ramp = np.linspace(0, 255, WIDTH).astype(np.uint8)
    assert found(tmp_path, Pair(late={}, both=lambda image: np.broadcast_to(ramp[None, :, None], image.shape))) == {}
