"""`result.json`: its exact keys, what the truth fills in and what it leaves alone, on disk and off."""

import json
from dataclasses import replace

import numpy as np
import pytest

from jiggle_mj.cli.terminal import show
from jiggle_mj.errors import OutputError, RecordingError
from jiggle_mj.eval.metrics.result import result, score
from jiggle_mj.eval.metrics.result_file import read_result, write_result
from jiggle_mj.limits import Limits
from jiggle_mj.recording.estimate import EstimateWriter
from jiggle_mj.recording.truth import write_truth
from tests.support.result_keys import KEYS, keys
from tests.support.scored_run import (
    DETECTION,
    EPISODE,
    ESTIMATES,
    REST,
    RUN,
    SHEET,
    STIFFNESS,
    TRUTH,
    scored,
    unscored,
    written,
)


def test_the_keys_are_those_of_the_contract_scored_or_not():
    """As the result file is documented, with `procedure` only where there is one; scoring adds and drops none."""
    assert keys(unscored()) == KEYS
    assert keys(scored()) == KEYS


def test_the_estimators_own_figures_by_hand():
    """Five frames, two used, in 0.1 and 0.3 s, and one skipped: median 0.2 s, 95th percentile 0.1 + 0.95 * 0.2 s."""
    figures = unscored()
    assert (figures["n_particles"], figures["n_frames"], figures["frames"]["used"]) == (6, 5, 2)
    assert figures["frames"]["skipped"] == [{"index": 1, "why": "NaN in the pose"}]
    assert figures["frames"]["not_converged"] == [2]
    assert figures["timing"]["update_s"] == pytest.approx({"median": 0.2, "p95": 0.29})
    assert figures["entropy"] == {"prior": 9.0, "final": 3.0}
    assert figures["detection"]["n_detected"] == 2 and figures["detection"]["n_attached"] is None
    assert figures["detection"]["n_expected"] is None  # the scores 3, 2 and 1 are no probabilities


def test_where_none_is_reported_the_sum_of_the_probabilities_is_said(tmp_path, capsys):
    """0.4 + 0.3 + 0.2 = 0.9 of a particle; with 0.2 alone, none is likelier than one."""
    for p, said in (((0.4, 0.3, 0.2, 0, 0, 0), True), ((0.2, 0, 0, 0, 0, 0), False)):
        soft = replace(DETECTION, attached=np.zeros(6, bool), score=np.array(p), probabilistic=True)
        figures: dict = result(replace(RUN, episode=replace(EPISODE, detection=soft)))
        assert figures["detection"]["n_expected"] == pytest.approx(sum(p))
        show(figures, tmp_path, as_json=False)
        assert ("P(attached) sums to 0.9" in capsys.readouterr().err) is said


def test_the_truths_figures_by_hand():
    """Reported {0, 5}, attached {0, 1}: PCD = PUG = 1/2; scores rank 0, 1 first, so AP = 1; RMS 0.3 mm.

    Same mesh, so b* is unscaled: errors 0.1, -0.2, 0, 0, 0, 0.2 with variance 0.01, NEES/dof = 0.09/0.01/6 = 1.5, of
    the attached 0.05/0.01/2 = 2.5, and four of six lie within 1.645 sd = 0.164, one of the two attached. At one ring 5
    is still no neighbour of 0 or 1 and 0 reaches 1.
    """
    figures = scored()
    assert figures["detection"]["by_dilation"]["0"] == {"pcd": 0.5, "pug": 0.5, "f1": 0.5}
    assert figures["detection"]["by_dilation"]["1"] == pytest.approx({"pcd": 0.5, "pug": 1.0, "f1": 2 / 3})
    assert (figures["detection"]["n_attached"], figures["detection"]["average_precision"]) == (2, 1.0)
    assert figures["calibration"] == {
        "nees_per_dof": pytest.approx(1.5),
        "nees_attached": pytest.approx(2.5),
        "coverage_90": pytest.approx(4 / 6),
        "coverage_attached": pytest.approx(1 / 2),
        "nees_observable": None,
        "coverage_observable": None,
        "ece": None,
    }
    assert figures["tracking"]["rms_m"] == pytest.approx(3e-4)
    assert figures["safety"] == {
        "limit_j": None,
        "max_mean_boundary_energy_j": 0.0,
        "violations": None,
        "limit_n": None,
        "max_force_n": None,
        "force_violations": None,
    }


