import io
import shutil
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.rosbag1 import Writer as Writer1

from jiggle_mj import Recording
from jiggle_mj.errors import OutputError, RecordingError
from jiggle_mj.importing.bags.bag_file import Bag
from jiggle_mj.importing.bags.bag_paths import is_bag
from jiggle_mj.importing.bags.gripper import ClosedRule
from jiggle_mj.importing.bags.importer import import_bag
from jiggle_mj.importing.bags.settings import BagSettings
from tests.support.robot_bags import (
    EPOCH,
    STEP,
    RobotBag,
    small_bag,
    small_camera,
    small_image,
    write_images,
    write_tool,
)

LIMIT = "jiggle_mj.importing.bags.compression.MAX_CHUNK_BYTES"
KINDS = ("ros1", "mcap", "mcap-zstd", "sqlite3", "sqlite3-message", "sqlite3-file")


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_of_each_kind_becomes_the_recording_that_was_seen(tmp_path: Path, kind):
    """Images bit by bit, the tool where it was, time from the first frame, and grasps counted."""
    import_bag(small_bag(tmp_path / "bag", kind), tmp_path / "run.mcap")
    recording = Recording.open(tmp_path / "run.mcap")
    seen = list(recording)
    assert recording.camera is not None and not recording.skipped
    np.testing.assert_array_equal(recording.camera.T_world_camera, small_camera().T_world_camera)
    assert [each.time for each in seen] == [0, STEP, 2 * STEP, 3 * STEP]
    assert [(each.tool.closed, each.tool.grasp) for each in seen] == [(False, 0)] + 3 * [(True, 1)]
    for index, each in enumerate(seen):
        np.testing.assert_array_equal(each.images.left, small_image(2 * index))
        np.testing.assert_array_equal(each.images.right, small_image(2 * index + 1))
        np.testing.assert_array_equal(each.tool.position, [1e-3 * index, 0.02, 0.0])


@pytest.mark.parametrize("compression", [Writer1.CompressionFormat.LZ4, Writer1.CompressionFormat.BZ2])
def test_the_chunks_of_a_compressed_ros_1_bag_are_bounded(tmp_path: Path, monkeypatch, compression):
    """A small file must not fill the memory; the limit is lowered, as a bag beyond it would take seconds to write."""
    made = RobotBag(tmp_path / "bag", "ros1")
    made.writer.set_compression(compression)
    with made:
        made.cameras(small_camera())
        write_images(made)
        write_tool(made)
    import_bag(made.path, tmp_path / "run.mcap", BagSettings(closed=ClosedRule.parse("always")))
    assert len(list(Recording.open(tmp_path / "run.mcap"))) == 4
    monkeypatch.setattr(LIMIT, 10_000)
    with pytest.raises(RecordingError, match="more than 10000 bytes once decompressed"):
        import_bag(made.path, tmp_path / "other.mcap", BagSettings(closed=ClosedRule.parse("always")))


def test_the_messages_of_a_compressed_ros_2_bag_are_bounded(tmp_path: Path, monkeypatch):
    """An image of 32x24 pixels has 2304 bytes."""
    path = small_bag(tmp_path / "bag", "sqlite3-message")
    monkeypatch.setattr(LIMIT, 2000)
    with pytest.raises(RecordingError, match="a message of the bag has more than 2000 bytes once decompressed"):
        import_bag(path, tmp_path / "run.mcap")


def test_the_bytes_depend_on_the_content_alone(tmp_path: Path):
    """A ROS 1 file, a ROS 2 folder, its storage file alone, and a folder without metadata.yaml give the same bytes."""
    folder = small_bag(tmp_path / "bag")
    bare = tmp_path / "bare"
    shutil.copytree(folder, bare)
    (bare / "metadata.yaml").unlink()
    bags = (small_bag(tmp_path / "other", "ros1"), folder, folder / "bag.mcap", bare)
    written = []
    for number, bag in enumerate(bags):
        import_bag(bag, tmp_path / f"{number}.mcap")
        written.append((tmp_path / f"{number}.mcap").read_bytes())
    assert all(each == written[0] for each in written)


def test_an_mcap_of_ros_1_messages_is_read(tmp_path: Path):
    """As converters of ROS 1 bags write it: encoding ros1, schemas ros1msg."""
    with RobotBag(tmp_path / "bag", "ros1") as bag:
        bag.cameras(small_camera())
        write_tool(bag)
        write_images(bag)
    buffer = io.BytesIO()
    writer = Writer(buffer)
    writer.start(profile="ros1")
    channels = {}
    with Bag(bag.path) as source:
        for name, topic in source.topics.items():
            kind = topic.type.replace("/msg/", "/")
            schema = writer.register_schema(kind, "ros1msg", topic.definition.encode())
            channels[name] = writer.register_channel(name, "ros1", schema)
        for name, received, data in source.raw(set(source.topics)):
            writer.add_message(channels[name], log_time=received, publish_time=received, data=bytes(data))
    writer.finish()
    (tmp_path / "one.mcap").write_bytes(buffer.getvalue())
    import_bag(tmp_path / "one.mcap", tmp_path / "run.mcap")
    import_bag(bag.path, tmp_path / "same.mcap")
    assert (tmp_path / "run.mcap").read_bytes() == (tmp_path / "same.mcap").read_bytes()


