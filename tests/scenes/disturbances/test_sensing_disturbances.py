"""Each disturbance of the sensing does to points, images and the tool's report exactly what it says."""

import dataclasses
import json
import math
from functools import cache
from itertools import pairwise

import cv2
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
from jiggle_mj.scenes.scene.disturbance import SensingDisturbance
from jiggle_mj.scenes.scene.scene import CameraConfig, Scene, SensingConfig, TextureConfig, TissueConfig
from jiggle_mj.scenes.scene_file import scene_from_table
from jiggle_mj.scenes.tissue.cameras import stereo_camera
from tests.support.tiny_scene import SCENE as TOML
from tests.support.tiny_scene import call

EXACT = 1e-9
SCENE = Scene(
    name="sheet",
    tissue=TissueConfig(size=(0.06, 0.06), spacing=8e-3),
    sensing=SensingConfig(point_sd=EXACT, image_sd=0.0),
    camera=CameraConfig(width=320, height=240),
    texture=TextureConfig(resolution=256),
)
CORNER = np.array([-0.028, -0.028, 4e-4])
NEEDS = {n: cls.needs for n, cls in DISTURBANCES.items() if issubclass(cls, SensingDisturbance) and cls.needs}
LATE, STEPS = 0.4, 20
"""[s], and so many steps of 20 ms."""


def made(*disturbances: str, sensing="particles", scene: Scene = SCENE) -> Reference:
    return Reference(disturbed(scene, disturbances), seed=0, sensing=sensing)


def lift(reference: Reference) -> list[Observation]:
    tops = [CORNER + np.array([0.0, 0.0, z]) for z in (0.005, 0.01)]
    return [reference.step(one) for one in (Wait(), Grasp(point=CORNER, radius=9e-3), *(Move(to=top) for top in tops))]


@cache
def still(*disturbances: str, scene: Scene = SCENE) -> StereoPair:
    """A sheet at rest."""
    with made(*disturbances, sensing="stereo", scene=scene) as reference:
        images = reference.step(Wait()).images
    assert images is not None
    return images


def positions(observation: Observation) -> np.ndarray:
    assert observation.points is not None
    return observation.points.positions


def shift(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """How far the picture moved to the right and down [px]."""
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float64) for image in (one, other)]
    return np.array(cv2.phaseCorrelate(*grey, cv2.createHanningWindow(grey[0].shape[::-1], cv2.CV_64F))[0])


def test_the_reported_tip_is_beside_the_true_one():
    reference = made("tool_bias=0.003")
    lift(reference)
    beside = lift_tip(reference) - reference.truth_frame().tip
    np.testing.assert_allclose(beside, [3e-3, 0, 0], atol=1e-12)


def lift_tip(reference: Reference) -> np.ndarray:
    return reference.step(Wait()).tool.position


def test_the_reported_way_is_longer_than_the_true_one():
    reference = made("tool_scale=1.1")
    lift(reference)
    np.testing.assert_allclose(lift_tip(reference) - CORNER, 1.1 * (reference.truth_frame().tip - CORNER), atol=1e-12)


def test_the_reported_way_is_turned_against_the_true_one():
    reference = made("tool_turn=90")
    lift(reference)
    x, y, z = reference.truth_frame().tip - CORNER
    np.testing.assert_allclose(lift_tip(reference) - CORNER, [z, y, -x], atol=1e-12)


def test_late_senses_show_where_things_were():
    """To the step; the tool moved less than that ago."""
    tips, surfaces = [], []
    reference = made(f"tool_latency={LATE}", f"image_latency={LATE}")
    simulation = reference._simulation

    def note() -> None:
        tips.append(simulation.jaws.tip)
        surfaces.append(simulation.data.qpos.copy())

    simulation.rules.append(note)
    seen = lift(reference)[-1]
    np.testing.assert_array_equal(seen.tool.position, tips[-1 - STEPS])
    simulation.data.qpos[:] = surfaces[-1 - STEPS]
    then = lift_points(reference)
    np.testing.assert_allclose(positions(seen), then, atol=10 * EXACT)
    assert np.abs(tips[-1] - tips[-1 - STEPS]).max() > 1e-3


