"""The parts of perception against closed forms: mask, disparity, mesh, fields, registration, rectification."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from jiggle_mj.camera import CameraCalibration
from jiggle_mj.errors import PerceptionError
from jiggle_mj.estimator.perception import SemiGlobalMatching, WarmTissue
from jiggle_mj.estimator.perception.config import RegistrationConfig, SheetMeshConfig
from jiggle_mj.estimator.perception.lucas_kanade import normalise, step_in_plane
from jiggle_mj.estimator.perception.material_map import MaterialMap
from jiggle_mj.estimator.perception.mesh_field import MeshField
from jiggle_mj.estimator.perception.rectified import Rectifier
from jiggle_mj.estimator.perception.registration import MaterialRegistration, refine_disparity
from jiggle_mj.estimator.perception.resampling import double, sample_doubled
from jiggle_mj.estimator.perception.sheet_mesh import DisparitySurface, lay_mesh
from jiggle_mj.estimator.perception.tissue_mask import largest_blob
from jiggle_mj.observation import StereoPair
from tests.support.perception_plane import (
    BASELINE,
    DISTANCE,
    FOCAL,
    HALF,
    HEIGHT,
    WIDTH,
    PlaneSheet,
    camera,
    draw,
    stereo,
)

SPACING = 4e-3
TILTED = PlaneSheet(centre=np.array([0.001, 0, 0.012]), across=np.array([0, 0.97, 0.25]))
"""A sheet whose disparity varies by several pixels over the image."""


@pytest.fixture(scope="module")
def flat():
    """Return the flat sheet's pair, tissue and mesh."""
    pair = stereo(PlaneSheet())
    tissue = largest_blob(WarmTissue()(pair.left), smallest=100)
    mesh = lay_mesh(tissue, SemiGlobalMatching(largest=64)(pair.left, pair.right), camera(), spacing=SPACING)
    return pair, tissue, mesh


@pytest.fixture(scope="module")
def fields(flat):
    """Return the material map and the mesh field of the flat sheet."""
    _, tissue, mesh = flat
    return MaterialMap(mesh.uvd[:, :2], mesh.faces, tissue), MeshField(mesh.uvd[:, :2], mesh.faces)


def test_the_mask_is_the_sheet_without_bed_and_tool():
    """The square's projection, one pixel along its outline left open; a grey rod over it is left out."""
    image = draw((PlaneSheet(),), shift=0.0)
    image[140:160, 150:] = 120
    side = 2 * HALF * FOCAL / DISTANCE
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    inside = (abs(u - (WIDTH - 1) / 2) < side / 2) & (abs(v - (HEIGHT - 1) / 2) < side / 2)
    inside[140:160, 150:] = False
    wrong = WarmTissue()(image) != inside
    outline = cv2.morphologyEx(inside.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    corners = 20  # opening rounds them
    assert (wrong & ~outline).sum() < corners


def test_a_grey_image_has_no_tissue():
    """Otsu's threshold splits any image; the smallest redness excludes grey."""
    grey = np.repeat(np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 1), dtype=np.uint8), 3, axis=2)
    assert not WarmTissue()(grey).any()


def test_the_largest_blob_drops_flecks_and_refuses_a_second_sheet():
    mask = np.zeros((100, 100), bool)
    mask[10:60, 10:60], mask[80:84, 80:84] = True, True
    assert largest_blob(mask, smallest=100).sum() == 2500
    mask[65:99, 10:60] = True
    with pytest.raises(PerceptionError, match="two disconnected sheets"):
        largest_blob(mask, smallest=100)
    with pytest.raises(PerceptionError, match="no tissue in view"):
        largest_blob(np.zeros((100, 100), bool), smallest=100)


