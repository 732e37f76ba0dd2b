"""What yields stays where a load has taken it, and moves back only by what the load turns beyond twice the limit."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jiggle_mj.estimator.effects import LIBRARY
from jiggle_mj.estimator.effects.sheet_model import FrameContext, SheetModel
from jiggle_mj.estimator.effects.yielding import ANCHOR_LIMITS, PULL_LIMITS, STRAIN_LIMITS, play
from jiggle_mj.estimator.physics.membrane import TriangleMembrane
from tests.support.small_sheet import DECLARATION, at_rest, sheet

EXACT = 1e-12
"""Rounding of lengths [m] and strains."""
EFFECTS = {one.name: one for one in LIBRARY}


def at(states: list[np.ndarray], time: float) -> tuple[SheetModel, FrameContext]:
    """Return the model without effects, and a frame's context at a time [s], of states a second after one another."""
    plain, moment = at_rest(sheet(), DECLARATION, at=time)
    ended = jnp.arange(float(len(states)))
    past = eqx.tree_at(lambda m: (m.past, m.ended), moment, (jnp.asarray(np.stack(states)), ended))
    return plain, eqx.tree_at(lambda m: m.began, past, ended)


def test_a_slider_follows_its_spring_and_turns_with_play():
    loads = np.zeros((6, 2, 3))
    loads[:, 0, 0] = [1.0, 3.0, 10.0, 9.0, 3.0, 0.0]
    loads[:, 1, 1:] = np.outer([0.0, 5.0, 10.0, 10.0, 10.0, 10.0], [0.6, 0.8])
    with jax.enable_x64(True):
        slid = [play(jnp.asarray(loads), jnp.arange(6) < count, (2.0, 20.0)) for count in range(7)]
        np.testing.assert_allclose([s[0, 0, 0] for s in slid], [0, 0, 1, 8, 8, 5, 2], atol=EXACT)
        np.testing.assert_allclose(slid[-1][0, 1], 8 * np.array([0.0, 0.6, 0.8]), atol=EXACT)
        np.testing.assert_array_equal(slid[-1][1], 0)


def test_an_anchor_stays_displaced_by_what_exceeded_its_limit_until_then():
    """Lifted by 6 mm along z, and put back: at 4 mm of lift the anchors are where the lift of 6 mm has left them."""
    heights, share = [0.0, 3e-3, 6e-3, 4e-3, 0.0], 0.7
    states = [sheet().rest + np.array([0.0, 0.0, height]) for height in heights]
    theta = np.zeros(len(ANCHOR_LIMITS))
    theta[1] = share
    limit = ANCHOR_LIMITS[1]
    with jax.enable_x64(True):
        for time, expected in enumerate([0.0, 3e-3 - limit, 6e-3 - limit, 6e-3 - limit, limit]):
            plain, moment = at(states, float(time))
            anchors = np.asarray(EFFECTS["anchor_yield"].acts(plain, jnp.asarray(theta), moment).energy.rest)
            lifted = sheet().rest + np.array([0.0, 0.0, share * expected])
            np.testing.assert_allclose(anchors, lifted, rtol=0, atol=EXACT)


def test_tissue_stays_stretched_by_what_exceeded_its_yield_strain():
    """Stretched along x by a twentieth, or sheared by 1/25, then relaxed a little: the limit is of a tensor's norm."""
    stretched, sheared = sheet().rest * np.array([1.05, 1.0, 1.0]), sheet().rest.copy()
    sheared[:, 0] += 0.04 * sheet().rest[:, 1]
    theta = np.zeros(len(STRAIN_LIMITS))
    theta[0] = 1.0
    green = 0.5 * (1.05**2 - 1)
    with jax.enable_x64(True):
        for state, strain in ((stretched, [green, 0.0, 0.0]), (sheared, [0.0, 0.5 * 0.04**2, 0.04])):
            plain, moment = at([sheet().rest, state, 0.2 * sheet().rest + 0.8 * state], 2.0)
            left = EFFECTS["tissue_yield"].acts(plain, jnp.asarray(theta), moment).term(TriangleMembrane).inelastic
            size = np.sqrt(strain[0] ** 2 + strain[1] ** 2 + strain[2] ** 2 / 2)
            expected = (1 - STRAIN_LIMITS[0] / size) * np.array(strain)
            np.testing.assert_allclose(left, np.broadcast_to(expected, left.shape), atol=1e-9)


def test_a_slipping_grasp_pulls_less_on_the_way_back_too():
    """Pulled by 10 mm and lowered to 7 mm: the tissue is 3 mm lower than at the top, and 5 mm of slip stay."""
    path, direction = np.array([0.0, 5e-3, 10e-3, 7e-3]), np.array([0.0, 0.6, 0.8])
    theta = np.zeros(len(PULL_LIMITS))
    theta[1] = 1.0
    assert PULL_LIMITS[1] == 5e-3
    with jax.enable_x64(True):
        for time, felt in enumerate([0.0, 5e-3, 5e-3, 2e-3]):
            plain, moment = at_rest(
                sheet(), DECLARATION, at=float(time), times=np.arange(4.0), ways=np.outer(path, direction)
            )
            plain = eqx.tree_at(lambda m: m.tool, plain, jnp.asarray(path[time] * direction))
            tool = EFFECTS["grasp_slip"].acts(plain, jnp.asarray(theta), moment).tool
            np.testing.assert_allclose(tool, felt * direction, atol=EXACT)
