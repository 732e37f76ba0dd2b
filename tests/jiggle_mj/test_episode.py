"""The loop and its files: the truth never reaches the estimate, the same seed gives the same bytes."""

from dataclasses import replace

import numpy as np
import pytest

from jiggle_mj.actions import Wait
from jiggle_mj.episode import check_directory, clear_directory, estimate, observe
from jiggle_mj.errors import OutputError, PerceptionError, RecordingError
from jiggle_mj.estimator import Estimator
from jiggle_mj.observation import Declaration
from jiggle_mj.recording.mcap_files import truth_path
from jiggle_mj.recording.reader import Recording
from jiggle_mj.recording.truth import read_truth
from jiggle_mj.recording.writer import RecordingWriter
from jiggle_mj.scenes import Reference, load_scene, programme
from tests.support.recordings import malformed
from tests.support.tiny_scene import scene_file


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A tiny scene on disk, with its truth beside it."""
    folder = tmp_path_factory.mktemp("recorded")
    scene = load_scene(str(scene_file(folder)))
    path = folder / "run.mcap"
    with Reference(scene, seed=0, sensing="particles") as reference:
        seen = list(observe(reference, programme(scene), path, seed=0))
    return path, seen


def estimated(path, out) -> bytes:
    opened = Recording.open(path)
    estimate(opened, Estimator(opened.declaration, opened.camera), out)
    return out.read_bytes()


def test_a_scrambled_truth_leaves_the_estimate_equal_to_the_byte(recording, tmp_path):
    path, _ = recording
    before = estimated(path, tmp_path / "one.mcap")
    truth = truth_path(path)
    kept = truth.read_bytes()
    assert read_truth(truth).attached.any()
    try:
        truth.write_bytes(bytes(255 - byte for byte in kept))
        assert estimated(path, tmp_path / "two.mcap") == before
        truth.unlink()
        assert estimated(path, tmp_path / "three.mcap") == before
    finally:
        truth.write_bytes(kept)


def test_the_recording_gives_the_same_estimate_as_the_live_tissue(recording, tmp_path):
    """The estimate during the simulation equals the estimate from the file, byte by byte."""
    path, seen = recording
    opened = Recording.open(path)
    estimate(seen, Estimator(opened.declaration, opened.camera), tmp_path / "live.mcap")
    assert (tmp_path / "live.mcap").read_bytes() == estimated(path, tmp_path / "file.mcap")


def test_the_truth_file_is_no_recording(recording):
    with pytest.raises(RecordingError, match="truth"):
        Recording.open(truth_path(recording[0]))


def test_every_action_is_one_frame_of_recording_and_truth(recording):
    path, seen = recording
    indices = [observation.index for observation in seen]
    assert [observation.index for observation in Recording.open(path)] == indices
    assert [frame.index for frame in read_truth(truth_path(path)).frames] == indices


def test_frames_without_closed_jaws_cannot_be_estimated(tmp_path):
    scene = load_scene(str(scene_file(tmp_path)))
    with Reference(scene, seed=0, sensing="particles") as reference:
        frames = list(observe(reference, [Wait(), Wait()], seed=0))
        with pytest.raises(PerceptionError, match="none has closed jaws"):
            estimate(frames, Estimator(reference.declaration))


def test_frames_that_the_recording_skips_are_named_when_none_remains(recording, tmp_path):
    """The tool pose is NaN in every frame: the error names that reason, not open jaws."""
    _, seen = recording
    path = tmp_path / "blind.mcap"
    with RecordingWriter(path, camera=None, declaration=Declaration(), metadata={}) as writer:
        for observation in seen[:4]:
            blind = malformed(observation.tool, position=np.full(3, np.nan))
            writer.write(replace(observation, tool=blind))
    opened = Recording.open(path)
    with pytest.raises(PerceptionError, match="frame 0: NaN"):
        estimate(opened, Estimator(opened.declaration))


def test_frames_skipped_by_recording_and_estimator_are_counted_together(recording, tmp_path):
    _, seen = recording
    first = [observation for observation in seen if observation.tool.closed][1]
    lost = replace(first, index=first.index + 1, tool=malformed(first.tool, position=np.full(3, np.nan)))
    nowhere = replace(first.points, positions=np.full_like(first.points.positions, np.nan))
    hidden = replace(seen[lost.index + 1], points=nowhere)
    with RecordingWriter(tmp_path / "gaps.mcap", camera=None, declaration=Declaration(), metadata={}) as writer:
        for observation in (*seen[: lost.index], replace(lost, time=seen[lost.index].time), hidden):
            writer.write(observation)
    opened = Recording.open(tmp_path / "gaps.mcap")
    episode = estimate(opened, Estimator(opened.declaration))
    assert [index for index, _ in episode.skipped] == [lost.index, hidden.index]
    assert (episode.n_frames, len(episode.estimates)) == (hidden.index + 1, 2)


@pytest.mark.parametrize("unreadable", [True, False])
def test_a_recording_that_shows_the_sheet_in_one_frame_of_four_gives_no_estimate(recording, tmp_path, unreadable):
    """Whether the recording or the estimator skips the others: one frame is no result, and the first is named."""
    _, seen = recording
    k = next(observation.index for observation in seen if observation.tool.closed)
    with RecordingWriter(tmp_path / "lost.mcap", camera=None, declaration=Declaration(), metadata={}) as writer:
        for observation in seen[: k + 1]:
            writer.write(observation)
        for j in range(1, 4):
            later = replace(seen[k], index=k + j, time=seen[k].time + j * 10**8)
            nowhere = replace(later.points, positions=np.full_like(later.points.positions, np.nan))
            off = malformed(later.tool, position=np.full(3, np.nan))
            writer.write(replace(later, tool=off) if unreadable else replace(later, points=nowhere))
    opened = Recording.open(tmp_path / "lost.mcap")
    with pytest.raises(PerceptionError, match=f"3 of 4 frames with closed jaws .* at most 60%.* frame {k + 1}: "):
        estimate(opened, Estimator(opened.declaration))


def test_a_folder_with_results_is_kept_unless_overwriting_is_allowed(tmp_path):
    for name in ("run.mcap", "mine.txt"):
        (tmp_path / name).write_text("kept")
    with pytest.raises(OutputError, match=r"already holds run\.mcap; choose another folder or pass --overwrite"):
        check_directory(tmp_path, ["run.mcap"], overwrite=False)
    assert (tmp_path / "run.mcap").read_text() == "kept"
    check_directory(tmp_path, ["run.mcap"], overwrite=True)
    assert (tmp_path / "run.mcap").exists()
    clear_directory(tmp_path, ["run.mcap"])
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_a_file_in_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(OutputError, match="is a file; give a folder"):
        check_directory(tmp_path / "out", ["run.mcap"], overwrite=True)
