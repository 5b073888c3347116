import pytest

pytest.importorskip("rosbags", reason="needs the extra 'bags'")
pytest.importorskip("mcap", reason="needs the extra 'bags'")

import struct
import zlib
from mmap import ACCESS_READ, mmap

import lz4.frame
import yaml
from mcap.records import DataEnd
from mcap.writer import CompressionType, IndexType, Writer

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.recording import mcap, messages
from nics_drl_bridge.recording.bag_file import open_bag
from nics_drl_bridge.recording.mcap import (
    check_mcap,
    check_message,
    read_records,
    unpack,
    unpack_file,
    write_checksums,
)

TWIST = "geometry_msgs/msg/Twist"
COUNT = 200
MAGIC = b"\x89MCAP0\r\n"
DATA = b"\x00\x01\x00\x00" + struct.pack("<6d", 1.0, 0.0, 0.0, 0.0, 0.0, 0.5)
FORMS = {
    "zstd": {"compression": CompressionType.ZSTD},
    "lz4": {"compression": CompressionType.LZ4},
    "plain": {"compression": CompressionType.NONE},
    "no chunks": {"use_chunking": False},
    "sealed": {"enable_data_crcs": True},
    "bare": {
        "compression": CompressionType.NONE,
        "index_types": IndexType.NONE,
        "enable_crcs": False,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_statistics": False,
        "use_summary_offsets": False,
    },
}


def written(path, size=2000, data=DATA, **options):
    """A file of the library's own writer, with a topic and an attachment."""
    writer = Writer(str(path), chunk_size=size, **options)
    writer.start(profile="ros2", library="test")
    schema = writer.register_schema(TWIST, "ros2msg", b"geometry_msgs/Vector3 linear")
    channel = writer.register_channel("/cmd_vel", "cdr", schema)
    for k in range(COUNT):
        writer.add_message(channel, 10**9 + k, data, 10**9 + k)
    writer.add_attachment(0, 0, "note", "text/plain", b"a note")
    writer.finish()
    return path


def refused(path, said=""):
    with pytest.raises(RecordingError, match=said), open_bag(path):
        pass


def mapped(path):
    """The records of a file, with the offset after each."""
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        return list(read_records(data))


@pytest.mark.parametrize("form", FORMS)
def test_files_of_another_writer_are_whole(tmp_path, form):
    path = written(tmp_path / "drive.mcap", **FORMS[form])
    check_mcap(path)
    with open_bag(path) as bag:
        assert len(bag.read_serialized("/cmd_vel")) == COUNT
    write_checksums(path)  # changes nothing that is read
    check_mcap(path)


@pytest.mark.parametrize("form", ["zstd", "no chunks", "bare"])
def test_a_file_that_is_cut_off_anywhere_or_goes_on_is_refused(tmp_path, form):
    path = written(tmp_path / "drive.mcap", **FORMS[form])
    data = path.read_bytes()
    cut = [data[:end] for end in range(0, len(data), len(data) // 20)]
    for damaged in (*cut, *(part + MAGIC for part in cut), data + b"more"):
        path.write_bytes(damaged)
        refused(path)


def test_a_chunk_that_unpacks_to_too_much_is_refused_before_it_is_unpacked(
    tmp_path, monkeypatch
):
    """Also in a file without summary, whose chunks rosbags unpacks when it opens it."""
    path = written(
        tmp_path / "drive.mcap", size=2**22, data=DATA + bytes(2**14), **FORMS["zstd"]
    )
    monkeypatch.setattr(mcap, "MOST_UNPACKED", 2**20)
    for data in (path.read_bytes(), without_summary(path)):
        path.write_bytes(data)
        for place in (path, packed_as_a_whole(tmp_path / "bag", data)):
            refused(place, "more than 1048576 bytes")


def packed_as_a_whole(folder, data):
    folder.mkdir(exist_ok=True)
    (folder / "drive.mcap.zstd").write_bytes(mcap._import_zstd().compress(data))
    about = {"compression_mode": "FILE", "relative_file_paths": ["drive.mcap.zstd"]}
    text = yaml.safe_dump({"rosbag2_bagfile_information": about})
    (folder / "metadata.yaml").write_text(text, encoding="utf-8")
    return folder


def find_data_end(path):
    return next(end for end, each in mapped(path) if isinstance(each, DataEnd))


def without_summary(path):
    data = path.read_bytes()[: find_data_end(path) - 4] + bytes(4)
    return data + struct.pack("<BQ20s", 2, 20, bytes(20)) + MAGIC


def test_a_file_without_summary_is_read(tmp_path):
    path = written(tmp_path / "drive.mcap")
    path.write_bytes(without_summary(path))
    check_mcap(path)
    with open_bag(path) as bag:
        assert len(bag.read_serialized("/cmd_vel")) == COUNT


def test_a_flipped_bit_of_a_sealed_file_is_found(tmp_path):
    path = written(tmp_path / "drive.mcap", **FORMS["sealed"])
    data = path.read_bytes()
    end = find_data_end(path) - 13
    assert zlib.crc32(data[:end]) == struct.unpack_from("<I", data, end + 9)[0]
    for place in range(len(MAGIC), len(data), 101):
        path.write_bytes(data[:place] + bytes([data[place] ^ 4]) + data[place + 1 :])
        refused(path)


def test_a_library_that_is_missing_is_named(tmp_path, monkeypatch):
    path = written(tmp_path / "drive.mcap")
    monkeypatch.setattr(
        messages, "find_spec", lambda name: None if name == "mcap" else name
    )
    refused(path, r"library mcap; .*nics_drl_bridge\[bags\]")


ZSTD = mcap._import_zstd()
PACK = {"zstd": ZSTD.compress, "lz4": lz4.frame.compress}
PLAIN = bytes(range(256)) * 40


@pytest.mark.parametrize("kind", PACK)
def test_more_than_was_said_or_is_allowed_is_refused(kind, monkeypatch):
    with pytest.raises(ValueError, match="more than 10239 bytes"):
        unpack(PACK[kind](PLAIN), kind, len(PLAIN) - 1)
    monkeypatch.setattr(mcap, "MOST_UNPACKED", 1000)
    with pytest.raises(ValueError, match="more than 1000 bytes"):
        unpack(PACK[kind](PLAIN), kind, 10**18)


def test_a_file_of_zeros_that_unpacks_to_thousands_of_times_its_length_is_refused(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(mcap, "MOST_UNPACKED", 2**20)
    path = tmp_path / "bag.db3.zst"
    path.write_bytes(ZSTD.compress(bytes(2**26)))
    with pytest.raises(ValueError, match="1000 times"):
        unpack_file(path, tmp_path / "bag.db3")
    path.write_bytes(ZSTD.compress(PLAIN))
    assert unpack_file(path, tmp_path / "bag.db3").read_bytes() == PLAIN


def test_a_message_has_to_say_how_long_it_is(monkeypatch):
    check_message(ZSTD.compress(PLAIN))
    monkeypatch.setattr(mcap, "MOST_UNPACKED", 1000)
    with pytest.raises(ValueError, match="10240 bytes"):
        check_message(ZSTD.compress(PLAIN))