def test_semi_global_matching_finds_the_plane_and_nothing_in_swapped_images():
    """d = f B / Z within 0.2 px, as it locks to whole pixels; swapped, fewer pass than a sheet needs.

    Measured: a median error of 0.15 px, all pixels matched; swapped, 19 %.
    """
    pair = stereo(TILTED)
    disparity = SemiGlobalMatching(largest=64)(pair.left, pair.right)
    tissue = WarmTissue()(pair.left)
    v, u = np.nonzero(tissue & np.isfinite(disparity))
    assert len(u) > 0.99 * tissue.sum()
    points = camera().back_project(np.stack([u, v, disparity[v, u]], axis=-1).astype(float))
    off_plane = (points - TILTED.centre) @ np.cross(TILTED.along, TILTED.across)
    assert np.median(np.abs(off_plane)) < 0.2 * 0.1**2 / (FOCAL * BASELINE)  # 0.1 m: the tilted sheet's distance
    assert (
        np.isfinite(SemiGlobalMatching(largest=64)(pair.right, pair.left)[tissue]).mean() < SheetMeshConfig.min_matched
    )


def test_triangles_in_two_pieces_are_refused(flat):
    """The contour is one piece, but its neck is one particle wide: triangles on both sides, none across."""
    _, tissue, _ = flat
    neck = tissue.copy()
    neck[:, 170:230] = False
    neck[144:156, 170:230] = True
    with pytest.raises(PerceptionError, match="mesh falls into 2 pieces"):
        lay_mesh(neck, np.full(tissue.shape, 19.0, np.float32), camera(), spacing=SPACING)


def test_the_search_range_follows_from_the_calibration():
    """f B / 30 mm: 420 px x 5 mm / 30 mm = 70, so 80; four times the baseline asks for 280 of 400 px and gets half."""
    assert SemiGlobalMatching.for_camera(camera()).largest == 80
    P = camera().right.P.copy()
    P[0, 3] *= 4
    wide = replace(camera(), right=replace(camera().right, P=P))
    assert SemiGlobalMatching.for_camera(wide).largest == 208


def test_the_mesh_covers_the_sheet_with_good_triangles(flat):
    """As many particles as the area over that of one, sqrt(3)/2 spacing^2, and 6 % more on the border."""
    _, _, mesh = flat
    expected = (2 * HALF) ** 2 / (np.sqrt(3) / 2 * SPACING**2)
    assert 1 < len(mesh.rest) / expected < 1.1
    assert np.sort(np.unique(mesh.faces)).tolist() == list(range(len(mesh.rest)))
    corner = mesh.rest[mesh.faces]
    edge = np.roll(corner, -1, axis=1) - corner
    length = np.linalg.norm(edge, axis=2)
    cosine = -np.einsum("fkd,fkd->fk", edge, np.roll(edge, 1, axis=1)) / (length * np.roll(length, 1, axis=1))
    assert np.degrees(np.arccos(cosine)).min() > 17  # 18 in the fitted plane, before the surface's own tilt
    assert (np.cross(edge[:, 0], edge[:, 1])[:, 2] > 0).all()  # counter-clockwise as seen from the camera above
    inset = SheetMeshConfig.inset * SPACING
    pixel = DISTANCE / FOCAL
    assert np.abs(mesh.rest[:, :2]).max() == pytest.approx(HALF - inset, abs=pixel)


def test_a_plane_is_fitted_with_degree_one_in_spite_of_outliers():
    """The disparity of a plane is affine in the pixel; a tenth of gross mismatches moves it by 0.002 px.

    That is the noise of 0.05 px / sqrt(2000 / 3) of an affine fit without mismatches.
    """
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, 300, (2000, 2))
    truth = 15 + pixels @ (0.01, -0.02)
    measured = truth + 0.05 * rng.standard_normal(2000)
    measured[::10] += 8
    surface = DisparitySurface(pixels, measured)
    assert surface.degree == 1
    assert np.abs(surface(pixels)[:, 2] - truth).max() < 0.004  # twice that


def test_too_little_disparity_is_refused():
    mask = np.ones((100, 100), bool)
    with pytest.raises(PerceptionError, match="positive disparity"):
        lay_mesh(mask, np.full((100, 100), np.nan, np.float32), camera(), spacing=SPACING)


def test_a_sheet_of_few_particles_is_refused(flat):
    pair, tissue, _ = flat
    with pytest.raises(PerceptionError, match="particles at a spacing"):
        lay_mesh(tissue, SemiGlobalMatching(largest=64)(pair.left, pair.right), camera(), spacing=0.02)


