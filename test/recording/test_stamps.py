import numpy as np
import pytest

from nics_drl_bridge.recording import stamping
from nics_drl_bridge.recording.recording import guess_time_unit
from nics_drl_bridge.recording.values import parse_dates

T = 100.0 + np.arange(300) * 0.02


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
    t = T.copy()
    t[row] = value
    note = f"1 stamps do not fit their neighbours (row {row}: {value:.10g} s)"
    return t, np.delete(ROWS, row), note


# Stamps; the rows in order, and the note.
REPAIRS = {
    "late": (T[LATE], LATE, "2 of 300 rows came after later ones"),
    "set back": (
        np.append(T[:100], T[:200] - 99.0),
        ROWS,
        "set back once (row 100, by 101 s)",
    ),
    "set ahead": (
        np.append(T[:100], T[100:] + 1.7e9),
        ROWS,
        "set ahead once (row 100, by 1.7e+09 s)",
    ),
    "reversed": (T[::-1], ROWS[::-1], "were reversed"),
    "early": stray(150, 0.0),
    "far ahead": stray(150, 1e9),
    "first": stray(0, 1e9),
}


@pytest.mark.parametrize("case", REPAIRS)
def test_the_order_of_stamps_is_repaired_and_the_repair_is_told(case):
    given, order, note = REPAIRS[case]
    t, rows, told = stamping.repair_order(given, "log")
    whole = T[np.sort(order)]
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
    assert stamping.count_rows_a_second(np.floor(T)) == 50
    assert stamping.count_rows_a_second(np.repeat(np.arange(50) * 20.0, 6)) == 0
    assert stamping.count_rows_a_second(np.arange(50.0)) == 0


def test_a_counter_is_told_from_commands_that_jump_to_and_fro():
    raw = np.cumsum(np.tile([50.0, 90.0, 0.0, -30.0], 5000))
    assert stamping.describe_counter(raw % 2.0**16) == "overflows at 65536"
    assert stamping.describe_counter(raw) == ""
    assert stamping.describe_counter(-np.maximum.accumulate(raw)) == "went on by 549980"
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
