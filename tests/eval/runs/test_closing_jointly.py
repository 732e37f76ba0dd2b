"""Several recordings together: which set is taken, what is written, and what is refused. The fits are made up."""

import json
from dataclasses import replace

import numpy as np
import pytest

from jiggle_mj.errors import OptionError
from jiggle_mj.estimator.attribution.joint_evidence import OwnInformation, SharedPrior
from jiggle_mj.estimator.attribution.joint_fits import FixedFit
from jiggle_mj.estimator.attribution.joint_hypotheses import (
    Effects,
    EffectsPrior,
    RecordedFit,
    decide_jointly,
    joint_hypotheses,
)
from jiggle_mj.estimator.attribution.kept_fits import KeptFit, KeptLoop, KeptPoint
from jiggle_mj.estimator.attribution.noise_scales import NoiseScales
from jiggle_mj.estimator.attribution.verdict import POWER
from jiggle_mj.estimator.effects import LIBRARY
from jiggle_mj.eval.report.joint_section import joint_rows, joint_sentences
from jiggle_mj.eval.runs import closing_jointly
from jiggle_mj.eval.runs.closing_jointly import (
    JointlyClosed,
    carried_over_jointly,
    declared_fit,
    lacking_sets,
    sizes_found,
)
from jiggle_mj.eval.runs.closing_order import ClosingOrder
from jiggle_mj.eval.runs.joint_orders import FitSets, FixSizes
from jiggle_mj.eval.runs.joint_result import joint_result, shared_sd
from jiggle_mj.eval.runs.kept_files import FITS, read_fits, write_fits
from tests.support.series import Inside
from tests.support.small_sheet import sheet

EFFECTS = {effect.name: effect for effect in LIBRARY}
CREEP, SCALE, STRETCH = ("tissue_creep", 0), ("tool_scale", 0), ("stretch", 0)
PRIOR = EffectsPrior(
    sites={effect.name: effect.sites for effect in LIBRARY},
    of_tissue={
        (effect.name, 0): SharedPrior(sd=np.array(effect.prior_sd), lower=np.full(len(effect.prior_sd), -np.inf))
        for effect in LIBRARY
        if not effect.sensing
    },
)
SD = 0.01
"""Standard deviation of a shared parameter in one recording, far below its prior's."""


def kept_fit(*effects: tuple[str, int], nat: float = 0.0, theta: float = 0.05) -> KeptFit:
    """Return a fit of some effects with an evidence after the power; all shared parameters are theta."""
    shared = tuple(sorted(one for one in effects if one in PRIOR.of_tissue))
    own = tuple(sorted(one for one in effects if one not in PRIOR.of_tissue))
    size = len(PRIOR.together(shared).sd)
    information = OwnInformation(
        log_evidence=nat / POWER,
        theta=np.full(size, theta),
        precision=np.eye(size) / SD**2,
        slope=np.zeros(size),
    )
    nowhere = KeptPoint(theta=np.zeros(1), s=np.zeros(1), states=np.zeros((0, 1, 3)), scales=NoiseScales())
    recorded = RecordedFit(shared=shared, own=own, larger_errors=0.1, information=information)
    return KeptFit(effects=tuple(sorted(effects)), assumed=nowhere, likeliest=nowhere, recorded=recorded)


def fixed(shared: Effects, own: Effects = (), *, mm: float | None = None) -> FixedFit:
    """Return a fit with given shared parameters, and the error of the reported part."""
    size = len(own)
    rms = None if mm is None else 1e-3 * mm
    return FixedFit(shared=shared, own=own, theta=np.full(size, 0.08), sd=np.full(size, 0.01), rms=rms)


def closed(fits: dict[str, list[KeptFit]], fixed_fits: dict[str, FixedFit] | None = None) -> JointlyClosed:
    """Return what some fits of recordings say together, the likeliest set of them taken."""
    hypotheses = joint_hypotheses({name: [one.recorded for one in each] for name, each in fits.items()}, PRIOR)
    kept = {
        name: KeptLoop(rest=sheet().rest, n_parts=3, prior=PRIOR, scores={}, fits=each) for name, each in fits.items()
    }
    return JointlyClosed(
        library=EFFECTS,
        kept=kept,
        before={name: 5e-4 if name != "c" else None for name in fits},
        hypotheses=hypotheses,
        decision=decide_jointly(hypotheses, PRIOR),
        taken=hypotheses[0],
        fixed=fixed_fits or {name: fixed(hypotheses[0].shared, one.own) for name, one in hypotheses[0].fits.items()},
        refused={},
    )


