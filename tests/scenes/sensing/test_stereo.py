"""The stereo pair: rendered positions against the calibration, and the contents of images."""

import dataclasses
import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest

from jiggle_mj.actions import Grasp, Move, Release, Wait
from jiggle_mj.errors import RenderError
from jiggle_mj.scenes import Reference, Scene, load_scene
from jiggle_mj.scenes.scene.scene import CameraConfig, SensingConfig, TextureConfig
from jiggle_mj.scenes.sensing.stereo import StereoRenderer
from jiggle_mj.scenes.tissue.cameras import add_cameras, stereo_camera
from jiggle_mj.scenes.tissue.texture import bed_texture, tissue_texture

MARKER_RADIUS = 2.5e-3
"""Radius of the marker [m]: about nine pixels, so that a centroid averages the sampling of its edge to a few
hundredths of a pixel."""
OFF_CENTRE = 0.15
"""Largest error of a centroid [px]: 0.05 for sampling, and 0.1 because a ball's outline is an ellipse whose centre
differs from the projection of the ball's centre by up to f * (R/z)^2 * tan(angle) = 0.1 px at the field's edge."""


@pytest.mark.render
@pytest.mark.parametrize(
    "camera",
    [CameraConfig(), CameraConfig(tilt_deg=0.0, fov_deg=35.0), CameraConfig(tilt_deg=-30.0, baseline=8e-3, width=500)],
)
def test_a_marker_is_drawn_where_the_calibration_projects_it(camera):
    """The centroid of a small ball is the projection of its centre: left u and v, and disparity u_left - u_right."""
    places = np.array([[x, y, z] for x in (-0.03, 0.0, 0.035) for y in (-0.025, 0.02) for z in (0.0, 0.03)])
    calibration = stereo_camera(camera)
    for place in places:
        spec = mujoco.MjSpec()
        spec.visual.quality.offsamples = 0
        spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [1, 1, 1], [0, 0, 0]
        spec.stat.extent, spec.visual.map.znear = 0.2, 0.05
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=place, size=[MARKER_RADIUS, 0, 0])
        add_cameras(spec, camera)
        model = spec.compile()
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        renderer = StereoRenderer(model, camera)
        pair = renderer.render(data)
        renderer.close()
        centroid = [np.argwhere(image.max(axis=2) > 40).mean(axis=0)[::-1] for image in (pair.left, pair.right)]
        u, v, disparity = calibration.project(place)
        assert centroid[0] == pytest.approx([u, v], abs=OFF_CENTRE)
        assert centroid[0][0] - centroid[1][0] == pytest.approx(disparity, abs=OFF_CENTRE)
        assert centroid[1][1] == pytest.approx(v, abs=OFF_CENTRE)


@pytest.fixture(scope="module")
def arc() -> Scene:
    scene = load_scene("arc")
    coarse = dataclasses.replace(scene.tissue, spacing=8e-3)
    return dataclasses.replace(
        scene, tissue=coarse, texture=TextureConfig(resolution=512), sensing=SensingConfig(image_sd=0.0)
    )


@pytest.mark.render
def test_the_sheets_corners_project_onto_the_rendered_ones(arc):
    """Truth is the visible surface: its corners project within 1 px of the corners of the reddish pixels."""
    with Reference(arc, seed=0, sensing="stereo") as reference:
        left = reference.step(Wait()).images.left.astype(int)
        rows, columns = np.nonzero(left[..., 0] > left[..., 2] + 8)
        rest = reference.truth().rest
        corners = rest[[np.argmax(a * rest[:, 0] + b * rest[:, 1]) for a in (-1, 1) for b in (-1, 1)]]
        projected = reference.camera.project(corners)
    for (u, v, _), (a, b) in zip(projected, [(a, b) for a in (-1, 1) for b in (-1, 1)], strict=True):
        best = np.argmax(a * columns - b * rows)
        assert abs(columns[best] - u) < 1.0 and abs(rows[best] - v) < 1.0


@pytest.mark.render
def test_the_lifted_sheet_stays_in_view_and_its_colour_separates_it_from_bed_and_tool(arc):
    """99 % of the vertices are in the image, and 95 % of those away from the edge are on reddish pixels.

    The tool hides a few; the sheet fills less than 60 % of the image.
    """
    with Reference(arc, seed=0, sensing="stereo") as reference:
        for corner in ([-0.047, -0.047, 4e-4], [0.047, 0.047, 4e-4]):
            point = np.array(corner)
            reference.step(Grasp(point=point, radius=7e-3))
            top = np.array([0.9 * point[0], 0.9 * point[1], 0.042])
            image = reference.step(Move(to=top)).images.left.astype(int)
            uvd = reference.camera.project(reference.truth_frame().positions)
            inside = (uvd[:, :2] >= 0).all(axis=1) & (uvd[:, 0] <= 639) & (uvd[:, 1] <= 479)
            assert inside.mean() > 0.99
            red = image[..., 0] > image[..., 2] + 8
            inner = np.abs(reference.truth().rest[:, :2]).max(axis=1) < 0.046
            pixels = np.round(uvd[inside & inner, :2]).astype(int)
            assert red[pixels[:, 1], pixels[:, 0]].mean() > 0.95
            assert red.mean() < 0.6
            reference.step(Move(to=point))
            reference.step(Release())


