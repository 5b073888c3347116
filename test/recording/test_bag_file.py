import shutil
import sqlite3
from contextlib import closing, contextmanager, suppress

import numpy as np
import pytest
import yaml

pytest.importorskip("rosbags", reason="needs the extra 'bags'")

import bags
from bags import storage_file

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.recording.bag_file import open_bag
from nics_drl_bridge.recording.readers import read_recording
from nics_drl_bridge.robot.spec import load_robot

CAR = load_robot("ackermann")
STORAGES = ("mcap", "sqlite3")
ONE_SENTENCE = 420  # characters; longer is a dump


def refused(path) -> str:
    """The one sentence with which a bag is refused; it begins with the place."""
    with pytest.raises(RecordingError) as caught:
        read_recording(path, CAR)
    sentence = str(caught.value)
    assert sentence.startswith(str(path))
    assert "\n" not in sentence
    assert sentence.endswith(".")
    assert len(sentence) - len(str(path)) < ONE_SENTENCE
    return sentence.removeprefix(str(path))


@contextmanager
def metadata(bag):
    """The content of metadata.yaml, to be changed."""
    file = bag / "metadata.yaml"
    data = yaml.safe_load(file.read_text(encoding="utf-8"))
    yield data["rosbag2_bagfile_information"]
    file.write_text(yaml.safe_dump(data), encoding="utf-8")


