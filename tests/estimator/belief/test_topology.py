"""Cuts and sutures in the belief: what is kept, what is forgotten, and the evidence of success."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.actions import Cut, Suture
from jiggle_mj.errors import PerceptionError
from jiggle_mj.estimator import Estimator
from jiggle_mj.estimator.belief.attachment_belief import AttachmentBelief
from jiggle_mj.estimator.belief.attachment_prior import AttachmentPrior
from jiggle_mj.estimator.belief.expectation_propagation import MIN_SITE_PRECISION
from jiggle_mj.estimator.belief.prior import PriorConfig, stiffness_prior
from jiggle_mj.estimator.belief.topology import FAILURE_PROBABILITY, Change, after, region_of
from jiggle_mj.observation import Declaration, MeasuredPoints, Observation, ToolState

N, REFERENCE = 12, 30.0
REGION = np.arange(N) < 4
ODDS_ERROR = 0.02
"""Largest change of P(attached) by messages between neighbours, which the closed forms here leave out."""
EP_ERROR = 1e-3
"""Relative error of the mean of one particle's s by expectation propagation, whose evidence is its own."""
CUT = Cut(path=np.zeros((1, 2)), width=1e-2)


@pytest.fixture(scope="module")
def belief() -> AttachmentBelief:
    """A chain, half of it attached with s = 0.03, seen with correlated noise of 0.004."""
    stiffness = stiffness_prior(PriorConfig())
    edges = np.stack([np.arange(N - 1), np.arange(1, N)], axis=1)
    prior = AttachmentPrior.build(N, edges, stiffness=stiffness, probability=0.05, coupling=1.0)
    true = jnp.where(jnp.arange(N) < 6, 0.03, 0.0)
    return swept(seen(AttachmentBelief.before(prior, reference=REFERENCE), true))


def seen(belief: AttachmentBelief, true) -> AttachmentBelief:
    precision = evidence()
    return belief.add(precision, precision @ true)


def evidence():
    near = 0.4 ** np.abs(np.subtract.outer(np.arange(N), np.arange(N)))
    return jnp.asarray(np.linalg.inv(0.004**2 * near))


@eqx.filter_jit
def swept(belief: AttachmentBelief) -> AttachmentBelief:
    return belief.swept(30)


@eqx.filter_jit
def attached(belief: AttachmentBelief) -> jax.Array:
    return belief.mixture().attached


def test_evidence_about_other_particles_is_kept_exactly(belief):
    """The marginal of a Gaussian: by the covariance, not by the Schur complement of the precision."""
    precision = belief.precision + jnp.diag(jnp.where(REGION, belief.site_precision, 0.0))
    shift = belief.shift + jnp.where(REGION, belief.site_shift, 0.0)
    left = np.ix_(~REGION, ~REGION)
    covariance = np.linalg.inv(precision)[left]
    changed = eqx.filter_jit(belief.changed)(jnp.asarray(REGION), jnp.full(N, 0.5))
    np.testing.assert_allclose(changed.precision[left], np.linalg.inv(covariance), rtol=1e-8, atol=1e-6)
    mean = np.linalg.solve(precision, shift)[~REGION]
    np.testing.assert_allclose(changed.shift[~REGION], np.linalg.solve(covariance, mean), rtol=1e-8, atol=1e-6)
    assert not changed.precision[REGION].any() and not changed.shift[REGION].any()
    assert (changed.site_precision[REGION] == MIN_SITE_PRECISION).all()


def test_after_a_cut_the_region_is_as_likely_attached_as_cuts_fail(belief):
    cut = swept(after(belief, CUT, REGION))
    before, now = attached(belief), attached(cut)
    assert (before[:6] > 0.99).all() and (before[6:] < 0.05).all()
    np.testing.assert_allclose(now[REGION], FAILURE_PROBABILITY, atol=ODDS_ERROR)
    np.testing.assert_allclose(now[6:], before[6:], atol=ODDS_ERROR)


