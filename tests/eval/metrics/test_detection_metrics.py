"""Detection figures, the transfer of truth and the tracking error, each against an example worked by hand."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jiggle_mj.estimate import Estimate, Sheet
from jiggle_mj.eval.metrics.detection_metrics import agreement, average_precision, dilate, distances, patches
from jiggle_mj.eval.metrics.safety import attachment_loads
from jiggle_mj.eval.metrics.tracking import tracking
from jiggle_mj.eval.metrics.truth_transfer import barycentric_weights, transfer
from jiggle_mj.truth import Truth, TruthFrame

ROUNDING = 1e-12
"""Rounding of sums and products of numbers of order one."""
STRIP = np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4], [4, 5, 6], [5, 7, 6], [6, 7, 8], [7, 9, 8]])
"""A strip of eight triangles over vertices 0..9: vertex i has the neighbours i-2, i-1, i+1, i+2."""


def chosen(*vertices: int, n: int = 10) -> np.ndarray:
    mask = np.zeros(n, dtype=bool)
    mask[list(vertices)] = True
    return mask


def lattice(n: int, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """An n x n square grid, each square cut in two."""
    x, y = np.meshgrid(np.arange(n) * spacing, np.arange(n) * spacing, indexing="ij")
    rest = np.stack([x.ravel(), y.ravel(), np.zeros(n * n)], axis=1)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + n, corner + 1], 1), np.stack([corner + n, corner + n + 1, corner + 1], 1)]
    )
    return rest, faces


def truth_of(rest, faces, stiffness, positions=None) -> Truth:
    frame = TruthFrame(
        index=0,
        time=0,
        positions=rest if positions is None else positions,
        stiffness=np.asarray(stiffness, float),
        tip=np.zeros(3),
    )
    attached = np.isnan(frame.stiffness) | (frame.stiffness > 0)
    return Truth(rest=rest, faces=faces, attached=attached, frames=(frame,), scene="by hand", details={})


def estimate_of(positions, observed) -> Estimate:
    n = len(positions)
    return Estimate(
        index=0,
        time=0,
        positions=positions,
        observed=observed,
        mean=np.zeros(n),
        sd=np.ones(n),
        probability=np.full(n, np.nan),
        held=np.zeros(n, dtype=bool),
        entropy=0.0,
        nis=1.0,
        boundary_energy=0.0,
        update_s=0.1,
        perception_s=0.1,
    )


def test_pcd_pug_and_f1_agree_with_counting_by_hand():
    """D = {0, 1, 4}, T = {1, 2, 9} on the strip.

    Exact: one hit, so PCD = PUG = F1 = 1/3. One ring: the truth grows to {0,1,2,3,4} + {7,8,9}, which holds all of D,
    PCD = 1; the estimate grows to {0..6}, which holds 1 and 2 but not 9, PUG = 2/3, F1 = 2 (2/3) / (5/3) = 4/5.
    """
    detected, attached = chosen(0, 1, 4), chosen(1, 2, 9)
    exact, ring = (agreement(detected, attached, STRIP, rings) for rings in (0, 1))
    assert (exact.pcd, exact.pug, exact.f1) == pytest.approx((1 / 3, 1 / 3, 1 / 3))
    assert (ring.pcd, ring.pug, ring.f1) == pytest.approx((1, 2 / 3, 4 / 5))


def test_each_set_is_dilated_only_where_the_paper_dilates_it():
    """D = {0}, T = {2, 9}: at one ring PCD = 1 (2 reaches 0) and PUG = 1/2 (0 reaches 2, not 9); at two the same."""
    for rings in (1, 2):
        one = agreement(chosen(0), chosen(2, 9), STRIP, rings)
        assert (one.pcd, one.pug) == (1, 0.5)


@pytest.mark.parametrize(
    ("detected", "attached", "pcd", "pug", "f1"),
    [((), (), None, None, None), ((3,), (), 0.0, None, 0.0), ((), (3,), None, 0.0, 0.0), ((0,), (9,), 0.0, 0.0, 0.0)],
)
def test_what_is_undefined_is_none(detected, attached, pcd, pug, f1):
    """0/0 is no figure: a tissue without attachments has no recall, silence has no precision."""
    one = agreement(chosen(*detected), chosen(*attached), STRIP, 0)
    assert (one.pcd, one.pug, one.f1) == (pcd, pug, f1)


def test_the_gate_drops_uncertain_particles_from_both_counts_but_never_thins_the_truth():
    """D = {0, 1, 4}, T = {1, 2, 9}, uncertain {2, 4}: D -> {0, 1}, T for recall -> {1, 9}.

    Exact PCD 1/2, PUG 1/2. At one ring PCD is 2/2, and still 1 if T were only {2} and 2 were gated away.
    """
    certain = ~chosen(2, 4)
    exact = agreement(chosen(0, 1, 4), chosen(1, 2, 9), STRIP, 0, certain=certain)
    assert (exact.pcd, exact.pug) == (0.5, 0.5)
    assert agreement(chosen(0, 1, 4), chosen(2), STRIP, 1, certain=certain).pcd == 1


def test_average_precision_agrees_with_the_sum_by_hand():
    """Ranked hit, miss, hit: AP = 1/2 * 1 + 1/2 * 2/3 = 5/6; all scores equal: AP is the base rate, 2/3."""
    attached = np.array([True, False, True])
    assert average_precision(np.array([3.0, 2.0, 1.0]), attached) == pytest.approx(5 / 6)
    assert average_precision(np.ones(3), attached) == pytest.approx(2 / 3)
    assert average_precision(np.ones(3), np.zeros(3, bool)) is None


def test_distances_go_to_the_nearest_target():
    """From (0,0) and (4,0) to {(0,3), (4,1)}: 3 and 1, mean 2, 95th percentile 1 + 0.95 * 2 = 2.9."""
    origin, target = np.array([[0.0, 0, 0], [4, 0, 0]]), np.array([[0.0, 3, 0], [4, 1, 0]])
    one = distances(origin, target)
    assert (one.mean, one.percentile_95) == pytest.approx((2, 2.9))
    assert distances(origin, target[:0]).mean is None


def test_patches_are_the_connected_groups_largest_first():
    assert [group.tolist() for group in patches(chosen(0, 4, 5, 6, 9), STRIP)] == [[4, 5, 6], [0], [9]]
    assert patches(chosen(), STRIP) == []


sets = st.lists(st.booleans(), min_size=10, max_size=10).map(lambda each: np.array(each, dtype=bool))


@settings(deadline=None)  # the claim is not about time
@given(detected=sets, attached=sets)
def test_dilation_never_lowers_a_figure(detected, attached):
    """dilate(T) contains T, so PCD and PUG are non-decreasing in the number of rings."""
    figures = [agreement(detected, attached, STRIP, rings) for rings in range(3)]
    for before, after in itertools.pairwise(figures):
        for name in ("pcd", "pug", "f1"):
            low, high = getattr(before, name), getattr(after, name)
            assert (low is None) == (high is None)
            assert low is None or high >= low


@settings(deadline=None)  # the claim is not about time
@given(detected=sets, attached=sets, order=st.permutations(range(10)), rings=st.integers(0, 2))
def test_renumbering_the_vertices_changes_nothing(detected, attached, order, rings):
    """Figures depend on the sets and the graph, not on the numbering."""
    order = np.array(order)
    place = np.argsort(order)
    assert agreement(detected, attached, STRIP, rings) == agreement(
        detected[order], attached[order], place[STRIP], rings
    )
    score = detected.astype(float)
    assert average_precision(score, attached) == average_precision(score[order], attached[order])


@settings(deadline=None)  # the claim is not about time
@given(one=sets)
def test_dilation_by_two_is_dilation_twice(one):
    np.testing.assert_array_equal(dilate(one, STRIP, 2), dilate(dilate(one, STRIP, 1), STRIP, 1))


def test_truth_is_unchanged_on_the_same_mesh():
    rest, faces = lattice(4, 0.01)
    stiffness = np.where(rest[:, 0] == 0, 0.7, 0.0)
    transferred = transfer(Sheet(rest=rest, faces=faces), truth_of(rest, faces, stiffness), 0)
    np.testing.assert_array_equal(transferred.attached, stiffness > 0)
    np.testing.assert_allclose(transferred.stiffness, stiffness, atol=ROUNDING)


def test_springs_keep_their_total_and_their_centre_on_any_mesh():
    """A patch's total and first moment; the nearest vertex would give a border particle all or nothing."""
    fine, coarse = lattice(13, 0.01), lattice(7, 0.017)
    stiffness = np.where(np.linalg.norm(fine[0][:, :2] - 0.05, axis=1) < 0.023, 0.7, 0.0)
    transferred = transfer(Sheet(rest=coarse[0], faces=coarse[1]), truth_of(*fine, stiffness), 0)
    assert transferred.stiffness.sum() == pytest.approx(stiffness.sum(), rel=ROUNDING)
    np.testing.assert_allclose(transferred.stiffness @ coarse[0], stiffness @ fine[0], rtol=ROUNDING)


