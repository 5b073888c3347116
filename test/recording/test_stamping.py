import numpy as np
import pytest

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.recording.stamping import HEADER, RECEIVE, TopicData, stamp_streams

START = 1_700_000_000_000_000_000
T = np.arange(0.0, 30.0, 0.02)
TRANSPORT = 0.003


def ns(seconds) -> np.ndarray:
    return np.round(np.asarray(seconds) * 1e9).astype(np.int64)


def topic(name: str, header=None, receive=T, start=START) -> TopicData:
    """A topic received at `receive`, with header stamps `header` after `start` [s]."""
    stamps = None if header is None else start + ns(header)
    values = np.arange(len(receive), dtype=float)[:, None]
    return TopicData(name, START + ns(receive), stamps, values)


def refused(data, stamps="auto") -> str:
    with pytest.raises(RecordingError) as caught:
        stamp_streams(data, stamps, "drive")
    assert str(caught.value).startswith("drive: topic '/")
    return str(caught.value)


COMMAND = topic("/cmd_vel")


SHAKEN = np.random.default_rng(0).uniform(-0.01, 0.02, len(T))
# Topics, with the clock of each; the stamps of all begin together.
CLOCKS = {
    "of the recorder": (
        {"pose": topic("/pose", T, T + 0.012 + SHAKEN)},
        {"pose": RECEIVE},
    ),
    "of a slow localiser": (
        {"pose": topic("/pose", T, T + 0.9 + SHAKEN)},
        {"pose": RECEIVE},
    ),
    "foreign": ({"pose": topic("/pose", T - 1.5, T + TRANSPORT)}, {"pose": HEADER}),
    "a little ahead": (
        {"pose": topic("/pose", T + 0.1, T + TRANSPORT)},
        {"pose": HEADER},
    ),
    "simulated": ({"pose": topic("/pose", T + 12.0, start=0)}, {"pose": HEADER}),
    "without stamps": ({"pose": topic("/pose", 0 * T, start=0)}, {"pose": RECEIVE}),
    "one foreign clock, one of them late": (
        {
            "command": topic("/cmd_vel", T + 12.0, T + TRANSPORT),
            "pose": topic("/pose", T + 12.0, T + 0.3),
        },
        {"command": HEADER, "pose": HEADER},
    ),
    "two foreign clocks": (
        {
            "command": topic("/cmd_vel", T + 100.0),
            "pose": topic("/pose", T - 100.0),
            "state": topic("/joint_states", T + 100.001),
        },
        {"command": HEADER, "pose": "header of /pose", "state": HEADER},
    ),
    "a robot with two": (
        {
            "state": topic("/joint_states", T + 1.0, start=0),
            "pose": topic("/pose", T - TRANSPORT),
        },
        {"state": RECEIVE, "pose": RECEIVE},
    ),
}


@pytest.mark.parametrize("case", CLOCKS)
def test_headers_are_of_the_recorders_clock_or_of_a_foreign_one(case):
    topics, clocks = CLOCKS[case]
    made = stamp_streams({"command": COMMAND, **topics}, "auto", "drive")
    assert {name: made[name].clock for name in clocks} == clocks
    for name in clocks:
        assert np.allclose(np.diff(made[name].t), np.diff(T), atol=1e-6)
        assert made[name].t[0] == pytest.approx(0.0, abs=0.35)


def test_headers_of_which_some_have_no_stamp_are_refused():
    pose = topic("/pose", T)
    pose.header_ns[300:305] = 0
    data = {"command": COMMAND, "pose": pose}
    said = "topic '/pose': 5 of 1500 headers have no stamp; write `stamps: receive`"
    assert said in refused(data)
    assert stamp_streams(data, "receive", "drive")["pose"].t[0] == 0.0


def test_what_a_simulation_sent_before_it_had_a_time_is_left_out():
    pose = topic("/pose", np.maximum(T - 0.5, 0.0), start=0)
    made = stamp_streams({"command": COMMAND, "pose": pose}, "auto", "drive")["pose"]
    assert made.values[0, 0] == np.argmax(T > 0.5)
    assert np.allclose(made.t, T[T > 0.5])


def test_a_few_late_messages_are_put_in_order():
    order = np.arange(len(T))
    order[[100, 101]] = 101, 100
    pose = topic("/pose", T[order])
    made = stamp_streams({"command": COMMAND, "pose": pose}, "auto", "drive")
    assert np.allclose(made["pose"].t, T)
    assert made["pose"].values[[99, 100, 101], 0].tolist() == [99.0, 101.0, 100.0]


@pytest.mark.parametrize("stamps", ["auto", "header"])
def test_a_clock_that_was_set_back_is_refused(stamps):
    """Its stamps would lie among those from before."""
    headers = np.where(T < 15.0, T, T - 0.5)
    data = {"command": topic("/cmd_vel", T), "pose": topic("/pose", headers)}
    assert "run backwards at message 750, by 0.480 s" in refused(data, stamps)


def test_a_recorder_that_stalled_is_forgiven():
    receive = T.copy()
    stalled = (T > 10.0) & (T < 10.4)
    receive[stalled] = 13.0
    pose = topic("/pose", T, np.maximum.accumulate(receive))
    pose.receive_ns[T >= 10.4] = START + ns(T[T >= 10.4])
    made = stamp_streams({"command": COMMAND, "pose": pose}, "auto", "drive")
    assert np.allclose(made["pose"].t, T)


@pytest.mark.parametrize("rate", [0.5, 2.0])
def test_a_simulated_time_at_another_rate_is_refused(rate):
    sentence = refused({"command": COMMAND, "pose": topic("/pose", rate * T, start=0)})
    assert "from a simulated time at another rate" in sentence
    assert "--use-sim-time" in sentence


@pytest.mark.parametrize("at", [0, 700, -1])
@pytest.mark.parametrize("by", [-1e4, 1e4])
def test_a_stamp_from_another_age_is_refused(at, by):
    headers = T.copy()
    headers[at] += by
    refused({"command": COMMAND, "pose": topic("/pose", headers)})


def test_receipt_out_of_order_is_sorted():
    order = np.random.default_rng(0).permutation(len(T))
    data = {"command": topic("/cmd_vel", None, T[order]), "pose": topic("/pose", T)}
    made = stamp_streams(data, "auto", "drive")["command"]
    assert np.allclose(made.t, T)
    assert np.array_equal(made.values[:, 0], np.argsort(order))


def test_header_stamps_are_taken_on_request_and_must_be_there():
    data = {"command": topic("/cmd_vel", T + 5.0), "pose": topic("/pose", T + 7.0)}
    made = stamp_streams(data, "header", "drive")
    assert {stream.clock for stream in made.values()} == {HEADER}
    assert np.allclose(made["pose"].t - made["command"].t, 2.0)
    data["command"] = COMMAND
    said = "topic '/cmd_vel': its messages have no header stamps; write `stamps: auto`"
    assert said in refused(data, "header")
