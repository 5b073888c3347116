import numpy as np
import pytest

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.recording import stamping
from nics_drl_bridge.recording.recording import guess_time_unit
from nics_drl_bridge.recording.stamping import HEADER, RECEIVE, TopicData, stamp_streams
from nics_drl_bridge.recording.values import parse_dates

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


TIMES = 100.0 + np.arange(300) * 0.02


@pytest.mark.parametrize("size", [2.0**32, 2.0**16, 2.0**32 * 1e-3, 2.0**32 * 1e-6])
def test_a_clock_that_overflows_is_continued(size):
    step = size * 1e-4
    wrapped = (0.99 * size + np.arange(300) * step) % size
    made, note = stamping.remove_overflow(wrapped, "log")
    assert np.allclose(np.diff(made), step)
    assert "overflowed at" in note
    assert "once" in note


ROWS = np.arange(300)
LATE = ROWS.copy()
LATE[[100, 102]] = 102, 100


def stray(row, value):
    """A stamp that fits none beside it."""
    t = TIMES.copy()
    t[row] = value
    note = f"1 stamps do not fit their neighbours (row {row}: {value:.10g} s)"
    return t, np.delete(ROWS, row), note


# Stamps; the rows in order, and the note.
REPAIRS = {
    "late": (TIMES[LATE], LATE, "2 of 300 rows came after later ones"),
    "set back": (
        np.append(TIMES[:100], TIMES[:200] - 99.0),
        ROWS,
        "set back once (row 100, by 101 s)",
    ),
    "set ahead": (
        np.append(TIMES[:100], TIMES[100:] + 1.7e9),
        ROWS,
        "set ahead once (row 100, by 1.7e+09 s)",
    ),
    "reversed": (TIMES[::-1], ROWS[::-1], "were reversed"),
    "early": stray(150, 0.0),
    "far ahead": stray(150, 1e9),
    "first": stray(0, 1e9),
}


@pytest.mark.parametrize("case", REPAIRS)
def test_the_order_of_stamps_is_repaired_and_the_repair_is_told(case):
    given, order, note = REPAIRS[case]
    t, rows, told = stamping.repair_order(given, "log")
    whole = TIMES[np.sort(order)]
    assert np.allclose(t, whole, rtol=0.0, atol=1e-6)
    assert np.array_equal(rows, order)
    assert note in told


def test_rows_that_repeat_stamp_and_values_are_left_out():
    t = np.array([0.0, 0.0, 0.0, 1.0])
    values = np.array([[1.0], [1.0], [2.0], [2.0]])
    keep, note = stamping.select_new_rows(t, values, "pose")
    assert keep.tolist() == [True, False, True, True]
    assert "1 of 4 rows repeat" in note


@pytest.mark.parametrize(
    ("step", "unit"), [(0.02, None), (20.0, "ms"), (2e4, "us"), (2e7, "ns")]
)
def test_the_unit_of_stamps_that_are_no_seconds_is_named(step, unit):
    assert guess_time_unit(np.arange(50) * step) == unit


@pytest.mark.parametrize(("bits", "low"), [(16, 0.0), (32, 0.0), (16, -(2.0**15))])
def test_a_counter_that_overflows_is_continued(bits, low):
    size = 2.0**bits
    steps = np.tile([5.0, 9.0, 0.0, -3.0], 500) * 2.0 ** (bits - 12)
    raw = np.cumsum(steps)
    wrapped = (raw - low) % size + low
    found = stamping.find_overflow(wrapped, (1.0,), stamping.BITS)
    assert found == size
    made, count = stamping.unwrap_counter(wrapped, found)
    assert np.allclose(np.diff(made), steps[1:])
    assert count > 0


def test_a_counter_that_was_reset_has_no_overflow():
    raw = np.concatenate([np.arange(0, 30_000, 100), np.arange(0, 9000, 100)])
    assert stamping.find_overflow(raw.astype(float), (1.0,), stamping.BITS) is None


def test_stamps_in_whole_seconds_lack_their_rest_but_rows_that_share_milliseconds_do_not():
    assert stamping.count_rows_a_second(np.floor(TIMES)) == 50
    assert stamping.count_rows_a_second(np.repeat(np.arange(50) * 20.0, 6)) == 0
    assert stamping.count_rows_a_second(np.arange(50.0)) == 0


def test_a_counter_is_told_from_commands_that_jump_to_and_fro():
    raw = np.cumsum(np.tile([50.0, 90.0, 0.0, -30.0], 5000))
    assert stamping.describe_counter(raw % 2.0**16) == "overflows at 65536"
    assert stamping.describe_counter(raw) == ""
    falling = -np.maximum.accumulate(raw)
    assert stamping.describe_counter(falling) == "changed by 549980 in one direction"
    full = np.where(np.arange(400) % 100 < 50, -127.0, 127.0)
    assert stamping.describe_counter(full + np.arange(400) % 2) == ""


@pytest.mark.parametrize(
    ("reach", "period"), [(50.0, 0.5), (1000.0, 100.0), (0.0, 1.0)]
)
def test_a_wheel_that_goes_to_and_fro_or_trembles_is_a_counter(reach, period):
    t = np.arange(200) * 0.02
    turned = reach * np.sin(t * 2.0 * np.pi / period)
    ticks = np.round(turned) + np.round(np.sin(t * 100.0))
    assert not stamping.is_oscillating(ticks)


@pytest.mark.parametrize(
    ("dates", "seconds"),
    [
        (["2024-05-01 02:59:59+02:00", "2024-05-01T02:00:00+0100"], [-1.0, 0.0]),
        (["2024/05/01 01:00:00Z", "2024-05-01 00:00:00-01:30"], [0.0, 1800.0]),
        (["12:00:00.5", "12:00:01"], [0.5, 1.0]),
    ],
)
def test_the_utc_offset_of_a_date_counts(dates, seconds):
    start = 12 * 3600.0 if len(dates[1]) < 10 else 1_714_525_200.0
    found = parse_dates(np.array(dates))
    assert found == pytest.approx(start + np.array(seconds), abs=1e-6)


def test_other_text_is_no_date():
    assert parse_dates(np.array(["AUTO", "MANUAL"])) is None