def test_a_late_tool_is_where_it_closes():
    """It came there before; a jump from where it was parked would be a grasp off the tissue."""
    reference = made("tool_latency=1")
    reference.step(Wait())
    np.testing.assert_array_equal(reference.step(Grasp(point=CORNER, radius=9e-3)).tool.position, CORNER)


def lift_points(reference: Reference) -> np.ndarray:
    """Where the tracked points of the present state are."""
    import mujoco

    mujoco.mj_fwdPosition(reference._simulation.model, reference._simulation.data)
    tracks = reference._observer._tracks
    assert tracks is not None
    return tracks.positions(reference._simulation.surface())


def test_a_misplaced_camera_moves_all_that_it_measures():
    """A pair that stands 2 mm further right finds everything 2 mm further left."""
    right = stereo_camera(SCENE.camera).T_world_camera[:3, 0]
    moved = positions(made("camera_bias").step(Wait())) - positions(made().step(Wait()))
    np.testing.assert_allclose(moved, np.broadcast_to(-2e-3 * right, moved.shape), atol=20 * EXACT)


def test_a_misplaced_camera_sees_another_picture():
    camera = stereo_camera(SCENE.camera)
    pixels = camera.focal[0] * 2e-3 / SCENE.camera.distance
    np.testing.assert_allclose(shift(still().left, still("camera_bias").left), [-pixels, 0], atol=0.15 * pixels)


def test_a_drifting_camera_moves_with_time_and_rolls():
    right, centre = (stereo_camera(SCENE.camera).T_world_camera[:3, column] for column in (0, 3))
    table = [{"name": "camera_drift", "magnitude": 0.01, "roll_deg": 0.0}]
    one, other = (last_of_five(reference) for reference in (made(), made(scene=with_table(table))))
    moved = positions(other) - positions(one)
    np.testing.assert_allclose(moved, np.broadcast_to(-0.01 * other.time * 1e-9 * right, moved.shape), atol=20 * EXACT)
    rolling = made(scene=with_table([{"name": "camera_drift", "magnitude": 0.0, "roll_deg": 5.0}])).step(Wait())
    away = [np.linalg.norm(positions(seen) - centre, axis=1) for seen in (made().step(Wait()), rolling)]
    np.testing.assert_allclose(*away, atol=20 * EXACT)
    assert np.abs(positions(rolling) - positions(made().step(Wait()))).max() > 1e-4


def last_of_five(reference: Reference) -> Observation:
    return [reference.step(Wait()) for _ in range(5)][-1]


def with_table(disturbances: list[dict]) -> Scene:
    found = scene_from_table({"disturbances": disturbances}, name="it").disturbances
    return dataclasses.replace(SCENE, disturbances=found)


def test_a_wrong_baseline_scales_all_distances_from_the_camera():
    centre = stereo_camera(SCENE.camera).T_world_camera[:3, 3]
    plain, scaled = (positions(made(*texts).step(Wait())) - centre for texts in ((), ("depth_scale=1.1",)))
    np.testing.assert_allclose(scaled, 1.1 * plain, atol=20 * EXACT)


def test_a_wrong_baseline_moves_the_right_picture_alone():
    """Disparity becomes so much smaller."""
    camera, scaled = stereo_camera(SCENE.camera), still("depth_scale=1.2")
    disparity = camera.focal[0] * camera.baseline / SCENE.camera.distance
    np.testing.assert_array_equal(scaled.left, still().left)
    assert shift(still().right, scaled.right)[0] == pytest.approx(disparity * (1 - 1 / 1.2), rel=0.2)