def same(one, other) -> bool:
    return all(
        np.array_equal(stream.values, other.streams[name].values)
        and np.array_equal(stream.t, other.streams[name].t)
        for name, stream in one.streams.items()
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A whole bag of each storage."""
    folder = tmp_path_factory.mktemp("whole")
    return {each: bags.write(folder / each, bags.drive(), each) for each in STORAGES}


@pytest.fixture(params=STORAGES)
def pristine(request, whole):
    return whole[request.param]


@pytest.fixture
def bag(pristine, tmp_path):
    return shutil.copytree(pristine, tmp_path / "bag")


def test_the_folder_its_file_and_the_file_alone_give_the_same_drive(bag, tmp_path):
    whole = read_recording(bag, CAR)
    assert same(whole, read_recording(storage_file(bag), CAR))
    (tmp_path / "alone").mkdir()
    alone = shutil.copy(storage_file(bag), tmp_path / "alone")
    assert same(whole, read_recording(alone, CAR))
    assert same(whole, read_recording(tmp_path / "alone", CAR))


@pytest.mark.parametrize(
    ("storage", "compression"),
    [
        ("mcap", "file"),
        ("mcap", "message"),
        ("mcap", "storage"),
        ("sqlite3", "file"),
        ("sqlite3", "message"),
    ],
)
def test_a_compressed_bag_gives_the_same_drive(whole, tmp_path, storage, compression):
    small = bags.write(tmp_path / "small", bags.drive(), storage, compression)
    plain = whole[storage]
    assert storage_file(small).stat().st_size != storage_file(plain).stat().st_size
    drive = read_recording(plain, CAR)
    for path in (small, storage_file(small)):
        assert same(drive, read_recording(path, CAR))


def test_a_compressed_file_without_its_folder_is_refused(tmp_path):
    bag = bags.write(tmp_path / "bag", bags.drive(), "sqlite3", "file")
    (bag / "metadata.yaml").unlink()
    assert "unpack it with `zstd -d`" in refused(storage_file(bag))


def test_a_bag_in_several_files_is_read_whole(tmp_path):
    bag = bags.write(tmp_path / "bag", bags.drive())
    later = bags.write(tmp_path / "later", bags.drive(delay=bags.DURATION_S))
    shutil.copy(storage_file(later), bag / "bag_1.mcap")
    with metadata(bag) as told:
        told["relative_file_paths"].append("bag_1.mcap")
        told["duration"]["nanoseconds"] += bags.ns(bags.DURATION_S) - bags.ns(0.0)
        told["message_count"] *= 2
        for topic in told["topics_with_message_count"]:
            topic["message_count"] *= 2
    assert len(read_recording(bag, CAR).command.t) == 2 * len(bags.commands())
    assert len(read_recording(bag / "bag.mcap", CAR).command.t) == len(bags.commands())
    (bag / "metadata.yaml").unlink()
    assert "contains 2 bag files but no metadata.yaml" in refused(bag)


@pytest.mark.parametrize(
    ("share", "alone"), [(0.0, False), (0.3, True), (0.99, False), (0.99, True)]
)
def test_a_cut_file_is_refused(bag, share, alone):
    file = storage_file(bag)
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    if alone:
        (bag / "metadata.yaml").unlink()
    refused(file if alone else bag)


def test_a_fault_of_the_code_that_reads_a_bag_is_not_told_as_damage(bag):
    with pytest.raises(KeyError, match="wheels"), open_bag(bag) as opened:
        opened.types["wheels"]


@pytest.mark.parametrize("seed", range(5))
def test_flipped_bytes_never_lose_messages_or_end_in_a_traceback(bag, seed):
    """A number may be another one, which no checksum of a bag tells; but none goes missing."""
    rng = np.random.default_rng(seed)
    file = storage_file(bag)
    data = np.frombuffer(file.read_bytes(), dtype=np.uint8).copy()
    data[rng.integers(len(data), size=3)] ^= np.uint8(1 << rng.integers(8))
    file.write_bytes(data.tobytes())
    with suppress(RecordingError):
        read = read_recording(bag, CAR)
        assert len(read.command.t) == len(bags.commands())
        assert len(read.pose.t) == len(bags.poses())


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (
            "DELETE FROM messages WHERE id % 50 = 0",
            "has 294 messages, by the summary 300",
        ),
        (
            "UPDATE messages SET timestamp = timestamp + 3600000000000 WHERE id = 77",
            "outside of the time span",
        ),
        (
            "UPDATE messages SET data = x'0001' WHERE id = 8",
            "topic '/cmd_vel': message 7 can't be decoded as geometry_msgs/msg/Twist",
        ),
    ],
    ids=["missing", "out_of_time", "garbled"],
)
def test_messages_that_do_not_fit_the_bags_summary_are_refused(tmp_path, damage, said):
    bag = bags.write(tmp_path / "bag", bags.drive(), "sqlite3")
    with closing(sqlite3.connect(storage_file(bag))) as base, base:
        base.execute(damage)
    assert said in refused(bag)


@pytest.mark.parametrize("sign", ["?", "#", "%20"])
def test_a_path_that_sqlite_can_not_open_is_no_damage(pristine, tmp_path, sign):
    bag = shutil.copytree(pristine, tmp_path / f"drive{sign}1")
    if storage_file(bag).suffix == ".mcap":
        assert len(read_recording(bag, CAR).command.t) == len(bags.commands())
    else:
        assert "rename the folder" in refused(bag)


@pytest.mark.parametrize("text", ["", "a: [", "just: this\n", "\x00"])
def test_damaged_metadata_is_refused(bag, text):
    (bag / "metadata.yaml").write_text(text, encoding="utf-8")
    assert "ros2 bag reindex" in refused(bag)


def test_a_database_that_was_not_closed_is_refused(tmp_path):
    bag = bags.write(tmp_path / "bag", bags.drive(), "sqlite3")
    file = storage_file(bag)
    file.with_name(f"{file.name}-wal").write_bytes(b"the rest of the drive")
    assert "was not closed" in refused(bag)


@pytest.mark.parametrize("storage", STORAGES)
def test_a_bag_without_messages_is_refused(tmp_path, storage):
    kinds = {"/cmd_vel": bags.kinds.TWIST, "/pose": bags.kinds.POSE}
    topics: dict = {topic: [] for topic in kinds}
    bag = bags.write(tmp_path / "bag", topics, storage, kinds_of=kinds)
    assert "contains no messages" in refused(bag)


def test_a_damaged_bag_of_ros_1_comes_with_the_way_to_mend_it(tmp_path):
    (tmp_path / "drive.bag").write_bytes(b"#ROSBAG V2.0\n")
    assert "rosbag reindex" in refused(tmp_path / "drive.bag")


def rename(told, k, name):
    told["topics_with_message_count"][k]["topic_metadata"]["name"] = name


def count(told, k, more):
    told["topics_with_message_count"][k]["message_count"] += more


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda told: told.update(version=99), "99"),
        (lambda told: count(told, 0, -3), "by the summary"),
        (lambda told: rename(told, 0, None), "lost the name of a topic"),
        (lambda told: rename(told, 1, ""), "lost the name of a topic"),
        (lambda told: rename(told, 1, 7), "lost the name of a topic"),
    ],
)
def test_a_summary_that_contradicts_itself_or_the_files_is_refused(bag, change, fault):
    with metadata(bag) as told:
        change(told)
    assert fault in refused(bag)