def test_two_blobs_joined_by_a_thread_are_refused(flat):
    """The mask is one piece, the contour inside it is not."""
    _, tissue, _ = flat
    cut = tissue.copy()
    cut[:, 170:230] = False
    cut[148:152, 170:230] = True
    disparity = np.full(tissue.shape, 19.0, np.float32)
    with pytest.raises(PerceptionError, match="two disconnected sheets"):
        lay_mesh(cut, disparity, camera(), spacing=SPACING)


def test_spread_reproduces_linear_fields_and_sample_reads_them_back(flat, fields):
    """Barycentric interpolation is exact for f = a + b u + c v, also where triangles are continued."""
    material, _ = fields
    values = 3 + material.at @ np.array([[0.5], [-0.25]])
    dense = material.spread(values)[..., 0]
    v, u = np.nonzero(material.support)
    rounding = 1e-3  # float32 at values near 100
    assert np.abs(dense[v, u] - (3 + 0.5 * u - 0.25 * v)).max() < rounding
    inner = np.abs(flat[2].rest[:, :2]).max(axis=1) < 0.8 * HALF
    assert np.abs(material.sample(dense) - values[:, 0])[inner].max() < 1 / 32 * 0.75 + rounding  # remap's 1/32 px grid


def test_fill_and_derivative_are_exact_for_linear_fields(fields):
    """The umbrella Laplacian of a linear field vanishes on a regular lattice, least-squares gradients are exact."""
    material, field = fields
    values = material.at @ np.array([[1.2, 0.1], [-0.2, 0.9]]) + (30, 40)
    assert np.abs(field.jacobian(values) - [[1.2, -0.2], [0.1, 0.9]]).max() < 1e-9
    known = np.ones(len(values), bool)
    middle = int(np.argmin(np.linalg.norm(material.at - material.at.mean(axis=0), axis=1)))
    known[middle] = False
    filled = field.fill(values, known, stiffness=1e-3)
    edge = 1.2 * SPACING * FOCAL / DISTANCE  # by how much neighbours differ
    assert np.linalg.norm(filled[middle] - values[middle]) < 0.015 * edge  # the lattice is regular to about 1 %


def test_a_mistaken_particle_is_off_its_neighbours_trend(fields):
    """Under any linear motion all are on trend; one that is displaced by 5 px is off by 5 (1 - 1/3) px.

    Least squares over a hexagon of neighbours take 1/3 of the displacement for a derivative.
    """
    material, field = fields
    values = material.at @ np.array([[0.8, 0.3], [-0.3, 1.1]])
    known = np.ones(len(values), bool)
    assert field.off_trend(values, known).max() < 1e-9
    middle = int(np.argmin(np.linalg.norm(material.at - material.at.mean(axis=0), axis=1)))
    values[middle] += (3, 4)
    assert field.off_trend(values, known)[middle] == pytest.approx(
        5 * (1 - 1 / 3), rel=0.01
    )  # the lattice is regular to about 1 %
    assert np.argmax(field.off_trend(values, known)) == middle


def test_resampling_is_exact_for_polynomials_between_pixels():
    """Six-point Lagrange halves are exact to degree five; the linear rest errs by f'' / 8 / 2^2 at most."""
    v, u = np.mgrid[:40, :40].astype(np.float32)
    image = 2 * u - 3 * v + 0.01 * u * u
    columns, rows = (np.random.default_rng(0).uniform(5, 30, (20, 20)).astype(np.float32) for _ in range(2))
    wanted = 2 * columns - 3 * rows + 0.01 * columns**2
    float32_rounding = 5e-4
    assert np.abs(sample_doubled(double(image), columns, rows) - wanted).max() < 0.02 / 8 / 4 + float32_rounding


