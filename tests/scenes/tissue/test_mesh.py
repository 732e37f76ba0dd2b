"""The sheet's triangulation and its checks, the shapes of attachments, and tracked points."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jiggle_mj.errors import MeshError, SceneError
from jiggle_mj.scenes.scene.attachments import Arc, Attachment, Disc, Polygon, Segment, owners, vertex_values
from jiggle_mj.scenes.sensing.points import INSIDE_TOLERANCE, material_tracks, vertex_tracks
from jiggle_mj.scenes.tissue.mesh import build_sheet, check_sheet, triangle_areas

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


@settings(max_examples=25, deadline=None)
@given(
    width=st.floats(0.03, 0.2),
    height=st.floats(0.03, 0.2),
    kind=st.sampled_from(["equilateral", "unstructured"]),
    seed=st.integers(0, 2**32 - 1),
)
def test_triangles_tile_the_rectangle_whatever_its_size(width, height, kind, seed):
    """sum of areas = width * height, every triangle counter-clockwise; `build_sheet` itself runs `check_sheet`."""
    sheet = build_sheet(size=(width, height), spacing=5e-3, kind=kind, seed=seed)
    areas = triangle_areas(sheet.vertices, sheet.faces)
    assert areas.min() > 0
    assert areas.sum() == pytest.approx(width * height, rel=1e-9)
    assert sheet.vertex_areas().sum() == pytest.approx(width * height, rel=1e-9)


def test_the_median_edge_is_the_spacing():
    """Within 10 %: rows and columns are rounded to fit the sheet, and the unstructured mesh is jittered."""
    for kind in ("equilateral", "unstructured"):
        sheet = build_sheet(size=(0.1, 0.1), spacing=4.5e-3, kind=kind, seed=3)
        edges = np.linalg.norm(sheet.vertices[sheet.faces] - sheet.vertices[np.roll(sheet.faces, 1, axis=1)], axis=2)
        assert np.median(edges) == pytest.approx(4.5e-3, rel=0.1)


def test_the_seed_draws_the_unstructured_mesh():
    def draw(seed):
        return build_sheet(size=(0.1, 0.1), spacing=5e-3, kind="unstructured", seed=seed)

    assert draw(1).vertices.tobytes() == draw(1).vertices.tobytes()
    assert np.abs(draw(1).vertices - draw(2).vertices).max() > 1e-4


@pytest.mark.parametrize(
    ("faces", "words"),
    [
        ([[0, 1, 2], [0, 3, 2]], "inverted"),
        ([[0, 2, 1], [0, 3, 2]], "inverted"),
        ([[0, 1, 1], [0, 2, 3]], "degenerate"),
        ([[0, 1, 2], [0, 2, 4]], r"0\.\.3"),
        ([[0, 1, 2]], "belongs to no triangle"),
    ],
)
def test_a_bad_square_is_refused(faces, words):
    with pytest.raises(MeshError, match=words):
        check_sheet(SQUARE, np.array(faces))


def test_a_needle_is_refused():
    with pytest.raises(MeshError, match="degenerate"):
        check_sheet(np.array([[0.0, 0.0], [1.0, 0.0], [0.5, 0.01]]), np.array([[0, 1, 2]]))


def test_two_disconnected_sheets_are_refused():
    vertices = np.concatenate([SQUARE, SQUARE + 5])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    with pytest.raises(MeshError, match="2 disconnected sheets"):
        check_sheet(vertices, faces)


def vertex_stiffness(shapes: tuple[Attachment, ...]) -> np.ndarray:
    return vertex_values(shapes, owners(shapes, PLACES), "stiffness")


PLACES = np.array([[0.0, 0.0], [0.02, 0.0], [0.0, 0.02], [-0.02, 0.0], [0.03, 0.004]])


@pytest.mark.parametrize(
    ("shape", "distances"),
    [
        (
            Segment(start=(0.0, 0.0), end=(0.02, 0.0), width=0.01, stiffness=1.0),
            [0, 0, 0.02, 0.02, math.hypot(0.01, 0.004)],
        ),
        (
            Arc(centre=(0.0, 0.0), radius=0.02, start_deg=0.0, end_deg=90.0, width=0.01, stiffness=1.0),
            [0.02, 0, 0, math.hypot(0.02, 0.02), math.hypot(0.03, 0.004) - 0.02],
        ),
        (Disc(centre=(0.0, 0.0), radius=0.01, stiffness=1.0), [0, 0.01, 0.01, 0.01, math.hypot(0.03, 0.004) - 0.01]),
        (
            Polygon(points=((-0.01, -0.01), (0.01, -0.01), (0.01, 0.01), (-0.01, 0.01)), stiffness=1.0),
            [0, 0.01, 0.01, 0.01, 0.02],
        ),
    ],
)
def test_distances_to_shapes_are_geometric(shape, distances):
    """Up to rounding."""
    assert shape.distance(PLACES) == pytest.approx(np.array(distances), abs=1e-12)


def test_shapes_unite_and_free_vertices_stay_free():
    shapes = tuple(Disc(centre=(x, 0.0), radius=0.001, stiffness=k) for x, k in ((0.0, 2.0), (0.02, math.inf)))
    assert vertex_stiffness(shapes).tolist() == [2.0, math.inf, 0.0, 0.0, 0.0]


def test_shapes_that_contradict_each_other_are_refused():
    """The message names the value: two stiffnesses, a weld and a spring, two slacks."""
    for first, second, message in (
        ({"stiffness": 2.0}, {"stiffness": 3.0}, r"stiffness = 2\.0 and stiffness = 3\.0"),
        ({"stiffness": 2.0}, {"stiffness": math.inf}, r"stiffness = 2\.0 and a weld"),
        ({"stiffness": 2.0}, {"stiffness": 2.0, "slack": 1e-3}, r"slack = 0\.0 and slack = 0\.001"),
    ):
        shapes = tuple(Disc(centre=(0.0, 0.0), radius=0.001, **law) for law in (first, second))
        with pytest.raises(SceneError, match=rf"attachments\[0\] and attachments\[1\] contradict .*: {message}"):
            vertex_stiffness(shapes)


@pytest.mark.parametrize("key", ["hardening", "slack", "yields_at", "creep"])
def test_a_weld_has_no_value_of_a_spring(key):
    with pytest.raises(SceneError, match=rf"attachments\.{key} of a weld"):
        Disc(centre=(0.0, 0.0), radius=0.001, stiffness=math.inf, **{key: 1e-3})


def test_a_shape_off_the_sheet_is_refused():
    with pytest.raises(SceneError, match=r"attachments\[0\] \(disc\) holds no vertex"):
        owners((Disc(centre=(1.0, 1.0), radius=0.001, stiffness=1.0),), PLACES)


def test_material_points_follow_an_affine_motion_and_are_no_vertices():
    """Barycentric points obey p' = A p + t, up to rounding, when the vertices do.

    About the number asked for (the sheet's outline cuts the lattice), over 1 mm from vertices in the median, and spread
    uniformly: the lattice of 600 points has a spacing of 4.4 mm before its jitter.
    """
    sheet = build_sheet(size=(0.1, 0.1), spacing=5e-3, kind="unstructured", seed=0)
    tracks = material_tracks(sheet, n_points=600, rng=np.random.default_rng(0))
    flat = np.column_stack([sheet.vertices, np.zeros(len(sheet.vertices))])
    rest = tracks.positions(flat)
    A, t = np.random.default_rng(1).standard_normal((3, 3)), np.array([1.0, 2.0, 3.0])
    assert tracks.positions(flat @ A.T + t) == pytest.approx(rest @ A.T + t, abs=1e-12)
    assert 500 <= len(rest) <= 700
    assert tracks.weights.min() >= -INSIDE_TOLERANCE
    nearest = np.linalg.norm(rest[:, None] - flat, axis=2).min(axis=1)
    assert np.median(nearest) > 1e-3
    spacing = np.sort(np.linalg.norm(rest[:, None] - rest, axis=2), axis=1)[:, 1]
    assert 2e-3 < np.median(spacing) < 6e-3


def test_particle_tracks_are_every_vertex_once_in_an_order_that_hides_the_mesh():
    """A random order of 500 vertices has a correlation with the mesh's order of 0 +- 0.045; 0.2 is over 4 of them."""
    sheet = build_sheet(size=(0.1, 0.1), spacing=5e-3, kind="equilateral", seed=0)
    order = vertex_tracks(sheet, rng=np.random.default_rng(0)).corners[:, 0]
    assert sorted(order) == list(range(len(sheet.vertices)))
    assert abs(np.corrcoef(order, np.arange(len(order)))[0, 1]) < 0.2
