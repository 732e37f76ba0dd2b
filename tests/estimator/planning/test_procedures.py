"""Procedures: where they cut and sew, and how long they explore what was sewn."""

import equinox as eqx
import numpy as np
import pytest

from jiggle_mj.actions import Grasp, Move, Suture
from jiggle_mj.errors import ActionError
from jiggle_mj.estimate import Detection, Sheet
from jiggle_mj.estimator.estimator import Estimator
from jiggle_mj.estimator.planning.information_policy import InformationPolicy
from jiggle_mj.estimator.planning.policy import Decision
from jiggle_mj.estimator.planning.procedures import (
    CERTAIN_LOG_BAYES_FACTOR,
    MAX_CYCLE_STEPS,
    Sew,
    free_stretch,
    tour,
)
from tests.support.small_sheet import sheet, sheet_prior

LENGTH, WIDTH = 0.02, 7e-3


def test_a_tour_goes_from_neighbour_to_neighbour():
    points = np.array([[0.0, 0], [3, 0], [1, 0], [2, 0]])
    assert tour(points).tolist() == [[0, 0], [1, 0], [2, 0], [3, 0]]
    assert tour(points[:1]).tolist() == [[0, 0]]


def stretch(probability):
    return free_stretch(sheet().rest[:, :2], probability, sheet().border, length=LENGTH, width=WIDTH)


def test_the_surest_free_stretch_lies_where_nothing_is_attached():
    flat = sheet().rest[:, :2]
    probability = np.where(flat[:, 1] > -5e-3, 0.9, 0.01)
    path = stretch(probability)
    assert path is not None and path[:, 1].max() < -5e-3
    np.testing.assert_allclose(np.linalg.norm(path[1] - path[0]), LENGTH)


def test_where_no_stretch_is_known_to_be_free_there_is_none():
    before = eqx.filter_jit(lambda belief: belief.sweep(belief.gaussian()).mixture().attached)(sheet_prior())
    assert stretch(np.asarray(before)) is None, "nothing was observed yet"
    assert stretch(np.full(sheet().n, 0.3)) is None
    assert stretch(np.full(sheet().n, 0.0)) is not None


class Exploring(InformationPolicy):
    """Policy that moves until it has to leave."""

    def __init__(self, *, min_gain=None, about=None):
        self.about, self.over = about, ""

    def leave(self, why):
        self.over = why

    def plan(self, estimator):
        return self.over or (Move(to=np.zeros(3)), "it teaches")


class GoesOn(Exploring):
    """Policy that goes on, whatever was refused."""

    def refused(self, error):
        return True


class KnownFactors(Estimator):
    """Estimator that believes that all is free, with given log Bayes factors of a suture after each step."""

    def __init__(self, factors):
        self.known, self.factors = [], list(factors)

    @property
    def changes(self):
        return self.known

    @property
    def sheet(self):
        return Sheet(rest=sheet().rest, faces=sheet().faces)

    @property
    def detection(self):
        free = np.zeros(sheet().n)
        return Detection(attached=free > 0, score=free, stiffness=free, stiffness_sd=free, rule="", probabilistic=True)

    def release(self):
        pass

    def change_log_bayes_factor(self, change):
        return self.factors.pop(0) if len(self.factors) > 1 else self.factors[0]


def sewing(*factors):
    """Return what a procedure plans, how it ends, and which particles it asked about after the suture."""
    policies = []

    def new_policy(**asked):
        policies.append(Exploring(**asked))
        return policies[-1]

    estimator, sew = KnownFactors(factors), Sew(new_policy, length=LENGTH, width=WIDTH, stiffness=1.0)
    planned = []
    for _ in range(3 * MAX_CYCLE_STEPS):
        decision = sew.plan(estimator)
        if isinstance(decision, str):
            return planned, decision, policies[-1].about
        planned.append(decision[0])
        if isinstance(decision[0], Suture):
            estimator.changes.append(decision[0])
    raise AssertionError("no end")


@pytest.mark.parametrize(("sign", "ended"), [(1, "the suture holds"), (-1, "the suture does not hold")])
def test_a_suture_is_explored_until_it_is_known_whether_it_holds(sign, ended):
    planned, why, about = sewing(None, sign * (CERTAIN_LOG_BAYES_FACTOR - 1), sign * (CERTAIN_LOG_BAYES_FACTOR + 1))
    assert isinstance(planned[MAX_CYCLE_STEPS], Suture)
    assert len(planned) == MAX_CYCLE_STEPS + 1 + 2
    assert why == f"{ended}; the result of the last act is known"
    band = np.linalg.norm(sheet().rest[about, :2] - np.mean(planned[MAX_CYCLE_STEPS].path, axis=0), axis=1)
    assert 0 < len(band) < sheet().n and band.max() <= (LENGTH + WIDTH) / 2


def test_a_suture_that_stays_undecided_is_explored_for_a_cycle():
    planned, why, _ = sewing(CERTAIN_LOG_BAYES_FACTOR / 2)
    assert len(planned) == 2 * MAX_CYCLE_STEPS + 1
    assert why == "the suture holds; the steps of this cycle are done"


def test_a_refused_suture_is_the_end_and_a_refused_grasp_is_for_the_exploring_policy():
    procedure = Sew(GoesOn, length=LENGTH, width=WIDTH, stiffness=1.0)
    point = np.zeros(3)
    for action, goes_on in (
        (Grasp(point=point, radius=8e-3), True),
        (Suture(path=point[None, :2], width=WIDTH, stiffness=1.0), False),
    ):
        procedure.decisions.append(Decision(action=action, plan_s=0.0, why=""))
        assert procedure.refused(ActionError("nothing is there")) is goes_on
    assert procedure.ended == "an action could not be carried out: nothing is there"
