"""Closing the loop over lifts by our own engine: the missing effect is named, and none if nothing is missing."""

import numpy as np
import pytest

from jiggle_mj.estimator.effects import LIBRARY
from jiggle_mj.eval.report.discrepancy_page import story
from jiggle_mj.observation import Observation
from tests.support.lifted_recording import NOISE, SMALL_LIBRARY, closed_over, observed, report_further
from tests.support.small_sheet import attached

GRAVITY_ERROR = 0.05
"""Error of the fitted gravity [g], a sixteenth of the missing part."""
SCALE_ERROR = 0.02
"""Error of the fitted scale of the tool [log factor], a fifth of the true one."""
TETHERING, TETHERING_ERROR = 2e4, 0.1
"""Stiffness of a hold on all of the sheet [N/m^3], and the relative error of the fitted one: the stretching stiffness,
a nuisance parameter, is known to 5 %."""
NOISE_RMS = 3**0.5 * NOISE
"""Root mean square length of the noise of three coordinates [m]."""


def test_an_undeclared_gravity_is_named_alone_or_beside_stretch(light):
    """A fifth of the weight and five times the stretching stiffness look alike but for bending.

    Whether that tells the two apart depends on the attachments that the fit with stretch begins with.
    """
    closed, found, _ = light
    named = {found["effects"][0]["name"], *found["ambiguous_with"]}
    assert "gravity" in named and named <= {"gravity", "stretch"}, story(found)
    assert found["verdict"] == ("ambiguous" if len(named) > 1 else "effect")
    gravity = next(one for one in (closed.final, *closed.rivals) if one.names == ("gravity",))
    assert gravity.theta(gravity.added[0])[2] == pytest.approx(0.8, abs=GRAVITY_ERROR)
    assert closed.reported is not None
    before, after = (one.rms for one in closed.reported)
    assert after < 0.7 * before
    assert after < 2 * NOISE_RMS


def test_attached_particles_stay_found(light):
    closed, *_ = light
    assert np.sum(closed.final.fitted.attached != attached()) <= 2


def test_nothing_is_named_where_nothing_is_missing():
    _, found, _ = closed_over(observed(1.0))
    assert found["verdict"] == "no-effect", story(found)
    assert not found["effects"]
    held = found["held_out"]
    assert held["before_rms_m"] == held["after_rms_m"] < 2 * NOISE_RMS
    assert held["before_rms_m"] < 0.5 * min(held["in_proportion_rms_m"], held["unmoved_rms_m"])


@pytest.mark.slow
def test_a_tool_that_moves_further_than_it_reports_is_named():
    _, found, _ = closed_over(observed(1.0, tool_scale=1.1))
    assert found["effects"][0]["name"] == "tool_scale", story(found)
    assert found["effects"][0]["theta"][0] == pytest.approx(np.log(1.1), abs=SCALE_ERROR)
    assert found["effects"][0]["this_session_alone"]


@pytest.mark.slow
def test_a_hold_on_all_of_the_sheet_is_no_attachment_of_every_particle():
    """Attachments of all particles explain it as well, and are likelier one by one."""
    tethering = next(effect for effect in LIBRARY if effect.name == "tethering")
    closed, found, _ = closed_over(observed(1.0, tethering=TETHERING), (*SMALL_LIBRARY, tethering))
    assert found["effects"][0]["name"] == "tethering", story(found)
    assert found["effects"][0]["theta"][0] == pytest.approx(TETHERING, rel=TETHERING_ERROR)
    before, after = (np.sum(one.attached) for one in (closed.declared.fitted, closed.final.fitted))
    assert after <= np.sum(attached()) < 0.2 * before


@pytest.mark.slow
def test_two_effects_at_once_are_both_named_with_their_indistinguishable_ones():
    _, found, _ = closed_over(observed(0.2, tool_scale=1.1))
    names = {effect["name"] for effect in found["effects"]}
    assert names <= {"gravity", "stretch", "tool_scale"} and len(names) == 2, story(found)
    assert {"gravity", "tool_scale"} <= names | set(found["ambiguous_with"])
    scale = next(effect for effect in found["effects"] if effect["name"] == "tool_scale")
    assert scale["theta"][0] == pytest.approx(np.log(1.1), abs=SCALE_ERROR)


@pytest.mark.slow
def test_a_hold_that_slips_is_not_explained_by_larger_forces():
    """From the second increment of each lift on, the jaws are a centimetre further than what they hold."""
    slipped = [report_further(one, 0.01) if _is_late(one) else one for one in observed(1.0)]
    _, found, _ = closed_over(slipped)
    assert found["posterior"][0]["variances"]["tool"] > 10, story(found)
    assert found["verdict"] in ("unexplained", "effect-with-remainder"), story(found)


def _is_late(one: Observation) -> bool:
    """Return whether an observation is after the first increment of its lift."""
    earlier = [other for other in observed(1.0) if other.tool.grasp == one.tool.grasp and other.index < one.index]
    return one.tool.closed and len(earlier) > 1