def test_lost_frames_are_missing_from_recording_and_truth_alike(tmp_path):
    """Their indices close up, and nothing of them is written."""
    actions = [Wait()] * 40
    with made("frame_drop=0.5") as reference:
        came = [one.index for one in observe(reference, actions, tmp_path / "run.mcap", seed=0)]
    assert 8 < len(came) < 32 and came == list(range(len(came)))
    recorded, truth = Recording.open(tmp_path / "run.mcap"), read_truth(tmp_path / "run.truth.mcap")
    assert [one.index for one in recorded] == came == [frame.index for frame in truth.frames]
    assert [one.time for one in recorded] == [frame.time for frame in truth.frames]


def test_repeated_frames_show_the_frame_before_and_the_new_tool():
    reference = made("frame_repeat=0.5")
    seen = [reference.step(Wait()) for _ in range(30)]
    same = sum(np.array_equal(positions(a), positions(b)) for a, b in pairwise(seen))
    assert 5 < same < 25
    assert len({one.time for one in seen}) == 30


def test_tracked_points_slide_over_the_sheet():
    seen, there = last_of_five(made("point_slip=0.005")), positions(last_of_five(made()))
    inside = np.abs(there[:, 0]) < 0.02
    moved = (positions(seen) - there)[inside, 0]
    np.testing.assert_allclose(moved, 0.005 * seen.time * 1e-9, rtol=0.05)


def test_noise_blur_and_exposure():
    plain = still()
    noise = still("image_noise=12").left.astype(float) - plain.left
    middle = (plain.left > 60) & (plain.left < 190)
    assert noise[middle].std() == pytest.approx(12, rel=0.05)
    assert still("exposure=0.6").right.mean() == pytest.approx(0.6 * plain.right.mean(), rel=0.02)
    np.testing.assert_array_equal(still("exposure=0.6").left, plain.left)
    np.testing.assert_array_equal(still("blur=2").left, cv2.GaussianBlur(plain.left, (0, 0), 2))


def test_smoke_replaces_a_share_of_the_light_and_is_nearer_than_the_tissue():
    plain, hazed = still(), still("haze=0.4")
    share = [(np.asarray(new, float) - old).mean() / (207 - old.mean()) for old, new in pairs(plain, hazed)]
    assert np.mean(share) == pytest.approx(0.4, abs=0.1)
    black = StereoPair(left=np.zeros_like(plain.left), right=np.zeros_like(plain.left))
    with made("haze=0.4", sensing="stereo") as reference:
        reference.step(Wait())
        (smoke,) = reference._observer.faults.images
    alone = smoke(black, np.random.default_rng(0))
    apart = round(alone.left.shape[1] / 16)
    np.testing.assert_array_equal(alone.left[:, apart:], alone.right[:, :-apart])


def pairs(one: StereoPair, other: StereoPair) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(one.left, other.left), (one.right, other.right)]


def lifted(*disturbances: str) -> tuple[np.ndarray, np.ndarray]:
    """The left image before the tool comes, and with a corner lifted, in grey levels."""
    with made(*disturbances, sensing="stereo") as reference:
        frames = [one.images for one in lift(reference)]
    assert frames[0] is not None and frames[-1] is not None
    return frames[0].left.astype(int), frames[-1].left.astype(int)


def test_highlights_brighten_what_is_lifted():
    (_, plain), (_, glossy) = lifted(), lifted("specular=1")
    assert (glossy - plain).max() > 40
    assert (glossy - plain).min() >= 0
    np.testing.assert_array_equal(still("specular=0").left, still().left)


def test_a_highlight_is_elsewhere_in_each_image():
    """With eyes 2 cm apart, what is white in one is mostly not where the tissue of that place is in the other."""
    wide = dataclasses.replace(SCENE, camera=dataclasses.replace(SCENE.camera, baseline=0.02))
    plain, pair = still(scene=wide), still("specular=1", scene=wide)
    shine = [(new.astype(int) - old).min(axis=2) > 30 for old, new in pairs(plain, pair)]
    disparity = round(stereo_camera(wide.camera).focal[0] * wide.camera.baseline / wide.camera.distance)
    left, right = shine[0][:, disparity:], shine[1][:, :-disparity]
    assert left.sum() > 100 and (left & right).sum() < 0.5 * (left | right).sum()


