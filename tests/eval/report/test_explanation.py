"""What the evidence rests on, in words, by hand."""

import numpy as np

from jiggle_mj.eval.report.explanation import explanation_figure, explanation_sentence, half_of, phases

REST = np.arange(11)[:, None] * np.array([1e-3, 0.0, 0.0])
PARTICLES = {"rest_m": REST.tolist(), "held": [True, *[False] * 10], "attached": [False] * 11}
OUT_AND_BACK = [
    {"index": k, "grasp": grasp, "time_s": float(k), "displacement_m": displacement, "nat": nat}
    for k, (grasp, displacement, nat) in enumerate(
        [(1, 0.0, 0.0), (1, 0.02, 1.0), (2, 0.01, 5.0), (2, 0.02, 60.0), (2, 0.0195, 30.0), (2, 0.01, -6.0)]
    )
]
ONE = {"effects": ["gravity"], "log_bayes_factor": 85.4, "frames": OUT_AND_BACK, "shared_nat": 0.0, "grasps_nat": -3.0}


def test_half_of_a_sum_is_reached_with_the_fewest_parts():
    assert half_of(np.array([5.0, 1.0, -1.0, 3.0])) == [0]
    assert half_of(np.array([2.0, 2.0, 1.0, 2.0])) == [0, 1]
    assert half_of(np.array([10.0, -9.0])) == [0]


def test_the_tool_goes_out_holds_and_comes_back_in_each_grasp():
    assert phases(OUT_AND_BACK) == ["holds", "goes out", "goes out", "goes out", "holds", "comes back"]


def test_the_sentence_names_the_frames_and_particles_with_half_of_the_evidence():
    """Frames give 90 nat, of which frame 3 has 60; particles 1 and 2, 1 and 2 mm from the grip, have 60 of 90."""
    found = explanation_sentence(ONE | {"particles_nat": [0, 30, 30, 4, 4, 4, 4, 4, 4, 3, 3]}, PARTICLES)
    assert found == (
        "gravity leads what is declared by 85 nat. The frames give 90 nat, what grasps share -3. Half of the frames' "
        "share rests on 1 of 6 while the tool goes out in grasp 2, and on 2 of 11 particles near what is held (half of "
        "them within 2 mm, of all particles within 5 mm)."
    )


def test_particles_that_are_everywhere_are_near_nothing():
    found = explanation_sentence(ONE | {"particles_nat": [9] * 11}, PARTICLES | {"held": [False] * 11})
    assert found.endswith("and on 6 of 11 particles.")
    most = {"held": [False] * 11, "attached": [True] * 8 + [False] * 3}
    found = explanation_sentence(ONE | {"particles_nat": [9] * 11}, PARTICLES | most)
    assert found.endswith("and on 6 of 11 particles.")


def test_frames_that_speak_against_a_hypothesis_are_not_what_it_rests_on():
    frames = [frame | {"nat": -1.0} for frame in OUT_AND_BACK]
    found = explanation_sentence(ONE | {"log_bayes_factor": -4.0, "frames": frames}, PARTICLES)
    assert found.startswith("gravity trails what is declared by 4 nat. The frames give -6 nat")
    assert found.endswith("it does not rest on frames.")


def test_the_pictures_have_each_frame_and_particle():
    nat = [0, 30, 30, 4, 4, 4, 4, 4, 4, 3, 3]
    figure = explanation_figure([ONE | {"particles_nat": nat}] * 3, REST[:, :2], PARTICLES)
    bars, dots, *others = figure.to_dict()["data"]
    assert list(bars["y"]) == [frame["nat"] for frame in OUT_AND_BACK] and len(others) == 4
    np.testing.assert_array_equal(dots["marker"]["color"], nat)
    np.testing.assert_allclose(dots["x"], 1e3 * REST[:, 0])