def test_after_a_suture_the_region_is_as_likely_attached_as_sutures_hold(belief):
    """The mean of s is that of the prior at this P(attached) after one measurement of the intended s, as wide as it."""
    region = np.arange(N) >= 8
    sewn = swept(after(belief, Suture(path=CUT.path, width=1e-2, stiffness=1.0), region))
    probability = attached(sewn)
    np.testing.assert_allclose(probability[region], 1 - FAILURE_PROBABILITY, atol=ODDS_ERROR)
    np.testing.assert_allclose(probability[:6], attached(belief)[:6], atol=ODDS_ERROR)
    stiffness, intended = sewn.prior.stiffness, sewn.bounded(jnp.full(N, 1.0))
    odds = jnp.log(probability) - jnp.log1p(-probability)
    _, factor = stiffness.posterior(intended, intended**2, odds)
    expected = stiffness.posterior(intended, intended**2, odds - factor)[0].moments()[0]
    np.testing.assert_allclose(sewn.posterior().mean[region], expected[region], rtol=EP_ERROR)


def test_the_evidence_is_that_of_its_definition(belief):
    """ln of the integral of N(s; m, S) exp(-1/2 s' L s + e' s), as a ratio of two normal densities."""
    precision, true = evidence(), jnp.linspace(0, 0.03, N)
    shift = precision @ true
    before = belief.precision + jnp.diag(belief.site_precision)
    mean = jnp.linalg.solve(before, belief.shift + belief.site_shift)
    density = jax.scipy.stats.multivariate_normal.logpdf
    read = jnp.linalg.solve(precision, shift)
    likely = density(read, mean, jnp.linalg.inv(before) + jnp.linalg.inv(precision))
    constant = 0.5 * N * jnp.log(2 * jnp.pi) - 0.5 * jnp.linalg.slogdet(precision)[1] + 0.5 * read @ precision @ read
    np.testing.assert_allclose(belief.evidence_for(precision, shift), likely + constant, rtol=1e-6)


@pytest.mark.parametrize("worked", [True, False])
@pytest.mark.parametrize("event", [CUT, Suture(path=CUT.path, width=1e-2, stiffness=30 * 0.03 / 0.97)], ids=type)
def test_frames_after_an_act_show_whether_it_succeeded(belief, event, worked):
    cut = isinstance(event, Cut)
    region = REGION if cut else np.arange(N) >= 8
    old = jnp.where(jnp.arange(N) < 6, 0.03, 0.0)
    new = jnp.where(region, 0.0 if cut else 0.03, old) if worked else old
    change = Change(event=event, index=5, region=region, before=belief)
    noisy = new + 0.004 * np.random.default_rng(0).standard_normal(N)
    factor = change.log_bayes_factor(evidence(), evidence() @ noisy)
    assert factor > 5 if worked else factor < -5


def test_a_region_is_a_band_around_its_path():
    rest = np.array([[0, 0, 0], [0.01, 0.002, 0], [0.01, 0.004, 0], [0.03, 0, 0]], dtype=float)
    path = np.array([[0, 0], [0.02, 0]])
    assert region_of(Cut(path=path, width=6e-3), rest).tolist() == [True, True, False, False]


def look(event=(), **tool) -> Observation:
    grid = np.stack(np.meshgrid(*[np.arange(6) * 0.01] * 2), axis=-1).reshape(-1, 2)
    points = np.column_stack([grid, np.zeros(36)])
    state = {
        "closed": False,
        "grasp": 0,
        "radius": 0.011,
        "position": np.zeros(3),
        "quat_wxyz": np.array([1.0, 0, 0, 0]),
    }
    return Observation(
        index=0,
        time=0,
        tool=ToolState(**(state | tool)),
        points=MeasuredPoints(positions=points, track_id=np.arange(36)),
        events=event,
    )


def test_an_event_beside_the_sheet_is_skipped_and_reported():
    estimator = Estimator(Declaration())
    estimator.update(look())
    estimator.update(replace(look((Cut(path=np.array([[0.5, 0.5]]), width=0.01),)), index=3))
    assert estimator.changes == [] and estimator.skipped == [(3, "the cut is beside the sheet, and was left out")]


def test_an_event_while_the_jaws_are_open_is_taken():
    estimator = Estimator(Declaration())
    estimator.update(look())
    estimator.update(look((Suture(path=np.array([[0.02, 0.02]]), width=0.025, stiffness=1.0),)))
    (change,) = estimator.changes
    assert change.region.sum() == 5 and estimator.change_log_bayes_factor(change) is None
    assert (estimator.detection.attached == change.region).all()


def test_a_sheet_must_be_seen_before_a_grasp_is_planned():
    with pytest.raises(PerceptionError, match="no frame has shown the sheet"):
        Estimator(Declaration()).begin()
