from types import SimpleNamespace

import pytest

from jiggle_mj.errors import OptionError, RecordingError
from jiggle_mj.importing.bags.gripper import ClosedRule, jaw_states, jaw_value, state_at


def joints(**positions: float) -> SimpleNamespace:
    return SimpleNamespace(name=list(positions), position=list(positions.values()), velocity=[], effort=[])


@pytest.mark.parametrize(
    ("text", "value", "closed"),
    [
        ("jaw<0.1", 0.05, True),
        ("jaw < 0.1", 0.1, False),
        ("jaw<=0.1", 0.1, True),
        ("jaw>-1e-3", 0.0, True),
        ("data==false", 0.0, True),
        ("data==false", 1.0, False),
        ("always", 5.0, True),
    ],
)
def test_a_rule_compares_as_it_reads(text: str, value: float, closed: bool):
    assert ClosedRule.parse(text).holds(value) is closed


@pytest.mark.parametrize(
    "text", ("", "jaw", "jaw<", "jaw<x", "jaw<nan", "jaw<0.1 and open", "<0.1", "jaw<1" + 400 * "0")
)
def test_a_text_that_is_no_rule_is_refused_shortly(text: str):
    with pytest.raises(OptionError, match="must be a comparison") as failure:
        ClosedRule.parse(text)
    assert len(str(failure.value)) < 400


def test_a_joint_is_compared_by_its_name_and_field():
    message = SimpleNamespace(name=["a", "jaw"], position=[1.0, 0.2], velocity=[], effort=[0.0, 3.0])
    assert jaw_value(message, ClosedRule.parse("jaw<0.1"), "/js") == 0.2
    assert jaw_value(message, ClosedRule.parse("jaw.effort>2"), "/js") == 3.0
    with pytest.raises(RecordingError, match=r"no velocity of the joint 'jaw'.*a, jaw"):
        jaw_value(message, ClosedRule.parse("jaw.velocity>2"), "/js")
    with pytest.raises(RecordingError, match="no position of the joint 'grip'"):
        jaw_value(message, ClosedRule.parse("grip<1"), "/js")


def test_joints_and_numbers_without_a_rule_are_refused_with_what_they_hold():
    with pytest.raises(RecordingError, match=r"jaw = 0.3\); say when the jaws are closed.*--closed 'jaw<"):
        jaw_value(joints(jaw=0.3), None, "/js")
    with pytest.raises(RecordingError, match=r"from 0.1 to 0.9; .*--closed 'data<0.5'"):
        jaw_states([0, 1], [0.1, 0.9], None, "/width")


@pytest.mark.parametrize("rule", ["jaw<0.1", "data==0.5", "data>0"])
def test_a_bool_takes_no_rule_of_numbers(rule: str):
    """False is below 0.1, so that the jaws would be taken the other way round."""
    with pytest.raises(RecordingError, match=r"is a Bool.*leave it out where true means closed"):
        jaw_states([0, 1], [True, False], ClosedRule.parse(rule), "/closed")
    opposite, _ = jaw_states([0, 1], [True, False], ClosedRule.parse("data==false"), "/closed")
    assert [state.closed for state in opposite] == [False, True]


def test_a_message_of_our_own_schema_takes_no_rule():
    with pytest.raises(RecordingError, match="/tool/grasp says itself"):
        jaw_states([0], [{"closed": True, "grasp": 1}], ClosedRule.parse("always"), "/tool/grasp")


def test_grasps_are_counted_by_their_closings():
    states, n_short = jaw_states([0, 10**9, 2 * 10**9, 3 * 10**9], [False, True, False, True], None, "/closed")
    assert [(state.closed, state.grasp) for state in states] == [(False, 0), (True, 1), (False, 1), (True, 2)]
    assert n_short == 0
    assert [state_at(states, time).grasp for time in (0, 10**9 - 1, 10**9, 4 * 10**9)] == [0, 0, 1, 2]


def test_before_the_first_message_the_jaws_are_open():
    states, _ = jaw_states([100], [True], None, "/closed")
    assert not state_at(states, 99).closed and state_at(states, 100).grasp == 1


def test_short_grasps_are_counted_and_kept():
    """An opening of 80 ms between two grasps is real; a grasp of 20 ms is said to be noise."""
    ms = 10**6
    times = [0, 500 * ms, 580 * ms, 900 * ms, 980 * ms, 1000 * ms]
    states, n_short = jaw_states(times, [True, False, True, False, True, False], None, "/closed")
    assert states[-1].grasp == 3 and n_short == 1


def test_a_text_message_of_our_own_schema_is_read():
    message = SimpleNamespace(data='{"closed": true, "grasp": 3, "radius": 0.008, "held_tracks": [4, 2]}')
    states, _ = jaw_states([5], [jaw_value(message, None, "/tool/grasp")], None, "/tool/grasp")
    assert (states[0].grasp, states[0].radius, states[0].held_tracks) == (3, 0.008, (4, 2))
    with pytest.raises(RecordingError, match="must be JSON"):
        jaw_value(SimpleNamespace(data="closed"), None, "/tool/grasp")


def test_a_number_that_is_none_is_refused():
    with pytest.raises(RecordingError, match="neither open nor closed"):
        jaw_value(SimpleNamespace(data=float("nan")), ClosedRule.parse("data<1"), "/width")
