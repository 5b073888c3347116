from __future__ import annotations

import io
import json
import os
from dataclasses import replace

import numpy as np
import pytest

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.files import MOST_BYTES, seal
from nics_drl_bridge.recording import recording as recordings
from nics_drl_bridge.recording.recording import (
    FORMAT,
    Recording,
    Stream,
    check,
    load_recording,
    samples_on_one_clock,
    save_recording,
)
from nics_drl_bridge.robot.spec import load_robot


@pytest.fixture
def recording():
    t = np.arange(50) * 0.02
    rng = np.random.default_rng(0)
    pose = np.stack([t, np.sin(t), geometry.wrap_angle(3.0 + t)], axis=1)
    return Recording(
        Stream(t + 0.1, rng.normal(size=(50, 2)), "robot"),
        Stream(t, pose, "mocap"),
        Stream(t, rng.normal(size=(50, 2)), "robot"),
        Stream(t[::2], rng.normal(size=(25, 2)), "robot"),
        source="here",
    )


@pytest.fixture(scope="module")
def car():
    return load_robot("ackermann")


def spoilt(recording, name, row, value):
    stream = getattr(recording, name)
    values = stream.values.copy()
    values[row, 0] = value
    return replace(recording, **{name: replace(stream, values=values)})


def test_a_path_or_a_name_where_the_object_is_meant_is_told(recording, car):
    with pytest.raises(
        ConfigError, match=r"recording='drive.npz': must be a Recording"
    ):
        check("drive.npz", car)
    with pytest.raises(ConfigError, match=r"robot='ackermann': must be a RobotSpec"):
        check(recording, "ackermann")


def test_the_rates_of_samples_are_the_twist_of_the_exact_arc():
    rng = np.random.default_rng(1)
    dt = 0.05
    twists = rng.normal(size=(40, 3)) * [1.0, 1.0, 20.0]
    poses = [np.array([1.0, 2.0, 3.0])]
    for twist in twists:
        poses.append(geometry.compose(poses[-1], geometry.exp(twist * dt)))
    t = np.arange(41) * dt
    state = rng.normal(size=(41, 1))
    command = rng.normal(size=(41, 2))
    samples = samples_on_one_clock(t, np.array(poses), state, command)
    assert samples.dt == pytest.approx(dt)
    assert np.allclose(samples.dq[:, :3], twists, atol=1e-9)
    assert np.allclose(samples.dq[:, 3:], np.diff(state, axis=0) / dt)
    assert np.array_equal(samples.x, np.concatenate([state, command], axis=1)[:-1])
    assert np.array_equal(samples.q[:, 3:], state[:-1])
    assert np.array_equal(samples.t, t[:-1])


def test_chosen_rows_stay_together():
    t = np.arange(6) * 0.1
    samples = samples_on_one_clock(t, np.zeros((6, 3)), t[:, None], np.zeros((6, 1)))
    few = samples.rows(samples.t > 0.25)
    assert np.allclose(few.t, [0.3, 0.4])
    assert np.allclose(few.x[:, 0], few.t)
    assert len(few.q) == len(few.dq) == 2


def test_a_good_recording_passes(recording, car):
    assert check(recording, car) is recording
    assert set(recording.streams) == {"command", "pose", "state", "wheels"}
    assert set(replace(recording, state=None, wheels=None).streams) == {
        "command",
        "pose",
    }


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["command", "pose", "state", "wheels"])
def test_what_is_no_number_is_refused_with_stream_and_row(recording, car, name, value):
    with pytest.raises(RecordingError, match=f"here: {name}: row 7 holds NaN or inf"):
        check(spoilt(recording, name, 7, value), car)


def test_a_stamp_that_is_no_number_is_refused(recording, car):
    t = recording.pose.t.copy()
    t[3] = np.nan
    with pytest.raises(RecordingError, match="pose: row 3 holds NaN"):
        check(replace(recording, pose=replace(recording.pose, t=t)), car)


def test_time_that_runs_backwards_is_refused_with_its_row(recording, car):
    t = recording.command.t.copy()
    t[[10, 11]] = t[[11, 10]]
    with pytest.raises(RecordingError, match="command: time runs backwards at row 11"):
        check(replace(recording, command=replace(recording.command, t=t)), car)


def test_equal_stamps_are_allowed(recording, car):
    t = recording.pose.t.copy()
    t[5] = t[4]
    check(replace(recording, pose=replace(recording.pose, t=t)), car)


def test_a_recording_of_another_robot_is_refused(recording):
    with pytest.raises(
        RecordingError, match=r"command: has the shape \(50, 2\) where \(50, 3\)"
    ):
        check(recording, load_robot("mecanum"))


def test_a_recording_of_one_sample_is_refused(recording, car):
    short = Stream(recording.pose.t[:1], recording.pose.values[:1])
    with pytest.raises(RecordingError, match="pose: has 1 samples"):
        check(replace(recording, pose=short), car)


def test_headings_in_degrees_are_refused(recording, car):
    values = recording.pose.values.copy()
    values[:, 2] = np.arange(50) * 4.0 % 360.0  # 4 degrees a sample
    with pytest.raises(RecordingError, match="it must be in radians"):
        check(replace(recording, pose=replace(recording.pose, values=values)), car)


