"""What every filter keeps: it sharpens if it states an uncertainty, repeats itself to the byte, takes no notice of what
was not seen, and forgets a frame that no state explains."""

from functools import cache

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.belief.attachment_belief import AttachmentBelief
from jiggle_mj.estimator.belief.boundary_belief import BoundaryBelief
from jiggle_mj.estimator.filters.adam import AdamShooting
from jiggle_mj.estimator.filters.evidence import Evidence, Filter, Pull
from jiggle_mj.estimator.filters.explicit import MultipleShooting
from jiggle_mj.estimator.filters.implicit import ImplicitFilter
from jiggle_mj.estimator.filters.nnls import NonNegativeLeastSquares
from jiggle_mj.estimator.filters.unscented import ReducedUnscented
from tests.support.small_sheet import DECLARATION, corners, lifts, sheet, sheet_balance, sheet_energy, sheet_prior

NOISE = 2e-4
K = DECLARATION.membrane_stiffness
N = sheet().n


def implicit() -> Filter:
    return ImplicitFilter(sheet_balance(6e-4))


def explicit() -> Filter:
    return MultipleShooting(sheet(), DECLARATION, grip_stiffness=3 * K, samples=2)


def adam() -> Filter:
    return AdamShooting(sheet(), DECLARATION, grip_stiffness=3 * K, samples=2)


@cache
def nnls() -> Filter:
    """Keeps nothing, so one will do."""
    return NonNegativeLeastSquares.build(sheet_energy(), force_sd=6e-4)


def unscented() -> Filter:
    return ReducedUnscented(sheet(), sheet_energy(), grip_stiffness=3 * K, force_tolerance=1.5e-4)


FILTERS = (implicit, explicit, adam, nnls, unscented)
MOSTLY_QUICK = (implicit, explicit, nnls, *(pytest.param(one, marks=pytest.mark.slow) for one in (adam, unscented)))


def frame(number: int, hidden: np.ndarray | None = None, lie: float = 0.0) -> Evidence:
    """Frame `number` of the first lift; what is hidden has no precision, and `lie` [m] is added to it."""
    now, before = lifts()[number], lifts()[number - 1]
    y = now.x + NOISE * np.random.default_rng(number).normal(size=now.x.shape)
    precision = np.broadcast_to(np.eye(3) / NOISE**2, (N, 3, 3)).copy()
    if hidden is not None:
        precision[hidden] = 0
        y[hidden] += lie
    held = jnp.asarray(now.held)
    length = np.linalg.norm(sheet().rest - corners()[0], axis=1)
    pull = Pull(before=jnp.asarray(before.x), tip=jnp.asarray(now.tip), length=jnp.asarray(length))
    return Evidence(y=jnp.asarray(y), precision=jnp.asarray(precision), held=held, force_unknown=held, pull=pull)


def prior(filter: Filter) -> BoundaryBelief | AttachmentBelief:
    return sheet_prior() if isinstance(filter, ImplicitFilter) else BoundaryBelief.prior(N, mean=1e-4, sd=1.0)


def run(filter: Filter, frames: list[Evidence]):
    belief, b, outcomes = prior(filter), jnp.zeros(N), []
    for one in frames:
        out = filter.update(belief, b, one, jnp.where(one.precision[:, :1, 0] > 0, one.y, jnp.asarray(sheet().rest)))
        belief, b = out.belief, out.b
        outcomes.append(out)
    return outcomes


@pytest.mark.parametrize("make", MOSTLY_QUICK)
def test_every_filter_sharpens_stays_non_negative_and_repeats_itself(make):
    frames = [frame(number) for number in (1, 2, 3)]
    first, second = run(make(), frames), run(make(), frames)
    entropies = [float(prior(make()).entropy()), *(float(out.entropy) for out in first)]
    if make is adam:
        for out in first:
            summary = (out.sd, out.entropy, out.nis, *out.belief.moments())
            assert all(np.isnan(np.asarray(part)).all() for part in summary)
    else:
        assert (np.diff(entropies) < 0).all()
        assert all(np.asarray(out.sd).max() <= 1 + 1e-9 or make is implicit for out in first)
        assert all(float(out.nis) > 0 for out in first)
    for out, again in zip(first, second, strict=True):
        assert out.x.shape == (N, 3) and out.b.shape == out.sd.shape == (N,)
        assert np.asarray(out.b).min() >= 0 and np.asarray(out.b).max() > 0
        assert np.isnan(np.asarray(out.probability)).all() or make is implicit
        for name in ("x", "b", "sd", "probability", "entropy", "nis"):
            assert np.asarray(getattr(out, name)).tobytes() == np.asarray(getattr(again, name)).tobytes()


@pytest.mark.parametrize("make", MOSTLY_QUICK)
def test_what_was_not_seen_does_not_matter(make):
    hidden = np.zeros(N, bool)
    hidden[[3, 20, 44, 60]] = True
    one, other = (run(make(), [frame(1), frame(2, hidden, lie)])[-1] for lie in (0.0, 0.3))
    np.testing.assert_allclose(other.belief.precision, one.belief.precision, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(other.b, one.b, atol=1e-9)


@pytest.mark.parametrize("make", FILTERS)
def test_a_frame_without_a_state_is_said_to_be_so_and_forgotten(make):
    """The caller refuses it; later frames, and the opening of the jaws, go on as if it had not been."""
    filter, good, bad = make(), [frame(1), frame(2)], frame(3)
    bad = eqx.tree_at(lambda one: one.y, bad, bad.y * jnp.nan)
    first = run(filter, good[:1])[-1]
    refused = filter.update(first.belief, first.b, bad, bad.y)
    assert not (np.isfinite(refused.x).all() and np.isfinite(refused.b).all())
    after, as_if = filter.update(first.belief, first.b, good[1], good[1].y), run(make(), good)[-1]
    np.testing.assert_array_equal(after.b, as_if.b)
    if (refined := filter.release(after.belief)) is not None:
        assert np.isfinite(refined.b).all()


@pytest.mark.parametrize("make", [explicit, adam, unscented])
def test_filters_that_simulate_need_the_step_that_led_to_the_frame(make):
    bare = Evidence(**{name: getattr(frame(1), name) for name in ("y", "precision", "held", "force_unknown")})
    with pytest.raises(ValueError, match=r"needs Evidence\.pull"):
        run(make(), [bare])
