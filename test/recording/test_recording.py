import io
import json
import os
from dataclasses import replace

import numpy as np
import pytest

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.files import seal
from nics_drl_bridge.recording import recording as recordings
from nics_drl_bridge.recording.recording import (
    FORMAT,
    Episode,
    Recording,
    Stream,
    check,
    load_recording,
    samples_on_one_clock,
    save_recording,
)
from nics_drl_bridge.robot.noise import Delay, Latency
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


def spoilt(recording, name, change):
    """The recording after a change of the stamps and values of a stream."""
    stream = getattr(recording, name)
    t, values = change(stream.t.copy(), stream.values.copy())
    return replace(recording, **{name: replace(stream, t=t, values=values)})


def put_value(value):
    def change(t, values):
        values[7, 0] = value
        return t, values

    return change


def swap_stamps(t, values):
    t[[10, 11]] = t[[11, 10]]
    return t, values


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


FAULTS = {
    "command": [(put_value(np.nan), "row 7 holds NaN or inf")],
    "pose": [
        (put_value(np.inf), "row 7 holds NaN or inf"),
        (lambda t, values: (t[:1], values[:1]), "has 1 samples"),
        (lambda t, values: (t * np.nan, values), "row 0 holds NaN"),
        (lambda t, values: (t, values[:, :2]), r"has the shape \(50, 2\) where"),
        (
            lambda t, values: (t, values + np.arange(50)[:, None] * 4.0 % 360.0),
            "it must be in radians",
        ),
    ],
    "state": [(put_value(-np.inf), "row 7 holds NaN or inf")],
    "wheels": [(swap_stamps, "time runs backwards at row 11")],
}


@pytest.mark.parametrize(
    ("name", "change", "fault"),
    [(name, *fault) for name, faults in FAULTS.items() for fault in faults],
)
def test_a_fault_of_a_stream_is_told_with_its_name_and_row(
    recording, car, name, change, fault
):
    with pytest.raises(RecordingError, match=f"here: {name}: .*{fault}"):
        check(spoilt(recording, name, change), car)


def test_a_saved_recording_reads_back_to_the_same_bits(recording, tmp_path):
    path = tmp_path / "drive.npz"
    pose = replace(recording.pose, sigma=np.full((50, 3), 0.1))
    latency = Latency(scan=Delay(least=0.01, jitter=0.002))
    recording = replace(
        recording,
        pose=pose,
        variables=("speed", "push"),
        robot={"kind": "free"},
        latency=latency,
        repairs=("its rows were sorted.",),
        measured_by="tracker",
        episodes=(Episode("a", 0.0, 0.4), Episode("b", 0.5, 0.9)),
        learn_until_s=0.45,
    )
    save_recording(recording, path)
    back = load_recording(path)
    assert set(back.streams) == set(recording.streams)
    for name, stream in recording.streams.items():
        for field, value in vars(stream).items():
            assert np.array_equal(getattr(back.streams[name], field), value)
    plain = dict.fromkeys(recording.streams)
    assert replace(back, source="here", **plain) == replace(recording, **plain)
    content = path.read_bytes()
    save_recording(replace(back, source="here"), path)
    assert path.read_bytes() == content


def packed(arrays):
    """The content of an archive of arrays, without a checksum."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def described(**meta):
    return seal(packed({"meta": np.array(json.dumps(meta)), "command": np.zeros(2)}))


BAD_FILES = {
    "older": (described(format="nics_drl_bridge/recording/3", clocks={}), "record it"),
    "bare": (described(format=FORMAT), "is not a recording of this package"),
    "no stamps": (
        described(format=FORMAT, clocks={"command": "robot"}),
        "is not a recording of this package",
    ),
    "no clocks": (described(format=FORMAT, clocks=["command"]), "is not a recording"),
    "no meta": (seal(packed({"a": np.zeros(2)})), "is not a recording"),
    "pickled": (
        packed({"meta": np.array([{"format": FORMAT}], dtype=object)}),
        r"can't be read as \.npz",
    ),
}


@pytest.mark.parametrize("fault", BAD_FILES)
def test_a_file_of_another_form_is_refused(tmp_path, fault):
    content, words = BAD_FILES[fault]
    path = tmp_path / "a.npz"
    with pytest.raises(RecordingError, match="no such file"):
        load_recording(path)
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=words):
        load_recording(path)


def test_an_archive_that_unpacks_to_gigabytes_is_refused_packed(monkeypatch, tmp_path):
    path = tmp_path / "drive.npz"
    path.write_bytes(seal(packed({"meta": np.zeros(3_000_000, np.int8)})))
    monkeypatch.setattr(recordings.files, "MOST_BYTES", 2_000_000)
    with pytest.raises(RecordingError, match="unpacked it is larger than"):
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
