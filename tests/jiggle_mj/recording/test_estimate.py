"""Estimates are read back as written, in the same bytes, and a crash leaves what came before."""

from dataclasses import fields, replace

import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader

from jiggle_mj.errors import OutputError, RecordingError
from jiggle_mj.estimate import Belief, Detection, Estimate, KeptFrames, Sheet
from jiggle_mj.recording.estimate import (
    BELIEF,
    DETECTION,
    RESULT_RECORD,
    SHEET,
    EstimateRecording,
    EstimateWriter,
    read_estimate,
    stiffness_colours,
)
from jiggle_mj.recording.mcap_files import McapOutput

N = 6


def sheet() -> Sheet:
    return Sheet(rest=np.random.default_rng(1).normal(size=(N, 3)), faces=np.array([[0, 1, 2], [1, 3, 2], [3, 4, 5]]))


def estimate(index: int, **changes) -> Estimate:
    generator = np.random.default_rng(index)
    observed = generator.normal(size=(N, 3))
    observed[index % N] = np.nan
    values = {
        "index": index,
        "time": index * 10**9 + 1,
        "positions": generator.normal(size=(N, 3)),
        "observed": observed,
        "mean": generator.uniform(0, 2, N),
        "sd": generator.uniform(0, 2, N),
        "probability": generator.uniform(0, 1, N),
        "held": generator.uniform(size=N) > 0.5,
        "entropy": -1 / 3,
        "nis": np.nan,
        "boundary_energy": 1e-7 / 3,
        "update_s": 0.123 * (index + 1),
        "perception_s": 0.456,
        "converged": index != 1,
    }
    return Estimate(**(values | changes))


def belief() -> Belief:
    root = np.random.default_rng(2).normal(size=(N, N))
    return Belief(
        mean=np.linspace(-1, 1, N) / 3,
        covariance=root @ root.T,
        reference=30.0,
        lower=np.zeros(N),
        upper=np.full(N, np.inf),
    )


def detection() -> Detection:
    score = np.linspace(0, 1, N) / 3
    return Detection(
        attached=score > 0.2,
        score=score,
        stiffness=3 * score,
        stiffness_sd=score,
        rule="score > 0.2",
        probabilistic=True,
    )


def test_an_estimate_is_read_back_exactly_but_for_wall_times(tmp_path):
    given = [estimate(index) for index in (0, 1, 4)]
    with EstimateWriter(tmp_path / "estimate.mcap", sheet(), {"recording": "run.mcap"}) as writer:
        for each in given:
            writer.write(each)
        writer.finish(belief(), detection(), skipped=[(2, "NaN in the pose"), (3, "time goes backwards")])
    read = read_estimate(tmp_path / "estimate.mcap")
    for actual, expected in ((read.sheet, sheet()), (read.belief, belief()), (read.detection, detection())):
        for f in fields(expected):
            np.testing.assert_array_equal(getattr(actual, f.name), getattr(expected, f.name))
    for actual, written in zip(read.estimates, given, strict=True):
        expected = replace(written, update_s=0.0, perception_s=0.0)
        for f in fields(Estimate):
            np.testing.assert_array_equal(getattr(actual, f.name), getattr(expected, f.name))
    assert read.skipped == ((2, "NaN in the pose"), (3, "time goes backwards"))
    assert read.metadata["recording"] == "run.mcap"


def test_same_estimate_gives_same_bytes_whatever_the_clock_said(tmp_path):
    for name, seconds in (("a.mcap", 0.1), ("b.mcap", 0.2)):
        with EstimateWriter(tmp_path / name, sheet(), {}) as writer:
            writer.write(estimate(0, update_s=seconds, perception_s=2 * seconds))
            writer.finish(belief(), detection())
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def kept() -> KeptFrames:
    generator = np.random.default_rng(3)
    root = generator.normal(size=(3, N, 3, 3))
    return KeptFrames(
        grasp=np.array([0, 0, 1]),
        x=generator.normal(size=(3, N, 3)),
        y=generator.normal(size=(3, N, 3)),
        precision=root @ np.swapaxes(root, 2, 3),
        held=generator.uniform(size=(3, N)) > 0.5,
        force_unknown=generator.uniform(size=(3, N)) > 0.5,
        fields=generator.normal(size=(N, 2)),
        force_index=np.array([0, 2]),
        pull=generator.normal(size=(2, 3)),
        pull_covariance=np.stack([np.eye(3), np.full((3, 3), np.nan)]),
        offset_sd=np.array([0.1, np.nan]),
        offset_number=np.array([0, 1]),
    )


def written_with(path, frames: KeptFrames) -> EstimateRecording:
    with EstimateWriter(path, sheet(), {}) as writer:
        writer.write(estimate(0))
        writer.finish(belief(), detection(), frames=frames)
    return read_estimate(path)