def test_a_thick_tool_hides_more():
    (before, plain), (the_same, hidden) = lifted(), lifted("tool_occlusion=4")
    np.testing.assert_array_equal(before, the_same)
    assert (np.abs(hidden - plain).max(axis=2) > 20).mean() > 0.02


def test_blood_hides_its_share_of_the_sheet():
    plain, bloody = still(), still("dark_patches=0.2")
    tissue = plain.left[..., 0] > plain.left[..., 2].astype(int) + 20
    dark = tissue & (bloody.left.sum(axis=2) < 0.6 * plain.left.sum(axis=2))
    assert dark.sum() / tissue.sum() == pytest.approx(0.2, abs=0.05)


@pytest.mark.parametrize(("name", "needs"), NEEDS.items())
def test_sensing_that_has_nothing_to_disturb_is_refused(name, needs):
    for sensing in {"particles", "cloud"} - set(needs):
        with pytest.raises(SceneError, match=rf"the disturbance {name} needs sensing = "):
            made(name, sensing=sensing)


def test_a_secret_is_in_the_truth_alone(tmp_path, monkeypatch, capsys):
    """Neither the recording, nor a file's name, nor what is printed says what disturbs the scene, or that it is so."""
    for secret in (True, False):
        scene, out = tmp_path / f"hidden{secret}.toml", tmp_path / str(secret)
        scene.write_text(f"secret = {str(secret).lower()}\n{TOML}")
        out.mkdir()
        arguments = ("--sensing", "particles", "--disturb", "substrate=2", "--disturb", "tool_bias")
        assert call(monkeypatch, "record", scene, "--out", out / "run.mcap", *arguments) == 0
        printed = capsys.readouterr()
        said = printed.out + printed.err + " ".join(path.name for path in out.iterdir())
        said += "".join(vars(record).__repr__() for record in iterate_records(out / "run.mcap"))
        said = said.replace(str(tmp_path), "")
        found = [word for word in ("disturb", "substrate", "tool_bias", "secret") if word in said]
        assert found == ([] if secret else ["disturb", "substrate", "tool_bias"])
        details = json.dumps(read_truth(out / "run.truth.mcap").details)
        assert "substrate" in details and "tool_bias" in details
    assert Recording.open(tmp_path / "False" / "run.mcap").metadata["disturbances"] == "substrate=2, tool_bias=0.002"


def test_the_shipped_scenes_are_undisturbed():
    assert load_scene("arc").disturbances == () and not load_scene("arc").secret
    assert math.isclose(sum(one.start for one in disturbed(SCENE, ["gravity", "blur"]).disturbances), 0)


def test_smooth_noise_is_shared_by_neighbours_and_new_in_each_frame():
    """Over many frames the covariance of two points is smooth_sd^2 exp(-d^2 / 2 smooth_length^2)."""
    sd, length, frames = 3e-4, 0.01, 300
    noisy = dataclasses.replace(SCENE, sensing=SensingConfig(point_sd=EXACT, smooth_sd=sd, smooth_length=length))
    reference = Reference(noisy, seed=0, sensing="particles")
    observer = reference._observer
    views = [observer.look() for _ in range(frames)]
    seen = np.array([view[1].positions for view in views if view is not None and view[1] is not None])
    assert views[0][1].sd == pytest.approx(math.hypot(EXACT, sd))
    off = seen - seen.mean(axis=0)
    found = np.einsum("tmi,tni->mn", off, off) / (3 * frames)
    apart = np.linalg.norm(seen[0][:, None, :2] - seen[0][None, :, :2], axis=2)
    np.testing.assert_allclose(found, sd**2 * np.exp(-0.5 * apart**2 / length**2), atol=0.15 * sd**2)
    again = np.einsum("tmi,tmi->", off[1:], off[:-1]) / np.einsum("tmi,tmi->", off, off)
    assert abs(again) < 0.1