def test_one_step_finds_a_small_shift(flat, fields):
    """After one step at most a tenth of a shift by (0.3, -0.2) px remains.

    Central differences return sin(w)/w of the derivative of a wave of w rad/px, 0.92 at 0.7 rad/px: a step is 8 % long.
    """
    pair, _, _ = flat
    material, _ = fields
    grey = cv2.GaussianBlur(cv2.cvtColor(pair.left, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.0)
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    moved = sample_doubled(double(grey), u - np.float32(0.3), v + np.float32(0.2))
    config = RegistrationConfig()
    images = [normalise(image[material.region], material.support, config) for image in (grey, moved)]
    step = step_in_plane(*images, material, window=config.fine_window, config=config)
    assert (np.abs(np.median(step.shift, axis=0) - (0.3, -0.2)) < 0.1 * np.array([0.3, 0.2])).all()


def test_registration_recovers_a_homography(flat, fields):
    """A tilted, stretched sheet, started 1.5 px off, with noise of one grey level.

    Inner particles have RMS errors of 0.041 px in the image and of 0.023 px in disparity.
    """
    _, _, mesh = flat
    material, field = fields
    sheet = PlaneSheet(centre=np.array([0, 0, 0.006]), along=np.array([1.04, 0, 0.1]))
    now, rectify = stereo(sheet, seed=1), Rectifier(camera())
    first, second = rectify(stereo(PlaneSheet())), rectify(now)
    flat_rest = mesh.rest * (1, 1, 0)
    truth = camera().project(sheet.deformed(flat_rest))
    start = truth[:, :2] + 1.5 * np.array([0.8, -0.6])
    registration = MaterialRegistration(first.left_grey, material, field)
    found = registration.refine(second.left_fine, WarmTissue()(now.left), start, windows=(8.0, 4.0, 4.0, 4.0))
    inner = np.abs(mesh.rest[:, :2]).max(axis=1) < 0.8 * HALF
    identity = camera().project(flat_rest)[:, :2] - mesh.uvd[:, :2]  # error of the mesh's own depth at rest
    error = np.linalg.norm(found.value - truth[:, :2] + identity, axis=1)[inner]
    assert np.sqrt(np.mean(error**2)) < 0.06
    assert found.match.correlation[inner].min() > 0.99

    masks = WarmTissue()(now.left), WarmTissue()(now.right)
    level = np.full(len(truth), truth[:, 2].mean())
    fine = second.left_fine, second.right_fine
    depth = refine_disparity(*fine, masks, found.value, level, material, field)
    assert np.sqrt(np.mean((depth.value[inner, 0] - truth[inner, 2]) ** 2)) < 0.03


def test_rectifying_undoes_distortion_and_rotation():
    """An image drawn through OpenCV's distortion and a rectifying rotation comes back as the ideal one."""
    ideal = camera()
    K, D = ideal.left.K * np.array([[0.95, 1, 1], [1, 0.95, 1], [1, 1, 1]]), np.array([-0.15, 0.05, 1e-3, -1e-3, 0])
    R, _ = cv2.Rodrigues(np.array([0.01, -0.02, 0.015]))
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    raw = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    where = cv2.undistortPoints(raw, K, D, R=R, P=ideal.left.P[:, :3]).reshape(HEIGHT, WIDTH, 2)
    sides = {
        side: CameraCalibration(width=WIDTH, height=HEIGHT, K=K, D=D, R=R, P=getattr(ideal, side).P)
        for side in ("left", "right")
    }
    raw_pair = StereoPair(
        left=draw((PlaneSheet(),), shift=0.0, pixels=where), right=draw((PlaneSheet(),), shift=BASELINE, pixels=where)
    )
    got = Rectifier(replace(ideal, **sides))(raw_pair)
    inner = np.s_[60:-60, 60:-60]
    for side, shift in (("left", 0.0), ("right", BASELINE)):
        wanted = draw((PlaneSheet(),), shift=shift)
        rim_pixels = 0.02  # the sheet's sharp edge resampled
        assert (np.abs(getattr(got, side)[inner].astype(int) - wanted[inner]) > 8).mean() < rim_pixels


def test_images_of_another_size_than_the_calibration_are_refused():
    with pytest.raises(PerceptionError, match="40x30 px and the calibration is for 400x300"):
        Rectifier(camera())(StereoPair(left=np.zeros((30, 40, 3), np.uint8), right=np.zeros((30, 40, 3), np.uint8)))


def test_settings_out_of_range_are_refused():
    with pytest.raises(ValueError, match="multiple of 16"):
        SemiGlobalMatching(largest=50)
    with pytest.raises(ValueError, match="odd"):
        SemiGlobalMatching(largest=64, block=4)
    with pytest.raises(ValueError, match="redness"):
        WarmTissue(redness=0)