@pytest.mark.parametrize("changes", [{}, {"fields": None}])
def test_kept_frames_are_read_back_exactly(tmp_path, changes):
    given = replace(kept(), **changes)
    read = written_with(tmp_path / "estimate.mcap", given).frames
    assert read is not None
    for f in fields(KeptFrames):
        np.testing.assert_array_equal(getattr(read, f.name), getattr(given, f.name))


@pytest.mark.parametrize(
    "changes",
    [
        {"grasp": np.array([1, 0, 1])},
        {"x": np.full((3, N, 3), np.nan)},
        {"precision": -kept().precision},
        {"force_index": np.array([0, 3])},
        {"force_index": np.array([1, 1])},
        {"pull": np.full((2, 3), np.nan)},
    ],
)
def test_damaged_frames_are_refused(tmp_path, changes):
    with pytest.raises(RecordingError, match=r"frames\.npz|is damaged"):
        written_with(tmp_path / "estimate.mcap", replace(kept(), **changes))


def test_an_unfinished_estimate_has_no_belief(tmp_path):
    """After a crash, and after `close` without `finish`, the estimates are there and the belief is None."""
    crashed = tmp_path / "crashed.mcap"
    with EstimateWriter(tmp_path / "estimate.mcap", sheet(), {}) as writer:
        writer.write(estimate(0))
        crashed.write_bytes((tmp_path / "estimate.mcap.part").read_bytes())
    with pytest.raises(RecordingError, match=r"truncated: .* Estimate the recording again"):
        read_estimate(crashed)
    for read in (read_estimate(crashed, allow_truncated=True), read_estimate(tmp_path / "estimate.mcap")):
        assert len(read.estimates) == 1 and read.belief is None and read.detection is None and read.skipped == ()


def test_the_drawn_mesh_is_the_sheet_in_the_colours_of_b(tmp_path):
    given = estimate(3, mean=np.array([0, 0.5, 1, 2, 50, np.inf]))
    with EstimateWriter(tmp_path / "estimate.mcap", sheet(), {}) as writer:
        writer.write(given)
    with open(tmp_path / "estimate.mcap", "rb") as file:
        ((schema, _, message),) = make_reader(file, validate_crcs=True).iter_messages(topics=["/estimate/mesh"])
    assert schema.name == "foxglove.SceneUpdate"
    (entity,) = SceneUpdate.FromString(message.data).entities
    (triangles,) = entity.triangles
    assert entity.frame_id == "world" and entity.timestamp.seconds == 3 and triangles.pose.orientation.w == 1
    np.testing.assert_array_equal([[p.x, p.y, p.z] for p in triangles.points], given.positions)
    assert list(triangles.indices) == sheet().faces.ravel().tolist()
    colours = np.array([[c.r, c.g, c.b, c.a] for c in triangles.colors])
    assert len(colours) == N and (colours[:, 3] == 1).all()
    brightness = colours[:, :3] @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(brightness) > 0).all(), "stiffer is brighter, also in grey"


def test_colours_keep_to_their_range():
    colours = stiffness_colours(np.array([-1.0, 0.0, 1e9, np.inf]))
    assert (colours >= 0).all() and (colours <= 1).all()
    np.testing.assert_array_equal(colours[0], colours[1])


def test_what_is_no_estimate_is_refused(tmp_path):
    with McapOutput(tmp_path / "other.mcap") as output:
        output.json("/joint_states", 0, {}, schema={"title": "joints"})
    with pytest.raises(RecordingError, match=r"is not an estimate.*: /joint_states\."):
        read_estimate(tmp_path / "other.mcap")
    with pytest.raises(RecordingError, match="cannot be read"):
        read_estimate(tmp_path / "missing.mcap")


def test_an_estimate_without_a_field_of_this_version_is_refused(tmp_path):
    """The file of another version, whose `Detection` has no `score`."""
    columns = {f.name: getattr(detection(), f.name) for f in fields(Detection) if f.name not in ("score", "rule")}
    with McapOutput(tmp_path / "estimate.mcap") as output:
        output.arrays(SHEET, {"rest": sheet().rest, "faces": sheet().faces})
        output.arrays(BELIEF, {"mean": belief().mean, "covariance": belief().covariance})
        output.arrays(DETECTION, {name: np.asarray(value) for name, value in columns.items() if value is not None})
        output.metadata(RESULT_RECORD, {"rule": "any", "skipped": "[]"})
    with pytest.raises(RecordingError, match=r"another version of jiggle-mj.*lacks score\. Estimate again"):
        read_estimate(tmp_path / "estimate.mcap")


def test_an_existing_estimate_is_not_overwritten_unasked(tmp_path):
    EstimateWriter(tmp_path / "estimate.mcap", sheet(), {}).close()
    with pytest.raises(OutputError, match="exists"):
        EstimateWriter(tmp_path / "estimate.mcap", sheet(), {})