def test_a_saved_recording_reads_back_to_the_same_bits(recording, tmp_path):
    path = tmp_path / "drive.npz"
    save_recording(recording, path)
    back = load_recording(path)
    assert back.source == str(path)
    assert set(back.streams) == set(recording.streams)
    for name, stream in recording.streams.items():
        assert np.array_equal(back.streams[name].t, stream.t)
        assert np.array_equal(back.streams[name].values, stream.values)
        assert back.streams[name].clock == stream.clock
    content = path.read_bytes()
    save_recording(replace(back, source="here"), path)
    assert path.read_bytes() == content


def packed(arrays):
    """The content of an archive of arrays, without a checksum."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def test_numpy_reads_a_recording_whose_checksum_follows_the_archive(
    recording, tmp_path
):
    path = tmp_path / "drive.npz"
    save_recording(recording, path)
    with np.load(path, allow_pickle=False) as arrays:
        assert np.array_equal(arrays["pose"], recording.pose.values)
    assert b"sha256 " in path.read_bytes()[-80:]


@pytest.mark.parametrize(
    "version", [*(f"nics_drl_bridge/recording/{n}" for n in (1, 2, 3)), "other/1"]
)
@pytest.mark.parametrize("seal", [seal, bytes])
def test_another_format_is_one_sentence_that_says_what_to_do(tmp_path, version, seal):
    meta = {"format": version, "source": "", "clocks": {}}
    path = tmp_path / "a.npz"
    path.write_bytes(seal(packed({"meta": np.array(json.dumps(meta))})))
    with pytest.raises(RecordingError) as refused:
        load_recording(path)
    assert str(refused.value) == (
        f"{path}: format {version!r} is not {FORMAT!r}; "
        "record it again or use the version of the package that wrote it."
    )


@pytest.mark.parametrize(
    "meta",
    [
        {"format": FORMAT},
        {"format": FORMAT, "clocks": {"command": "robot"}},
        {"format": FORMAT, "clocks": {"nonsense": "robot"}},
        {"format": FORMAT, "clocks": ["command"]},
        [1, 2],
        None,
    ],
)
def test_a_file_that_lacks_a_part_is_refused(tmp_path, meta):
    path = tmp_path / "a.npz"
    arrays = {"meta": np.array(json.dumps(meta)), "command": np.zeros((2, 2))}
    path.write_bytes(seal(packed({**arrays, "command_t": np.zeros(2)})))
    with pytest.raises(RecordingError, match="is not a recording of this package"):
        load_recording(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(RecordingError, match=r"nowhere.npz: no such file"):
        load_recording(tmp_path / "nowhere.npz")


def test_a_recording_is_never_unpickled(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, meta=np.array([{"format": FORMAT}], dtype=object))
    with pytest.raises(RecordingError, match=r"can't be read as \.npz"):
        load_recording(path)


def test_every_flipped_bit_and_every_cut_is_refused(recording, tmp_path):
    path = tmp_path / "drive.npz"
    save_recording(recording, path)
    content = path.read_bytes()
    rng = np.random.default_rng(2)
    for trial in range(300):
        damaged = bytearray(content)
        if trial < 50:
            damaged = damaged[: rng.integers(len(content))]
        else:
            damaged[rng.integers(len(content))] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        with pytest.raises(RecordingError, match=r"drive\.npz"):
            load_recording(path)


@pytest.mark.parametrize(
    "field", [{"method": 99}, {"flags": 1}], ids=["packing", "password"]
)
def test_entries_that_zipfile_can_not_unpack_are_refused(tmp_path, field):
    data = bytearray(packed({"meta": np.arange(1000)}))
    for signature, flags, method in ((b"PK\x03\x04", 6, 8), (b"PK\x01\x02", 8, 10)):
        begin = data.index(signature)
        data[begin + (flags if "flags" in field else method)] = next(
            iter(field.values())
        )
    path = tmp_path / "drive.npz"
    path.write_bytes(seal(data))
    with pytest.raises(RecordingError, match=r"compression|password|encrypted"):
        load_recording(path)


def test_an_archive_that_unpacks_to_gigabytes_is_refused_packed(monkeypatch, tmp_path):
    path = tmp_path / "drive.npz"
    path.write_bytes(seal(packed({"meta": np.zeros(3_000_000, np.int8)})))
    monkeypatch.setattr(recordings.files, "MOST_BYTES", 2_000_000)
    with pytest.raises(RecordingError, match="unpacked it is larger than"):
        load_recording(path)


def test_a_file_that_is_too_large_is_not_read(tmp_path):
    path = tmp_path / "large.npz"
    with path.open("wb") as file:
        file.truncate(MOST_BYTES + 1)
    with pytest.raises(RecordingError, match="larger than 256 MB"):
        load_recording(path)


@pytest.mark.timeout(10)
def test_a_pipe_is_no_recording_and_nobody_waits_for_its_writer(tmp_path):
    os.mkfifo(tmp_path / "drive.npz")
    assert not recordings.is_recording(tmp_path / "drive.npz")


@pytest.mark.parametrize("unknown", [0.0, np.nan, np.inf])
def test_a_row_weighs_by_its_variance_and_as_usual_where_that_is_unknown(unknown):
    sigma = np.full((6, 3), 0.02)
    sigma[1] = 0.04
    sigma[2] = unknown
    sigma[3:, 2] = unknown
    stream = Stream(np.arange(6.0), np.zeros((6, 3)), sigma=sigma)
    expected = np.ones((6, 3))
    expected[1] = 0.25, 0.25, (0.03 / 0.04) ** 2  # of the heading two rows are known
    expected[0, 2] = (0.03 / 0.02) ** 2
    assert stream.weights == pytest.approx(expected)
    assert (replace(stream, sigma=None).weights == 1.0).all()