@pytest.mark.parametrize("kind", ("ros1", "mcap", "mcap-zstd", "sqlite3"))
@pytest.mark.parametrize("share", (0.1, 0.6, 0.97))
def test_a_truncated_bag_is_one_line_and_leaves_nothing(tmp_path: Path, kind, share: float):
    path = small_bag(tmp_path / "bag", kind)
    file = path if path.is_file() else next(each for each in path.iterdir() if each.suffix in (".mcap", ".db3"))
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    with pytest.raises(RecordingError) as failure:
        import_bag(path, tmp_path / "run.mcap")
    assert "\n" not in str(failure.value) and len(str(failure.value)) < 600
    assert not [each for each in tmp_path.iterdir() if "run.mcap" in each.name]


@pytest.mark.parametrize("kind", ("ros1", "mcap", "mcap-zstd", "sqlite3"))
def test_a_damaged_bag_raises_our_errors_only(tmp_path: Path, kind):
    """Twelve files with three bytes of each replaced, seeds 0 to 11; some are still read."""
    path = small_bag(tmp_path / "bag", kind, n=2)
    file = path if path.is_file() else next(each for each in path.iterdir() if each.suffix in (".mcap", ".db3"))
    data = file.read_bytes()
    for seed in range(12):
        generator = np.random.default_rng(seed)
        damaged = bytearray(data)
        for place in generator.integers(0, len(data), 3):
            damaged[place] = generator.integers(256)
        file.write_bytes(damaged)
        try:
            import_bag(path, tmp_path / "run.mcap", overwrite=True)
        except (RecordingError, OutputError) as failure:
            assert "\n" not in str(failure)


def test_a_definition_that_nobody_reads_stops_nothing(tmp_path: Path):
    """A type of one's own whose definition is no ROS definition: the topic is not read, and is listed."""
    folder = small_bag(tmp_path / "bag")
    path, writer, ids = tmp_path / "one.mcap", io.BytesIO(), {}
    output = Writer(writer)
    output.start(profile="ros2")
    with Bag(folder) as source:
        for name, topic in source.topics.items():
            schema = output.register_schema(topic.type, "ros2msg", topic.definition.encode())
            ids[name] = output.register_channel(name, "cdr", schema)
        schema = output.register_schema("my_msgs/msg/Odd", "ros2msg", b"this is ( no definition")
        ids["/odd"] = output.register_channel("/odd", "cdr", schema)
        output.add_message(ids["/odd"], log_time=EPOCH, publish_time=EPOCH, data=b"abc")
        for name, received, data in source.raw(set(source.topics)):
            output.add_message(ids[name], log_time=received, publish_time=received, data=bytes(data))
    output.finish()
    path.write_bytes(writer.getvalue())
    import_bag(path, tmp_path / "run.mcap")
    assert len(Recording.open(tmp_path / "run.mcap")) == 4
    with Bag(path) as bag:
        assert bag.topics["/odd"].count == 1
        with pytest.raises(RecordingError, match=r"my_msgs/msg/Odd. cannot be read"):
            next(bag.messages(["/odd"]))


def test_a_name_longer_than_ros_allows_is_refused(tmp_path: Path):
    with RobotBag(tmp_path / "bag") as bag:
        bag.image("/" + "x" * 255, 0, "rgb8", small_image(0))
    with pytest.raises(RecordingError, match=r"name of topic '/x+\.\.\.' is 256 characters long; at most 255"):
        import_bag(bag.path, tmp_path / "run.mcap")


def test_what_is_no_bag_is_named(tmp_path: Path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.bag").write_text("no bag")
    for path, message in (
        (tmp_path / "nothing.bag", "no such file"),
        (tmp_path / "empty", "holds no bag"),
        (tmp_path / "text.bag", "cannot be read"),
    ):
        with pytest.raises(RecordingError, match=message):
            import_bag(path, tmp_path / "run.mcap")
    assert not is_bag(tmp_path / "empty")


def test_a_recording_is_no_bag(tmp_path: Path):
    import_bag(small_bag(tmp_path / "bag"), tmp_path / "run.mcap")
    with pytest.raises(RecordingError, match="is a recording already"):
        import_bag(tmp_path / "run.mcap", tmp_path / "again.mcap")


def test_a_bag_is_no_recording(tmp_path: Path):
    folder = small_bag(tmp_path / "bag")
    for path in (folder, folder / "bag.mcap", small_bag(tmp_path / "one", "ros1")):
        with pytest.raises(RecordingError, match="import it first: jiggle-mj import"):
            Recording.open(path)


def test_an_output_that_exists_is_kept(tmp_path: Path):
    (tmp_path / "run.mcap").write_text("mine")
    with pytest.raises(OutputError, match="--overwrite"):
        import_bag(small_bag(tmp_path / "bag"), tmp_path / "run.mcap")
    assert (tmp_path / "run.mcap").read_text() == "mine"


def test_the_clock_of_the_robot_is_in_the_bag_alone(tmp_path: Path):
    with Bag(small_bag(tmp_path / "bag")) as bag:
        assert next(bag.messages(["/tool/pose"])).received == EPOCH


def test_a_cut_mcap_is_read_as_far_as_it_goes_where_the_user_allows_it(tmp_path: Path):
    """rosbags closes a chunk after each MiB; what follows the padding is cut."""
    with RobotBag(tmp_path / "bag") as bag:
        bag.cameras(small_camera())
        write_tool(bag, 80)
        write_images(bag, 80)
        bag.write("/padding", 0, "std_msgs/String", data="x" * 2**20)
        write_images(bag, 40)
    file = bag.path / "bag.mcap"
    data = file.read_bytes()
    file.write_bytes(data[: len(data) - 40_000])
    with pytest.raises(RecordingError, match="--allow-truncated"):
        import_bag(bag.path, tmp_path / "run.mcap")
    assert import_bag(bag.path, tmp_path / "run.mcap", BagSettings(allow_truncated=True)).n_frames == 80
