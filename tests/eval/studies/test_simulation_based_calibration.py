"""Simulation-based calibration: what is drawn, how it is pulled, the words and the page, and the filter itself."""

from dataclasses import replace
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.errors import OptionError
from jiggle_mj.estimator.belief.attachment_prior import AttachmentPrior
from jiggle_mj.estimator.belief.prior import PriorConfig, stiffness_prior
from jiggle_mj.estimator.config import EstimatorConfig
from jiggle_mj.estimator.filter_builder import force_balance
from jiggle_mj.estimator.physics.surrogate import surrogate
from jiggle_mj.eval.metrics.calibration_summary import CalibrationDraw, ReferenceSummary, headline, summarised
from jiggle_mj.eval.metrics.rank_statistics import BAND_LEVEL, DRAWS, Ranked
from jiggle_mj.eval.report.calibration_page import write_calibration_page
from jiggle_mj.eval.studies.drawn_pulls import POINT_SD, REFERENCES, drawn_pull
from jiggle_mj.eval.studies.prior_draws import draw_attachments
from jiggle_mj.eval.studies.same_engine import sheet
from jiggle_mj.eval.studies.simulation_based_calibration import CalibrationStudy, calibration_draw, summaries
from jiggle_mj.eval.studies.study import run_study
from tests.support.small_scene import SCENE

BARE = replace(SCENE, attachments=())
EDGES = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [0, 2]])
"""Two triangles."""
TRUTHS = 40


def test_draws_of_the_prior_have_the_probabilities_of_its_joint_law():
    """All 16 states of four particles are summed. 2000 draws: a probability errs by 0.011, four times that is allowed.
    Centres of s are 0.003 to 0.95, equally likely: half of the attached are below 0.06."""
    config = PriorConfig(probability=0.2)
    prior = AttachmentPrior.build(
        4, EDGES, stiffness=stiffness_prior(config), probability=0.2, coupling=1.0, sheet_strength=1.0
    )
    states = np.array(list(product([0, 1], repeat=4)))
    log = states.sum(axis=1) * np.log(0.25) + (states[:, EDGES[:, 0]] * states[:, EDGES[:, 1]]).sum(axis=1)
    weight = np.exp(log) / np.exp(log).sum()
    rng = np.random.default_rng(0)
    s = np.array([draw_attachments(prior, rng, sweeps=10) for _ in range(2000)])
    np.testing.assert_allclose((s > 0).mean(axis=0), weight @ states, atol=0.045)
    together = (s[:, 0] > 0) & (s[:, 2] > 0)
    assert together.mean() == pytest.approx(weight @ (states[:, 0] * states[:, 2]), abs=0.045)
    assert s.max() <= 1
    ratio = np.log(s[together, 0] / s[together, 2])
    other = np.log(s[together, 0] / np.roll(s[together, 2], 1))
    assert np.median(np.abs(ratio)) < 0.7 * np.median(np.abs(other))  # neighbours are alike


@pytest.mark.parametrize("reference", REFERENCES)
def test_a_pull_lifts_the_corner_and_what_is_stiff_stays(reference):
    mesh, _ = sheet(BARE)
    s = np.where(np.linalg.norm(mesh.rest, axis=1) < 0.012, 0.9, 0.0)
    pull, rng = drawn_pull(BARE, reference, s, np.random.default_rng(0)), np.random.default_rng(0)
    last = pull.moments[-1]
    assert pull.declaration.mesh is not None
    moved = np.linalg.norm(last.x - pull.declaration.mesh.vertices, axis=1)
    corner = np.argmin(mesh.rest[:, :2].sum(axis=1))
    assert moved[corner] > 0.02 and moved[s > 0].max() < 2e-3
    assert np.linalg.norm(last.tool.position - last.x[corner]) < BARE.tweezer.radius
    seen = [frame.points.positions for frame in pull.observed(rng) if frame.points is not None]
    noise = np.stack(seen) - np.stack([moment.x for moment in pull.moments])
    assert noise.std() == pytest.approx(POINT_SD, rel=4 / np.sqrt(2 * noise.size))


