"""Each disturbance of the sensing changes points, images and the tool's report by its formula."""

import dataclasses
import json
import math
from functools import cache
from itertools import pairwise

import cv2
import mujoco
import numpy as np
import pytest

from jiggle_mj.actions import Grasp, Move, Wait
from jiggle_mj.episode import observe
from jiggle_mj.errors import SceneError
from jiggle_mj.observation import Observation, StereoPair
from jiggle_mj.recording.mcap_files import iterate_records
from jiggle_mj.recording.reader import Recording
from jiggle_mj.recording.truth import read_truth
from jiggle_mj.scenes import DISTURBANCES, Reference, disturbed, load_scene
from jiggle_mj.scenes.disturbances.images import SMOKE_DISPARITY, SMOKE_RGB
from jiggle_mj.scenes.scene.disturbance import SensingDisturbance
from jiggle_mj.scenes.scene.scene import CameraConfig, Scene, SensingConfig, TextureConfig, TissueConfig
from jiggle_mj.scenes.scene_file import scene_from_table
from jiggle_mj.scenes.tissue.cameras import stereo_camera
from tests.support.tiny_scene import SCENE as TOML
from tests.support.tiny_scene import call

EXACT = 1e-9
"""Standard deviation of the points' noise [m], so small that it does not matter: 20 of it bound every difference."""
ROUNDING = 1e-12
"""Rounding of positions [m]."""
SCENE = Scene(
    name="sheet",
    tissue=TissueConfig(size=(0.06, 0.06), spacing=8e-3),
    sensing=SensingConfig(point_sd=EXACT, image_sd=0.0),
    camera=CameraConfig(width=320, height=240),
    texture=TextureConfig(resolution=256),
)
CORNER = np.array([-0.028, -0.028, 4e-4])
NEEDS = {n: cls.needs for n, cls in DISTURBANCES.items() if issubclass(cls, SensingDisturbance) and cls.needs}
DELAY, DELAY_STEPS = 0.4, 20
"""Delay [s], and its number of steps of 20 ms."""


def made(*disturbances: str, sensing="particles", scene: Scene = SCENE) -> Reference:
    return Reference(disturbed(scene, disturbances), seed=0, sensing=sensing)


def lift(reference: Reference) -> list[Observation]:
    """Return the observations of a wait, a grasp of the corner, and two moves up by 5 mm."""
    tops = [CORNER + np.array([0.0, 0.0, z]) for z in (0.005, 0.01)]
    return [
        reference.step(action) for action in (Wait(), Grasp(point=CORNER, radius=9e-3), *(Move(to=top) for top in tops))
    ]


@cache
def still(*disturbances: str, scene: Scene = SCENE) -> StereoPair:
    """Return the images of a sheet at rest."""
    with made(*disturbances, sensing="stereo", scene=scene) as reference:
        images = reference.step(Wait()).images
    assert images is not None
    return images


def positions(observation: Observation) -> np.ndarray:
    assert observation.points is not None
    return observation.points.positions