@pytest.fixture
def creeping() -> JointlyClosed:
    """Three recordings in which tissue creeps a little; the tool of the second reports another scale."""
    plain = [kept_fit(), kept_fit(CREEP, nat=3.0), kept_fit(STRETCH, nat=1.0)]
    tool = [kept_fit(SCALE, nat=9.0), kept_fit(CREEP, SCALE, nat=12.0), kept_fit(STRETCH, SCALE, nat=9.5)]
    return closed({"a": plain, "b": [*plain, *tool], "c": plain})


def test_a_set_is_not_taken_where_one_recording_is_predicted_worse(creeping):
    """By hand: creep makes b worse than what is declared, so that nothing is shared; b keeps its tool's scale."""
    candidates = [creeping.hypotheses[0], next(one for one in creeping.hypotheses if not one.shared)]
    fits = {
        "a": [fixed((CREEP,), mm=0.4)],
        "b": [fixed((CREEP,), (SCALE,), mm=0.7), fixed((CREEP,), mm=0.9), fixed((), (SCALE,), mm=0.5)],
        "c": [fixed((CREEP,), mm=0.4)],
    }
    before = {"a": 5e-4, "b": 6e-4, "c": None}
    taken, of_each, refused = carried_over_jointly(candidates, fits, before)
    assert not taken.shared and of_each["b"].own == (SCALE,) and of_each["a"].rms == 5e-4 and not of_each["a"].own
    assert refused == {"tissue_creep": "b is predicted to 0.7 mm with it and 0.6 mm with what is declared"}


def test_a_set_is_taken_where_none_is_predicted_worse_with_or_without_its_own_effects(creeping):
    fits = {
        "a": [fixed((CREEP,), mm=0.5)],
        "b": [fixed((CREEP,), (SCALE,), mm=0.7), fixed((CREEP,), mm=0.6)],
        "c": [fixed((CREEP,), mm=9.0)],
    }
    before = {"a": 5e-4, "b": 6e-4, "c": None}
    taken, of_each, refused = carried_over_jointly(creeping.hypotheses, fits, before)
    assert taken.shared == (CREEP,) and not refused
    assert of_each["b"].own == () and of_each["b"].rms == 6e-4


def test_sets_are_fitted_only_where_they_lack_from_the_sizes_that_others_found():
    fits = {"a": [kept_fit(), kept_fit(CREEP, theta=0.07)], "b": [kept_fit(), kept_fit(CREEP, SCALE)]}
    assert lacking_sets(fits, [(CREEP,), (STRETCH,)]) == {"a": [(STRETCH,)], "b": [(STRETCH,)]}
    assert lacking_sets(fits, [(CREEP,)]) == {}
    np.testing.assert_array_equal(sizes_found(fits)[CREEP], [0.07])


def test_the_result_names_what_is_shared_and_what_is_not(creeping):
    found = joint_result(creeping)
    assert json.loads(json.dumps(found)) == found
    assert found["verdict"] == "effect" and not found["ambiguous_with"]
    (creep,) = found["effects"]
    assert creep["name"] == "tissue_creep" and creep["site"] is None and creep["units"] == ["1/s"]
    having = [
        one["probability"] for one in found["posterior"] if {"name": "tissue_creep", "site": None} in one["effects"]
    ]
    assert creep["probability"] == pytest.approx(sum(having)) and creep["probability"] > 0.95
    assert creep["theta"][0] == pytest.approx(0.05, rel=1e-3)
    assert sum(one["probability"] for one in found["posterior"]) == pytest.approx(1)
    assert [one["name"] for one in found["recordings"]] == ["a", "b", "c"]
    assert [len(one["own_effects"]) for one in found["recordings"]] == [0, 1, 0]
    text = " ".join(joint_sentences(found))
    assert "tissue_creep, in all recordings: 0.050 ± 0.017 1/s; its probability is 1.00." in text
    assert "b alone: tool_scale 0.080 ± 0.017 log factor." in text  # three parts of sd 0.01
    assert found["posterior"][0]["recordings"]["b"]["theta"] == [0.05]
    rows = joint_rows(found)
    assert rows[0][0] == "tissue_creep" and rows[0][4].endswith(" beside tool_scale")
    nothing = next(row for row in rows if row[0] == "nothing")
    assert nothing[2] == "0.0" and nothing[3] == "0.0"


def test_the_reported_sd_is_that_of_one_part_or_the_spread_between_recordings():
    """By hand: nine parts of sd 0.01 / sqrt(3); or recordings at 0.01, 0.05 and 0.09, whose deviation is 0.04."""
    alike = closed({name: [kept_fit(), kept_fit(CREEP, nat=9.0)] for name in "abc"})
    assert shared_sd(alike)[0] == pytest.approx(3 * SD / 3**0.5, rel=1e-3)
    apart = closed(
        {
            name: [kept_fit(), kept_fit(CREEP, nat=9.0, theta=theta)]
            for name, theta in (("a", 0.01), ("b", 0.05), ("c", 0.09))
        }
    )
    assert apart.taken.shared == (CREEP,)
    assert shared_sd(apart)[0] == pytest.approx(0.04, rel=1e-2)