def test_a_spring_pulls_at_the_corners_of_the_triangle_that_it_is_in():
    """At (0.2, 0.3) in the unit triangle with corners at (0, 0), (1, 0) and (0, 1): 0.5, 0.2 and 0.3 of it. What lies
    further away than an edge is long is of another part of the tissue."""
    sheet = Sheet(rest=np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), faces=np.array([[0, 1, 2]]))
    rest = np.array([[0.2, 0.3, 0], [0, 0, 0], [0, 1, 0], [-1.5, 0, 0]])
    transferred = transfer(sheet, truth_of(rest, np.array([[0, 1, 2]]), [10.0, 0, 0, 99.0]), 0)
    np.testing.assert_allclose(transferred.stiffness, [5, 2, 3])
    assert transferred.attached.tolist() == [False, True, False]


def test_loads_add_up_in_squares_until_the_frame():
    """3 mN in one frame and 4 mN in the next are 5 mN, on the same mesh; later frames do not count."""
    rest, faces = lattice(2, 0.01)
    frames = tuple(
        TruthFrame(
            index=k, time=k, positions=rest, stiffness=np.ones(4), tip=np.zeros(3), load=np.array([load, 0, 0, 0])
        )
        for k, load in enumerate((3e-3, 4e-3, 1.0))
    )
    truth = Truth(rest=rest, faces=faces, attached=np.ones(4, bool), frames=frames, scene="", details={})
    transferred = transfer(Sheet(rest=rest, faces=faces), truth, 1)
    np.testing.assert_allclose(transferred.load, [5e-3, 0, 0, 0])
    assert transferred.observable is not None and transferred.observable.tolist() == [True, False, False, False]
    assert transfer(Sheet(rest=rest, faces=faces), truth_of(rest, faces, np.ones(4)), 0).observable is None