@pytest.mark.render
def test_image_noise_has_the_declared_sd_and_the_same_seed_gives_the_same_image(arc):
    """The difference of two still frames has variance 2 sd^2, plus 1/6 for two roundings, without clipped channels.

    Within 2 %: the tissue still creeps by 1 um per frame, which changes a few pixels on edges.
    """
    noisy = dataclasses.replace(arc, sensing=SensingConfig(image_sd=2.0))

    def frames(seed: int) -> list[np.ndarray]:
        with Reference(noisy, seed=seed, sensing="stereo") as reference:
            return [reference.step(Wait()).images.left for _ in range(2)]

    first, repeated, another = frames(5), frames(5), frames(6)
    assert first[0].tobytes() == repeated[0].tobytes()
    assert first[0].tobytes() != another[0].tobytes()
    a, b = (frame.astype(float) for frame in first)
    unclipped = (a > 15) & (a < 240) & (b > 15) & (b < 240)
    assert np.var((a - b)[unclipped]) == pytest.approx(2 * 2.0**2 + 1 / 6, rel=0.02)


def test_textures_come_from_their_seed_and_differ_in_colour():
    """Tissue is redder than blue by 30 grey levels and more, the bed is bluer than red."""
    tissue, bed = (draw(seed=1, resolution=128, contrast=1.0) for draw in (tissue_texture, bed_texture))
    assert np.array_equal(tissue, tissue_texture(seed=1, resolution=128, contrast=1.0))
    assert not np.array_equal(tissue, tissue_texture(seed=2, resolution=128, contrast=1.0))
    assert tissue[..., 0].mean() > tissue[..., 2].mean() + 30
    assert bed[..., 0].mean() < bed[..., 2].mean()
    assert tissue_texture(seed=1, resolution=128, contrast=0.0).std(axis=(0, 1)).max() == 0


def test_a_machine_without_opengl_still_simulates_and_names_what_to_install(tmp_path):
    """A broken OpenGL package replaces missing libraries: particles work, stereo is refused with the remedy."""
    (tmp_path / "OpenGL").mkdir()
    (tmp_path / "OpenGL" / "__init__.py").write_text("raise ImportError('libEGL.so.1 not found')\n")
    code = """
import dataclasses
from jiggle_mj.errors import RenderError
from jiggle_mj.actions import Wait
from jiggle_mj.scenes import Reference, Scene
from jiggle_mj.scenes.scene.scene import TissueConfig
scene = Scene(name="small", tissue=TissueConfig(size=(0.04, 0.04), spacing=8e-3))
assert Reference(scene, seed=0, sensing="particles").step(Wait()).points is not None
try:
    Reference(scene, seed=0, sensing="stereo")
except RenderError as error:
    print(error)
"""
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "MUJOCO_GL": "egl"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\n") == 1
    assert done.stdout.startswith("No offscreen OpenGL: MUJOCO_GL=egl failed (")
    assert "libEGL.so.1 not found). Install libegl1" in done.stdout and "jiggle-mj doctor" in done.stdout


def test_a_context_that_cannot_be_made_is_a_render_error(monkeypatch):
    def fail(*_: object) -> None:
        raise RuntimeError("no EGL device")

    monkeypatch.setattr(mujoco, "Renderer", fail)
    with pytest.raises(RenderError, match=r"No offscreen OpenGL: MUJOCO_GL=\w+ failed \(no EGL device\)"):
        StereoRenderer(mujoco.MjModel.from_xml_string("<mujoco/>"), CameraConfig())


def test_mujoco_imported_too_early_is_named_as_the_cause():
    code = """
import mujoco
import jiggle_mj as jm
try:
    jm.Reference(jm.load_scene("arc"), seed=0, sensing="stereo")
except jm.RenderError as error:
    print(error)
"""
    environment = {name: value for name, value in os.environ.items() if name != "DISPLAY"}
    environment["MUJOCO_GL"] = ""  # counts as not set
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120)
    assert "mujoco was imported before jiggle_mj" in done.stdout, done.stderr