def shift(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the displacement of the second image to the right and down [px]."""
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float64) for image in (first, second)]
    return np.array(cv2.phaseCorrelate(*grey, cv2.createHanningWindow(grey[0].shape[::-1], cv2.CV_64F))[0])


def test_a_tool_bias_displaces_the_reported_tip():
    reference = made("tool_bias=0.003")
    lift(reference)
    bias = reported_tip(reference) - reference.truth_frame().tip
    np.testing.assert_allclose(bias, [3e-3, 0, 0], atol=ROUNDING)


def reported_tip(reference: Reference) -> np.ndarray:
    return reference.step(Wait()).tool.position


def test_a_tool_scale_lengthens_the_reported_displacement():
    reference = made("tool_scale=1.1")
    lift(reference)
    np.testing.assert_allclose(
        reported_tip(reference) - CORNER, 1.1 * (reference.truth_frame().tip - CORNER), atol=ROUNDING
    )


def test_a_tool_turn_rotates_the_reported_displacement():
    reference = made("tool_turn=90")
    lift(reference)
    x, y, z = reference.truth_frame().tip - CORNER
    np.testing.assert_allclose(reported_tip(reference) - CORNER, [z, y, -x], atol=ROUNDING)


def test_late_sensing_shows_the_past():
    """Exactly the state of a delay ago, while the tool has moved on by more than 1 mm."""
    tips, states = [], []
    reference = made(f"tool_latency={DELAY}", f"image_latency={DELAY}")
    simulation = reference.simulation

    def record() -> None:
        tips.append(simulation.jaws.tip)
        states.append(simulation.data.qpos.copy())

    simulation.step_hooks.append(record)
    seen = lift(reference)[-1]
    np.testing.assert_array_equal(seen.tool.position, tips[-1 - DELAY_STEPS])
    simulation.data.qpos[:] = states[-1 - DELAY_STEPS]
    np.testing.assert_allclose(positions(seen), tracked_points(reference), atol=10 * EXACT)
    assert np.abs(tips[-1] - tips[-1 - DELAY_STEPS]).max() > 1e-3


def test_a_late_tool_is_where_it_closes():
    """The report does not jump from the parking position, which would be a grasp off the tissue."""
    reference = made("tool_latency=1")
    reference.step(Wait())
    np.testing.assert_array_equal(reference.step(Grasp(point=CORNER, radius=9e-3)).tool.position, CORNER)


def tracked_points(reference: Reference) -> np.ndarray:
    """Return the true positions of the tracked points in the present state [m]."""
    simulation, tracks = reference.simulation, reference.observer.tracks
    mujoco.mj_fwdPosition(simulation.model, simulation.data)
    assert tracks is not None
    return tracks.positions(simulation.surface())


def test_a_displaced_camera_displaces_all_that_it_measures():
    """A pair that stands 2 mm farther right measures everything 2 mm farther left."""
    right = stereo_camera(SCENE.camera).T_world_camera[:3, 0]
    moved = positions(made("camera_bias").step(Wait())) - positions(made().step(Wait()))
    np.testing.assert_allclose(moved, np.broadcast_to(-2e-3 * right, moved.shape), atol=20 * EXACT)


def test_a_displaced_camera_sees_a_displaced_image():
    """By f times 2 mm over the distance of the target, within 15 %: the camera is tilted, so distances differ."""
    camera = stereo_camera(SCENE.camera)
    pixels = camera.focal[0] * 2e-3 / SCENE.camera.distance
    np.testing.assert_allclose(shift(still().left, still("camera_bias").left), [-pixels, 0], atol=0.15 * pixels)


def test_a_drifting_camera_moves_with_time_and_rolls():
    right, centre = (stereo_camera(SCENE.camera).T_world_camera[:3, column] for column in (0, 3))
    table = [{"name": "camera_drift", "magnitude": 0.01, "roll_deg": 0.0}]
    plain, drifted = (last_of_five(reference) for reference in (made(), made(scene=with_table(table))))
    moved = positions(drifted) - positions(plain)
    np.testing.assert_allclose(
        moved, np.broadcast_to(-0.01 * drifted.time * 1e-9 * right, moved.shape), atol=20 * EXACT
    )
    rolling = made(scene=with_table([{"name": "camera_drift", "magnitude": 0.0, "roll_deg": 5.0}])).step(Wait())
    distances = [np.linalg.norm(positions(seen) - centre, axis=1) for seen in (made().step(Wait()), rolling)]
    np.testing.assert_allclose(*distances, atol=20 * EXACT)
    assert np.abs(positions(rolling) - positions(made().step(Wait()))).max() > 1e-4


def last_of_five(reference: Reference) -> Observation:
    return [reference.step(Wait()) for _ in range(5)][-1]


def with_table(disturbances: list[dict]) -> Scene:
    read = scene_from_table({"disturbances": disturbances}, name="it").disturbances
    return dataclasses.replace(SCENE, disturbances=read)


def test_a_wrong_baseline_scales_all_distances_from_the_camera():
    centre = stereo_camera(SCENE.camera).T_world_camera[:3, 3]
    plain, scaled = (positions(made(*texts).step(Wait())) - centre for texts in ((), ("depth_scale=1.1",)))
    np.testing.assert_allclose(scaled, 1.1 * plain, atol=20 * EXACT)


def test_a_wrong_baseline_moves_the_right_image_alone():
    """The disparity d shrinks by d (1 - 1 / 1.2), within 20 %: the camera is tilted, so distances differ."""
    camera, scaled = stereo_camera(SCENE.camera), still("depth_scale=1.2")
    disparity = camera.focal[0] * camera.baseline / SCENE.camera.distance
    np.testing.assert_array_equal(scaled.left, still().left)
    assert shift(still().right, scaled.right)[0] == pytest.approx(disparity * (1 - 1 / 1.2), rel=0.2)


def test_lost_frames_are_missing_from_recording_and_truth_alike(tmp_path):
    """The indices have no gaps, and nothing of a lost frame is written.

    Of 40 frames 20 +- 3.2 arrive; 8 to 32 is over 3 sd.
    """
    actions = [Wait()] * 40
    with made("frame_drop=0.5") as reference:
        arrived = [seen.index for seen in observe(reference, actions, tmp_path / "run.mcap", seed=0)]
    assert 8 < len(arrived) < 32 and arrived == list(range(len(arrived)))
    recorded, truth = Recording.open(tmp_path / "run.mcap"), read_truth(tmp_path / "run.truth.mcap")
    assert [seen.index for seen in recorded] == arrived == [frame.index for frame in truth.frames]
    assert [seen.time for seen in recorded] == [frame.time for frame in truth.frames]


def test_repeated_frames_show_the_frame_before_at_a_new_time():
    """Repeats make up 14.5 +- 2.7 of the 29 frames after the first; 5 to 25 is over 3 sd."""
    reference = made("frame_repeat=0.5")
    seen = [reference.step(Wait()) for _ in range(30)]
    same = sum(np.array_equal(positions(a), positions(b)) for a, b in pairwise(seen))
    assert 5 < same < 25
    assert len({observation.time for observation in seen}) == 30


def test_tracked_points_slide_over_the_sheet():
    """By speed times time, within 5 %: the sheet at rest is slightly strained."""
    seen, there = last_of_five(made("point_slip=0.005")), positions(last_of_five(made()))
    inside = np.abs(there[:, 0]) < 0.02
    moved = (positions(seen) - there)[inside, 0]
    np.testing.assert_allclose(moved, 0.005 * seen.time * 1e-9, rtol=0.05)


def test_noise_blur_and_exposure():
    """Within 5 % of the noise's standard deviation and 2 % of the mean, since images are rounded."""
    plain = still()
    noise = still("image_noise=12").left.astype(float) - plain.left
    middle = (plain.left > 60) & (plain.left < 190)
    assert noise[middle].std() == pytest.approx(12, rel=0.05)
    assert still("exposure=0.6").right.mean() == pytest.approx(0.6 * plain.right.mean(), rel=0.02)
    np.testing.assert_array_equal(still("exposure=0.6").left, plain.left)
    np.testing.assert_array_equal(still("blur=2").left, cv2.GaussianBlur(plain.left, (0, 0), 2))


def test_smoke_replaces_a_share_of_the_light_and_is_nearer_than_the_tissue():
    """Its share is 0.4 on average; 0.1 is left for one image, whose clouds need not average to 0."""
    plain, hazed = still(), still("haze=0.4")
    share = [
        (np.asarray(new, float) - old).mean() / (SMOKE_RGB.mean() - old.mean()) for old, new in pairs(plain, hazed)
    ]
    assert np.mean(share) == pytest.approx(0.4, abs=0.1)
    black = StereoPair(left=np.zeros_like(plain.left), right=np.zeros_like(plain.left))
    with made("haze=0.4", sensing="stereo") as reference:
        reference.step(Wait())
        (smoke,) = reference.observer.faults.image_effects
    alone = smoke(black, np.random.default_rng(0))
    disparity = round(alone.left.shape[1] * SMOKE_DISPARITY)
    np.testing.assert_array_equal(alone.left[:, disparity:], alone.right[:, :-disparity])


def pairs(first: StereoPair, second: StereoPair) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(first.left, second.left), (first.right, second.right)]