def test_what_does_not_carry_over_leaves_something_unexplained(creeping):
    nothing = next(one for one in creeping.hypotheses if not one.shared)
    refused = replace(
        creeping,
        taken=nothing,
        fixed={name: declared_fit(None) for name in "abc"},
        refused={"tissue_creep": "b is predicted to 0.7 mm with it and 0.6 mm with what is declared"},
    )
    found = joint_result(refused)
    assert found["verdict"] == "unexplained" and not found["effects"]
    assert "tissue_creep is not taken: b is predicted to 0.7 mm" in " ".join(joint_sentences(found))


class MadeUp:
    """Stands in for the workers: fits sets with given evidence, and predicts the reported part with given errors.

    Args:
        nat: evidence of each set in each recording that lacks it, by the recording's name, after the power.
        error: of the reported part with each set [mm].
    """

    def __init__(self, nat: dict[str, dict[Effects, float]], error: dict[Effects, float]) -> None:
        self.nat, self.error, self.asked = nat, error, list[tuple[str, list[Effects]]]()

    def __call__(self, order: FitSets | FixSizes) -> list[KeptFit] | list[FixedFit]:
        """Return what an order asks for."""
        name = order.order.recording.stem
        if isinstance(order, FitSets):
            self.asked.append((name, list(order.wanted)))
            return [kept_fit(*shared, nat=self.nat[name][shared]) for shared in order.wanted]
        return [
            fixed(one.recorded.shared, one.recorded.own, mm=self.error[one.recorded.shared]) for one, _ in order.fixed
        ]


@pytest.fixture
def orders(tmp_path) -> dict[str, ClosingOrder]:
    """Two recordings: a was fitted with creep, b was not, though its score speaks for creep."""
    found = {}
    for name, fits in (("a", [kept_fit(), kept_fit(CREEP, nat=4.0)]), ("b", [kept_fit()])):
        order = ClosingOrder(
            recording=tmp_path / f"{name}.mcap", folder=tmp_path / name, job={}, options={"library": LIBRARY}
        )
        order.folder.mkdir()
        scores = {CREEP: 9.0} if name == "b" else {}
        write_fits(order.folder / FITS, KeptLoop(rest=sheet().rest, n_parts=3, prior=PRIOR, scores=scores, fits=fits))
        found[name] = order
    return found


def test_a_set_is_fitted_where_it_lacks_and_then_decides_for_all(orders, monkeypatch):
    lines, workers = [], MadeUp({"b": {(CREEP,): 4.0}}, {(CREEP,): 0.4})
    monkeypatch.setattr(closing_jointly, "execute", workers)
    found = closing_jointly.close_jointly(orders, {"a": 5e-4, "b": 5e-4}, Inside(), lines.append)
    assert workers.asked == [("b", [(CREEP,)])]
    assert found.taken.shared == (CREEP,) and not found.refused
    assert found.taken.posterior.sd[0] == pytest.approx(SD / 2**0.5, rel=1e-2)
    assert lines == [
        "fitting tissue_creep to the recordings that lack them: b",
        "fitting a, b with sizes that hold for all: tissue_creep, nothing",
    ]


def test_what_one_recording_speaks_against_is_not_shared(orders, monkeypatch):
    workers = MadeUp({"b": {(CREEP,): -6.0}}, {})
    monkeypatch.setattr(closing_jointly, "execute", workers)
    lines = []
    found = closing_jointly.close_jointly(orders, {"a": 5e-4, "b": 5e-4}, Inside(), lines.append)
    assert len(lines) == 1  # what is declared is not fitted again
    assert not found.taken.shared and found.decision.kind == "no-effect"
    assert all(one.rms == 5e-4 for one in found.fixed.values())


def test_recordings_of_sheets_of_other_shapes_are_refused_before_anything_is_fitted(orders, monkeypatch):
    workers = MadeUp({}, {})
    monkeypatch.setattr(closing_jointly, "execute", workers)
    path = orders["b"].folder / FITS
    write_fits(path, replace(read_fits(path), rest=1.3 * sheet().rest))
    with pytest.raises(OptionError, match="a and b do not show one sheet"):
        closing_jointly.close_jointly(orders, dict.fromkeys("ab"), Inside(), lambda _: None)
    assert not workers.asked