def test_only_the_observable_part_of_the_truth_has_to_be_found():
    """A report inside the rest is no mistake."""
    attached, observable, detected = (chosen(*ids) for ids in ((0, 1, 2), (0,), (0, 1, 5)))
    one = agreement(detected, attached, STRIP, 0, observable=observable)
    assert one.pcd == pytest.approx(2 / 3) and one.pug == 1


def test_welds_unknown_amounts_and_cuts_are_transferred_as_such():
    """A weld stays infinite, NaN stays attached, and a vertex cut since the start is free."""
    rest, faces = lattice(2, 0.01)
    truth = truth_of(rest, faces, [np.inf, np.nan, 0.0, 0.4])
    cut = TruthFrame(index=5, time=5, positions=rest, stiffness=np.array([np.inf, np.nan, 0, 0]), tip=np.zeros(3))
    truth = Truth(rest=rest, faces=faces, attached=truth.attached, frames=(*truth.frames, cut), scene="", details={})
    sheet = Sheet(rest=rest, faces=faces)
    assert transfer(sheet, truth, 4).attached.tolist() == [True, True, False, True]
    late = transfer(sheet, truth, 7)
    assert late.attached.tolist() == [True, True, False, False]
    assert np.isinf(late.stiffness[0]) and np.isnan(late.stiffness[1]) and not late.stiffness[2:].any()


def test_barycentric_weights_give_the_nearest_point_of_the_mesh():
    """(0.2, 0.3, 1) over the unit triangle projects to weights (0.5, 0.2, 0.3); (2, 0, 0) to its second corner."""
    vertices, faces = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])
    corners, weights = barycentric_weights(np.array([[0.2, 0.3, 1], [2, 0, 0]]), vertices, faces)
    assert corners.tolist() == [[0, 1, 2]] * 2
    np.testing.assert_allclose(weights, [[0.5, 0.2, 0.3], [0, 1, 0]], atol=ROUNDING)


def test_tracking_rms_is_over_seen_particles_at_interpolated_truth():
    """The reference moves by z = x; a particle at x = 0.25 is truly at z = 0.25 though no vertex is there.

    Measured errors 3 mm and 4 mm over the two seen: sqrt((9 + 16)/2) mm; the third is not seen.
    """
    rest, faces = lattice(2, 1.0)
    moved = rest + [0, 0, 1] * rest[:, [0]]
    particles = np.array([[0.25, 0.25, 0.0], [0.5, 0.1, 0.0], [0.9, 0.9, 0.0]])
    true = particles + [0, 0, 1] * particles[:, [0]]
    observed = true + np.array([[0.003, 0, 0], [0, 0, 0.004], [np.nan] * 3])
    sheet = Sheet(rest=particles, faces=np.array([[0, 1, 2]]))
    one = tracking(
        sheet, [estimate_of(true + np.array([0, 0.001, 0]), observed)], truth_of(rest, faces, np.zeros(4), moved)
    )
    assert one.rms == pytest.approx(np.sqrt(12.5e-6))
    assert one.rms_estimate == pytest.approx(0.001)
    assert one.per_frame == pytest.approx([one.rms])


def test_boundary_energy_is_the_mean_over_all_vertices():
    """Two of four vertices at 2 N/m moved by 10 mm: 2 * 1/2 * 2 * 1e-4 J over 4 vertices = 5e-5 J; a weld adds none."""
    rest, faces = lattice(2, 1.0)
    moved = rest + np.array([0, 0, 0.01])
    assert attachment_loads(truth_of(rest, faces, [2, 2, 0, 0], moved)).most == (pytest.approx(5e-5), None)
    assert attachment_loads(truth_of(rest, faces, [2, 2, np.inf, 0], moved)).most == (pytest.approx(5e-5), None)
    assert attachment_loads(truth_of(rest, faces, [np.nan, 0, 0, 0], moved)).most == (None, None)
    assert attachment_loads(truth_of(rest, faces, [0, 0, 0, 0], moved)).most == (0, None)