def test_attachments_that_bore_no_load_do_not_count_as_observable():
    """Only 1 bore 3 mN, above 2.4: its error of -0.2 with a variance of 0.01 gives 4, outside of 90 %."""
    frames = tuple(replace(frame, load=np.array([1e-3, 3e-3, 0, 0, 0, 0])) for frame in TRUTH.frames[-1:])
    figures = scored(truth=replace(TRUTH, frames=frames))
    assert figures["detection"]["n_observable"] == 1
    assert figures["calibration"]["nees_observable"] == pytest.approx(4)
    assert figures["calibration"]["coverage_observable"] == 0


def test_frames_beyond_a_limit_are_counted():
    """Two of six vertices at 0.8 N/m, moved by 0, 1 and 2 mm: 0, 1.3e-7 and 5.3e-7 J, and 0, 0.8 and 1.6 mN."""
    frames = tuple(
        replace(frame, positions=REST + np.array([0, 0, 1e-3 * k]), load=STIFFNESS * 1e-3 * k)
        for k, frame in enumerate(TRUTH.frames)
    )
    safety = scored(truth=replace(TRUTH, frames=frames), limits=Limits(energy=3e-7, force=0.5e-3))["safety"]
    assert safety["max_mean_boundary_energy_j"] == pytest.approx(0.8 * 4e-6 / 6)
    assert safety["max_force_n"] == pytest.approx(1.6e-3)
    assert (safety["violations"], safety["force_violations"]) == (1, 2)


def test_a_tissue_without_attachments_has_no_recall_but_counts_reports():
    free = replace(
        TRUTH, attached=np.zeros(6, bool), frames=tuple(replace(f, stiffness=np.zeros(6)) for f in TRUTH.frames)
    )
    figures = scored(truth=free)["detection"]
    assert (figures["n_detected"], figures["n_attached"], figures["average_precision"]) == (2, 0, None)
    assert figures["by_dilation"]["1"] == {"pcd": 0.0, "pug": None, "f1": 0.0}
    silent = replace(DETECTION, attached=np.zeros(6, bool))
    figures = scored(truth=free, detection=silent)["detection"]
    assert (figures["n_detected"], figures["by_dilation"]["0"]) == (0, {"pcd": None, "pug": None, "f1": None})


def test_scoring_a_folder_gives_the_figures_of_memory_and_keeps_the_timing(tmp_path):
    """The files hold float64, so the figures are equal, and the wall times are those of the first run."""
    folder = written(tmp_path)
    figures = score(folder, folder / "run.truth.mcap")
    assert figures == json.loads((folder / "result.json").read_text()) == json.loads(json.dumps(scored()))
    assert figures["timing"] == unscored()["timing"]


def test_a_folder_that_cannot_be_scored_is_refused_with_what_to_do(tmp_path):
    folder = written(tmp_path)
    with pytest.raises(RecordingError):
        score(folder, folder / "estimate.mcap")
    other = replace(TRUTH, frames=tuple(replace(f, index=f.index + 50) for f in TRUTH.frames))
    write_truth(folder / "other.truth.mcap", other)
    with pytest.raises(RecordingError, match="truth of the same recording"):
        score(folder, folder / "other.truth.mcap")
    write_truth(folder / "moved.truth.mcap", replace(TRUTH, identity="another"))
    with pytest.raises(RecordingError, match="another recording of 'by hand'"):
        score(folder, folder / "moved.truth.mcap")
    with pytest.raises(OutputError, match="is no folder"):
        score(folder / "absent", folder / "run.truth.mcap")
    write_truth(folder / "line.truth.mcap", replace(TRUTH, scene="line"))
    with pytest.raises(RecordingError, match=r"truth of 'line', and .* the estimate of 'by hand'"):
        score(folder, folder / "line.truth.mcap")
    (folder / "estimate.mcap").unlink()
    with EstimateWriter(folder / "estimate.mcap", SHEET, {}) as writer:
        writer.write(ESTIMATES[0])
    with pytest.raises(OutputError, match="ends before its belief"):
        score(folder, folder / "run.truth.mcap")
    for content, complaint in (("{", "is not JSON"), ("{}", "not a result of this program")):
        (folder / "result.json").write_text(content)
        with pytest.raises(OutputError, match=complaint):
            read_result(folder / "result.json")
    with pytest.raises(OutputError, match="cannot be read"):
        read_result(folder / "absent.json")


def test_a_seed_of_any_size_can_be_read_again(tmp_path):
    """A scene's seeds have 32 bits, and those of `--seed` no bound."""
    write_result(tmp_path / "result.json", unscored() | {"seed": 2**64})
    assert read_result(tmp_path / "result.json")["seed"] == 2**64