def test_assumed_errors_are_as_large_as_the_filter_assumes():
    """The balance of forces at the true states, over its assumed standard deviation, has a mean square of 1. The errors
    change the state at which they were computed, by which a few per cent are allowed beside the sampling error."""
    mesh, _ = sheet(BARE)
    s = np.where(np.linalg.norm(mesh.rest, axis=1) < 0.012, 0.3, 0.0)
    pull, config = drawn_pull(BARE, "assumed", s, np.random.default_rng(0)), EstimatorConfig()
    with jax.enable_x64(True):
        balance = force_balance(mesh, surrogate(mesh, pull.declaration), pull.declaration, config)
        squares = []
        for moment in pull.moments[1:]:
            assert moment.tool.held_tracks is not None
            loose = np.setdiff1d(np.arange(mesh.n), moment.tool.held_tracks)
            tau = np.asarray(balance.error(jnp.asarray(moment.x)))
            sd = np.sqrt(((1 - s) * tau) ** 2 + (s * float(balance.reference) * config.anchor_sd) ** 2)
            force = np.asarray(balance.unbalanced(jnp.asarray(moment.x), jnp.asarray(s)))
            squares.append((force[loose] / sd[loose, None]) ** 2)
    found = np.concatenate(squares)
    assert found.mean() == pytest.approx(1, abs=4 * np.sqrt(2 / found.size) + 0.05)


def draw(seed: int, *, shift: float) -> CalibrationDraw:
    """Return a draw whose sum of b has a normal posterior that is off by a number of its sd; the rest is right."""
    rng = np.random.default_rng(seed)
    right = int(rng.integers(DRAWS + 1))
    truth = 50 + rng.normal()
    off = np.sum(truth + shift + rng.normal() + rng.normal(size=DRAWS) < truth)
    probability = rng.random(30)
    ranks = {"sum of b": Ranked(rank=int(off), truth=truth, mean=truth + shift, sd=1.0)}
    return CalibrationDraw(
        draws=ranks | {"number attached": Ranked(rank=right, truth=4.0, mean=4.0, sd=1.0)},
        belief=ranks,
        probability=probability.tolist(),
        attached=(rng.random(30) < probability).tolist(),
        coverage=0.9,
        coverage_attached=0.8,
        nees_attached=1.0,
        force_sd_ratio=1.0,
        converged=True,
    )


def test_the_first_line_says_what_is_found(tmp_path):
    off = summarised({"mujoco": [draw(seed, shift=-3.0) for seed in range(TRUTHS)]})
    assert headline(off).startswith("Not calibrated: 2 of 3 rank distributions leave their band")
    assert "by the MuJoCo reference, sum of b comes out low by 6 % (" in headline(off)
    assert off[0].ece < 0.1  # 1200 particles whose probabilities are right
    assert off[0].coverage_attached == pytest.approx(0.8)
    write_calibration_page(tmp_path / "page.html", off)
    page = (tmp_path / "page.html").read_text()
    assert headline(off) in page.replace("&#39;", "'") and page.count("<section>") == 1
    write_calibration_page(tmp_path / "again.html", off)
    assert (tmp_path / "again.html").read_text() == page
    right = summarised({"exact": [draw(seed, shift=0.0) for seed in range(TRUTHS)]})
    assert headline(right).startswith("Calibrated: ")


def test_without_draws_there_is_no_verdict_and_a_wrong_seed_is_refused():
    assert headline([]) == "No truth was drawn."
    with pytest.raises(OptionError, match="seed = -1: must be an integer of at least 0"):
        calibration_draw(BARE, "exact", -1)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, ReferenceSummary]:
    """Return what 50 draws by each reference on the small sheet give; read back, they are the same."""
    study, folder = CalibrationStudy(scene=BARE), tmp_path_factory.mktemp("calibration")
    results = run_study(study, study.cells(range(50)), folder)
    assert run_study(study, study.cells(range(50)), folder) == results
    return {summary.name: summary for summary in summaries(results)}


OPEN = pytest.mark.xfail(reason="the evidence leaves out the log determinant of its Jacobian: too few are attached")
LOW = pytest.mark.xfail(reason="stiffness comes out low")
"""What is known to be off: see docs/STUDIES.md."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("reference", "quantity"),
    [
        ("exact", "b, middle"),
        ("exact", "number attached"),
        ("assumed", "b, middle"),
        pytest.param("assumed", "number attached", marks=OPEN),
        pytest.param("assumed", "sum of b over a patch", marks=LOW),
        pytest.param("mujoco", "number attached", marks=OPEN),
    ],
)
def test_ranks_among_joint_draws_are_uniform(found, reference, quantity):
    """At the level of the band, by chi2 over the bins."""
    stats = found[reference].ranks["draws"][quantity]
    assert stats.p_value > 1 - BAND_LEVEL and max(stats.histogram) <= stats.band[1]


@pytest.mark.slow
@pytest.mark.parametrize("reference", [pytest.param("assumed", marks=OPEN), "exact", "mujoco"])
def test_p_attached_errs_by_at_most_five_per_cent(found, reference):
    assert found[reference].ece <= 0.05
