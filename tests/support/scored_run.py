"""One run worked by hand: six particles, two frames, its truth and its result."""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from jiggle_mj.episode import Episode
from jiggle_mj.estimate import Belief, Detection, Estimate, Sheet
from jiggle_mj.estimator import EstimatorConfig
from jiggle_mj.eval.metrics.result import Run, result, with_truth
from jiggle_mj.eval.metrics.result_file import IDENTITY, RECORDED, write_result
from jiggle_mj.eval.runs.settings_used import settings_used
from jiggle_mj.limits import Limits
from jiggle_mj.observation import Declaration
from jiggle_mj.recording.estimate import EstimateWriter
from jiggle_mj.recording.truth import write_truth
from jiggle_mj.truth import Truth, TruthFrame

NO_SETTINGS: Mapping[str, str] = MappingProxyType({})
REST = np.column_stack([np.arange(6) * 0.01, np.arange(6) % 2 * 0.01, np.zeros(6)])
FACES = np.array([[0, 2, 1], [1, 2, 3], [2, 4, 3], [3, 4, 5]])
STIFFNESS = np.array([0.8, 0.8, 0, 0, 0, 0])
SHEET = Sheet(rest=REST, faces=FACES)
DETECTION = Detection(
    attached=np.array([True, False, False, False, False, True]),
    score=np.array([3.0, 2, 0, 0, 0, 1]),
    stiffness=np.zeros(6),
    stiffness_sd=np.full(6, 0.1),
    rule="b > 0.5",
)
BELIEF = Belief(mean=np.array([0.9, 0.6, 0, 0, 0, 0.2]), covariance=np.eye(6) * 0.01)


def estimate(index: int) -> Estimate:
    """Return the estimate of one frame: 0.3 mm off, and slower with the index."""
    return Estimate(
        index=index,
        time=index * 1000,
        positions=REST,
        observed=REST + np.array([0, 0, 0.0003]),
        mean=np.maximum(0, BELIEF.mean),
        sd=np.full(6, 0.1),
        probability=np.full(6, np.nan),
        held=np.zeros(6, bool),
        entropy=5.0 - index,
        nis=1.0,
        boundary_energy=0.0,
        update_s=0.1 * (index + 1),
        perception_s=0.2,
    )


ESTIMATES = [estimate(0), replace(estimate(2), converged=False)]
TRUTH = Truth(
    rest=REST,
    faces=FACES,
    attached=STIFFNESS > 0,
    frames=tuple(
        TruthFrame(index=k, time=k * 1000, positions=REST, stiffness=STIFFNESS, tip=np.zeros(3)) for k in range(3)
    ),
    scene="by hand",
    identity="this one",
    details={},
)


EPISODE = Episode(
    sheet=SHEET,
    estimates=tuple(ESTIMATES),
    belief=BELIEF,
    detection=DETECTION,
    prior_entropy=9.0,
    n_frames=5,
    skipped=((1, "NaN in the pose"),),
)


RUN = Run(
    scene="by hand",
    seed=3,
    sensing="points",
    estimator="implicit",
    policy="corners",
    episode=EPISODE,
    settings=settings_used(Declaration(), EstimatorConfig(), declare=None, declared=True),
)


def unscored(limits: Limits | None = None) -> dict:
    """Return the run's result without truth."""
    return result(replace(RUN, limits=limits))


def scored(limits: Limits | None = None, **changes) -> dict:
    """Return the run's result with truth; `changes` replace what is scored."""
    parts = {"sheet": SHEET, "estimates": ESTIMATES, "belief": BELIEF, "detection": DETECTION, "truth": TRUTH}
    return with_truth(unscored(limits), **(parts | changes))


def written(folder, settings=NO_SETTINGS):
    """Write a folder as `estimate` does, and the truth next to it; return it."""
    write_result(folder / "result.json", unscored())
    with EstimateWriter(
        folder / "estimate.mcap", SHEET, {RECORDED: "by hand", IDENTITY: "this one", **settings}
    ) as writer:
        for written_estimate in ESTIMATES:
            writer.write(written_estimate)
        writer.finish(BELIEF, DETECTION, skipped=[(1, "NaN in the pose")])
    write_truth(folder / "run.truth.mcap", TRUTH)
    return folder