def lifted(*disturbances: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the left image before the tool comes, and with a corner lifted [grey levels]."""
    with made(*disturbances, sensing="stereo") as reference:
        frames = [seen.images for seen in lift(reference)]
    assert frames[0] is not None and frames[-1] is not None
    return frames[0].left.astype(int), frames[-1].left.astype(int)


def test_highlights_brighten_the_lifted_tissue():
    """By more than 40 grey levels, 20 times a scene's pixel noise."""
    (_, plain), (_, glossy) = lifted(), lifted("specular=1")
    assert (glossy - plain).max() > 40
    assert (glossy - plain).min() >= 0
    np.testing.assert_array_equal(still("specular=0").left, still().left)


def test_a_highlight_is_elsewhere_in_each_image():
    """At a baseline of 2 cm, less than half of the highlights lies on the same tissue in both images.

    A pixel belongs to a highlight if it is brighter by 30 grey levels, 15 times a scene's pixel noise.
    """
    wide = dataclasses.replace(SCENE, camera=dataclasses.replace(SCENE.camera, baseline=0.02))
    plain, pair = still(scene=wide), still("specular=1", scene=wide)
    shine = [(new.astype(int) - old).min(axis=2) > 30 for old, new in pairs(plain, pair)]
    disparity = round(stereo_camera(wide.camera).focal[0] * wide.camera.baseline / wide.camera.distance)
    left, right = shine[0][:, disparity:], shine[1][:, :-disparity]
    assert left.sum() > 100 and (left & right).sum() < 0.5 * (left | right).sum()


def test_a_thick_tool_hides_more():
    """More than 2 % of the image changes by 20 grey levels, 10 times a scene's pixel noise."""
    (before, plain), (before_thick, hidden) = lifted(), lifted("tool_occlusion=4")
    np.testing.assert_array_equal(before, before_thick)
    assert (np.abs(hidden - plain).max(axis=2) > 20).mean() > 0.02


def test_blood_hides_its_share_of_the_sheet():
    """Within 0.05: colour tells blood from tissue, except at the borders of patches and on vessels."""
    plain, bloody = still(), still("dark_patches=0.2")
    tissue = plain.left[..., 0] > plain.left[..., 2].astype(int) + 20
    dark = tissue & (bloody.left.sum(axis=2) < 0.6 * plain.left.sum(axis=2))
    assert dark.sum() / tissue.sum() == pytest.approx(0.2, abs=0.05)


@pytest.mark.parametrize(("name", "needs"), NEEDS.items())
def test_a_disturbance_of_other_sensing_is_refused(name, needs):
    for sensing in {"particles", "cloud"} - set(needs):
        with pytest.raises(SceneError, match=rf"the disturbance {name} needs sensing = "):
            made(name, sensing=sensing)


def test_a_secret_is_in_the_truth_alone(tmp_path, monkeypatch, capsys):
    """The recording, the file names and the printed text neither name the disturbances nor say that there are any."""
    for secret in (True, False):
        scene, out = tmp_path / f"hidden{secret}.toml", tmp_path / str(secret)
        scene.write_text(f"secret = {str(secret).lower()}\n{TOML}")
        out.mkdir()
        arguments = ("--sensing", "particles", "--disturb", "substrate=2", "--disturb", "tool_bias")
        assert call(monkeypatch, "record", scene, "--out", out / "run.mcap", *arguments) == 0
        printed = capsys.readouterr()
        public = printed.out + printed.err + " ".join(path.name for path in out.iterdir())
        public += "".join(vars(record).__repr__() for record in iterate_records(out / "run.mcap"))
        public = public.replace(str(tmp_path), "")
        named = [word for word in ("disturb", "substrate", "tool_bias", "secret") if word in public]
        assert named == ([] if secret else ["disturb", "substrate", "tool_bias"])
        details = json.dumps(read_truth(out / "run.truth.mcap").details)
        assert "substrate" in details and "tool_bias" in details
    assert Recording.open(tmp_path / "False" / "run.mcap").metadata["disturbances"] == "substrate=2, tool_bias=0.002"


def test_the_shipped_scenes_have_no_disturbances():
    assert load_scene("arc").disturbances == () and not load_scene("arc").secret
    assert all(item.start == 0 for item in disturbed(SCENE, ["gravity", "blur"]).disturbances)


def test_smooth_noise_is_shared_by_neighbours_and_new_in_each_frame():
    """Over many frames the covariance of two points is smooth_sd^2 exp(-d^2 / 2 smooth_length^2).

    From 300 frames of 3 coordinates a variance has a standard error of 0.05 sd^2; 0.15 is 3 of them. The correlation
    between frames has at most that of 900 samples, 0.03; 0.1 is 3 of them.
    """
    sd, length, frames = 3e-4, 0.01, 300
    noisy = dataclasses.replace(SCENE, sensing=SensingConfig(point_sd=EXACT, smooth_sd=sd, smooth_length=length))
    reference = Reference(noisy, seed=0, sensing="particles")
    observer = reference.observer
    views = [observer.look() for _ in range(frames)]
    seen = np.array([view[1].positions for view in views if view is not None and view[1] is not None])
    assert views[0][1].sd == pytest.approx(math.hypot(EXACT, sd))
    noise = seen - seen.mean(axis=0)
    covariance = np.einsum("tmi,tni->mn", noise, noise) / (3 * frames)
    distance = np.linalg.norm(seen[0][:, None, :2] - seen[0][None, :, :2], axis=2)
    np.testing.assert_allclose(covariance, sd**2 * np.exp(-0.5 * distance**2 / length**2), atol=0.15 * sd**2)
    correlation = np.einsum("tmi,tmi->", noise[1:], noise[:-1]) / np.einsum("tmi,tmi->", noise, noise)
    assert abs(correlation) < 0.1
