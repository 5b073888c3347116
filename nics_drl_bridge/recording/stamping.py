"""Stamps: clocks of topics, by headers or receipt, and repairs of stamps and counters."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.geometry import Array, accumulate
from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.recording.recording import Stream
from nics_drl_bridge.recording.topic_roles import Stamps

Nanoseconds = NDArray[np.int64]

RECEIVE = "receive"
HEADER = "header"
# Range of the median delay from header to receipt on the recorder's own clock: a
# localiser may be slow, but nothing is received before it was stamped.
SAME_CLOCK_S = (-0.001, 1.0)
# The delay from headers of one clock to their receipt varies by less.
MAX_WANDER_S = 1.0
# A stalled recorder may receive this percentage of messages even later, by up to this time.
STALLED = 2.0
MAX_STALL_S = 30.0
MAX_LATE = 0.01  # fraction of messages that may arrive after one with a later stamp
# fraction of messages that may lack a stamp at the start, when a simulation has no time
# yet
MAX_UNSTAMPED = 0.05
# Streams from one computer, hence on one clock
ROBOT_STREAMS = ("command", "command_topic", "state", "wheels", "imu")

SPLIT = (
    ("s", "ns"),
    ("sec", "nanosec"),
    ("secs", "nsecs"),
    ("sec", "nsec"),
    ("sec", "nsecs"),
)
# Stamps in whole seconds with this many rows each are truncated.
ROWS_A_SECOND = 5
# A counter takes more than COUNTING usual steps from one overflow to the next, loses at most
# MAX_LOST_STEPS at each, and reaches each of PARTS parts of its range.
COUNTING = 16.0
MAX_LOST_STEPS = 2.0
PARTS = 10
# Or it grows by more than GROWN counts, and by more than this fraction of the sum of its steps.
GROWN = 2000.0
ONE_WAY = 0.95
# A speed goes back by more than this fraction of its steps, within a range of fewer usual steps.
BACK = 0.2
WITHIN = 25.0
TREMBLING = 4.0  # range of the ticks of a wheel at rest
BITS = (8, 16, 24, 31, 32)  # sizes of registers that overflow
STAMP_BITS = (16, 24, 31, 32)
# Late rows come in runs of at most this length, late by at most this time.
LATE_ROWS = 50
LATE_S = 1.0
# minimum fraction of backward steps in rows that begin with the last
MIN_BACKWARD_FRACTION = 0.9
MOST_STRAY = 0.01  # maximum fraction of stamps that fit neither neighbour
MAX_CLOCK_PAUSE_S = 86_400.0  # after a longer pause of a drive, the clock was set
USUAL = 10.0  # maximum step across an overflow, in usual steps
USE_RECEIPT = (
    "write `stamps: receive` into the topics file (`time: arrival` into a map)"
)


@dataclass(frozen=True)
class TopicData:
    """Data read from a topic."""

    topic: str
    receive_ns: Nanoseconds  # (T,) times of receipt
    # (T,) stamps of the headers; None if the type has no header
    header_ns: Nanoseconds | None
    values: Array  # (T, D)

    def rows(self, keep: NDArray[np.bool_] | NDArray[np.intp]) -> "TopicData":
        """Returns the messages selected by `keep`, a mask (T,) or indices."""
        header_ns = self.header_ns
        if header_ns is not None:
            header_ns = header_ns[keep]
        return TopicData(
            self.topic, self.receive_ns[keep], header_ns, self.values[keep]
        )


def stamp_streams(
    data: Mapping[str, TopicData],
    stamps: Stamps,
    place: str,
    of_robot: Collection[str] = ROBOT_STREAMS,
) -> dict[str, Stream]:
    """Stamps each stream, starting near 0. Raises RecordingError if headers can't be used."""
    # `auto` uses headers if there are any. Headers less than 1 s before their receipt are on the
    # recorder's clock. Others are on a foreign clock; shifted by the median delay, they leave a
    # small offset for calibration. Command, state, wheels and IMU share one clock, by receipt if
    # necessary. Late messages are sorted; messages before a simulation's first time are dropped.
    headers: dict[str, Nanoseconds | None] = dict.fromkeys(data)
    if stamps != "receive":
        data = {name: _sort_by_stamp(part, place) for name, part in data.items()}
        for name, part in data.items():
            headers[name] = _check_header(part, stamps, place)
    origin = min(int(part.receive_ns.min()) for part in data.values())
    clocks = dict.fromkeys(data, (RECEIVE, 0))
    if stamps == "header":
        first = min(int(ns.min()) for ns in headers.values() if ns is not None)
        clocks = dict.fromkeys(data, (HEADER, origin - first))
    elif stamps == "auto":
        clocks = _assign_clocks(data, headers, place)
    if len({clocks[name][0] for name in of_robot if name in data}) > 1:
        headers |= dict.fromkeys(of_robot)
    streams = {}
    for name, part in data.items():
        clock, shift = clocks[name]
        ns = headers[name]
        if ns is None:
            part = part.rows(np.argsort(part.receive_ns, kind="stable"))
            clock = RECEIVE
            shift = 0
            ns = part.receive_ns
        t = np.asarray((ns + shift - origin) * S_PER_NS, dtype=np.float64)
        streams[name] = Stream(t, part.values, clock)
    return streams


def has_continuous_headers(parts: Iterable[TopicData]) -> bool:
    """True if all headers, in order of receipt, are continuous."""
    parts = list(parts)
    receive_ns = np.concatenate([part.receive_ns for part in parts])
    headers = [part.header_ns for part in parts]
    if any(ns is None or not ns.all() for ns in headers):
        return False
    stamps_ns = np.concatenate(cast(Any, headers))
    step_ns = np.diff(stamps_ns[np.argsort(receive_ns, kind="stable")])
    return bool((np.abs(step_ns) * S_PER_NS < MAX_WANDER_S).all())


def _measure_delay(delay_ns: Nanoseconds, place: str, topic: str) -> int:
    """Returns the median delay (T,) of a topic [ns]. Raises RecordingError if they wander."""
    median = int(np.median(delay_ns))
    minimum = delay_ns.min()
    maximum = delay_ns.max()
    late = np.percentile(delay_ns, 100.0 - STALLED)
    wander = max(late - median, median - minimum) * S_PER_NS
    if wander > MAX_WANDER_S or (maximum - median) * S_PER_NS > MAX_STALL_S:
        fault = (
            f"its header stamps lie {minimum * S_PER_NS:.3f} to "
            f"{maximum * S_PER_NS:.3f} s before their receipt, so they come from "
            "several clocks or from a simulated time at another rate"
        )
        advice = (
            f"{USE_RECEIPT}, or for a simulation `stamps: header` (`time: header`), and record "
            "it with `ros2 bag record --use-sim-time`"
        )
        raise _make_error(place, topic, fault, advice)
    return median


def _assign_clocks(
    data: Mapping[str, TopicData], headers: Mapping[str, Nanoseconds | None], place: str
) -> dict[str, tuple[str, int]]:
    """Returns each stream's clock, and the shift of its stamps to the recorder's clock [ns]."""
    foreign: dict[str, int] = {}
    clocks = dict.fromkeys(data, (RECEIVE, 0))
    for name, ns in headers.items():
        if ns is None:
            continue
        topic = data[name].topic
        median = _measure_delay(data[name].receive_ns - ns, place, topic)
        if SAME_CLOCK_S[0] <= median * S_PER_NS <= SAME_CLOCK_S[1]:
            continue
        clock = f"{HEADER} of {topic}" if foreign else HEADER
        for other, shift in foreign.items():
            if abs(shift - median) * S_PER_NS < SAME_CLOCK_S[1]:
                clock = other
                break
        clocks[name] = (clock, foreign.setdefault(clock, median))
    return clocks


def _check_header(part: TopicData, stamps: Stamps, place: str) -> Nanoseconds | None:
    ns = part.header_ns
    if ns is None or not ns.any():
        if stamps == "header":
            fault = "its messages have no header stamps"
            advice = "write `stamps: auto` into the topics file, or no `time: header` into a map"
            raise _make_error(place, part.topic, fault, advice)
        return None
    if not ns.all():
        fault = f"{(ns == 0).sum()} of {len(ns)} headers have no stamp"
        raise _make_error(place, part.topic, fault, USE_RECEIPT)
    return ns


def _make_error(place: str, topic: str, fault: str, advice: str) -> RecordingError:
    reason = f"topic {topic!r}: {fault}"
    return RecordingError(f"{place}: {reason}; {advice}.", reason)


def _sort_by_stamp(part: TopicData, place: str) -> "TopicData":
    """Drops unstamped messages at the start, and sorts the few late ones by stamp."""
    ns = part.header_ns
    if ns is None or not ns.any():
        return part
    first = int(np.argmax(ns != 0))
    if first <= MAX_UNSTAMPED * len(ns):
        part = part.rows(np.arange(first, len(ns)))
        ns = ns[first:]
    if not ns.all():
        return part
    late = np.maximum.accumulate(ns) - ns
    if np.mean(late > 0) > MAX_LATE or late.max() * S_PER_NS > MAX_WANDER_S:
        k = int(np.argmax(late > 0))
        fault = f"the header stamps run backwards at message {k}, by {late[k] * S_PER_NS:.3f} s"
        advice = f"{USE_RECEIPT}, or cut the bag there"
        raise _make_error(place, part.topic, fault, advice)
    return part.rows(np.argsort(ns, kind="stable"))


def join_stamps(seconds: NDArray[Any], nanoseconds: NDArray[Any]) -> Array:
    """Joins stamps that are split into seconds and nanoseconds [s]."""
    return np.asarray(seconds + nanoseconds * S_PER_NS, dtype=np.float64)


def find_overflow(
    values: Array, scale: tuple[float, ...], bits: tuple[int, ...]
) -> float | None:
    """Returns the range of a register that overflows in values (T,), which are counts x scale.

    An overflow is a jump of more than half the range, across which the values continue as usual
    once the range is added. Returns None if no range explains the jumps.
    """
    step = np.diff(values)
    if not len(step):
        return None
    usual = float(np.percentile(np.abs(step), 95))
    span = float(np.ptp(values))
    for size in sorted(2.0**bit * unit for unit in scale for bit in bits):
        jump = np.abs(step) > size / 2.0
        is_too_large = max(span, np.abs(values).max()) > size
        if is_too_large or not 0.0 < jump.mean() <= 0.5:
            continue
        rest = np.abs(step[jump] - np.sign(step[jump]) * size)
        if rest.max() <= USUAL * max(usual, size * 1e-9):
            return size
    return None


def unwrap_counter(values: Array, size: float) -> tuple[Array, int]:
    """Continues values (T,) across the overflows of a register; returns them and their number."""
    step = np.diff(values)
    turns = -np.round(step / size) * (np.abs(step) > size / 2.0)
    return values + size * accumulate(turns), int(np.abs(turns).sum())


def describe_counter(values: Array) -> str:
    """Returns the reason why integers (T,) look like a counter, or ""."""
    if not (values == np.round(values)).all():
        return ""
    step = np.abs(np.diff(values))
    change = float(abs(values[-1] - values[0]))
    if change > max(GROWN, ONE_WAY * step.sum()):
        return f"changed by {change:.10g} in one direction"
    size = find_overflow(values, (1.0,), BITS)
    if size is None:
        return ""
    usual = float(np.percentile(step, 95))
    lost = size - step[step > size / 2.0]
    is_calm = COUNTING * usual < size and (np.abs(lost) <= MAX_LOST_STEPS * usual).all()
    if is_calm and np.histogram(values, PARTS)[0].all():
        return f"overflows at {size:.10g}"
    return ""


def is_oscillating(values: Array) -> bool:
    """True for values (T,) that go up and down within a few of their steps, unlike a counter's."""
    step = np.diff(values)
    step = step[step != 0.0]
    size = np.abs(step)
    back = np.minimum(size[1:], size[:-1])[step[1:] * step[:-1] < 0.0].sum()
    near = TREMBLING < np.ptp(values) < WITHIN * np.percentile(size, 95)
    return bool(near and back > BACK * size.sum())


def count_rows_a_second(t: Array) -> int:
    """Returns the rows per second of stamps (T,) that are truncated to seconds; else 0."""
    seconds = np.unique(t)
    if len(t) < ROWS_A_SECOND * len(seconds) or (t != np.round(t)).any():
        return 0
    if len(seconds) < 2 or np.median(np.diff(seconds)) != 1.0:
        return 0
    return round(len(t) / len(seconds))


def remove_overflow(t: Array, name: str) -> tuple[Array, str]:
    """Continues stamps (T,) of a clock of 32 bits or less across its overflows; returns a note."""
    size = find_overflow(t, (1.0, 1e-3, 1e-6, 1e-9), STAMP_BITS)
    if size is None or not (np.diff(t) < 0.0).any():
        return t, ""
    continued, count = unwrap_counter(t, size)
    return continued, (
        f"{name}: its clock overflowed at {size:.10g} {format_times(count)}, and was "
        "continued."
    )


def repair_order(t: Array, name: str) -> tuple[Array, NDArray[np.intp], str]:
    """Sorts the few late rows; joins parts between which the clock was set.

    Returns stamps (T,) [s] that never decrease, the row of each, and a note.
    """
    rows = np.arange(len(t))
    notes = []
    if len(t) > 1 and np.mean(np.diff(t) < 0.0) > MIN_BACKWARD_FRACTION:
        t = t[::-1]
        rows = rows[::-1]
        notes.append(f"{name}: its rows began with the last, and were reversed.")
    stray = _find_stray(t)
    if stray.any():
        notes.append(
            f"{name}: {stray.sum()} stamps do not fit their neighbours (row "
            f"{rows[stray][0]}: {t[stray][0]:.10g} s); left out."
        )
        t = t[~stray]
        rows = rows[~stray]
    late = np.maximum.accumulate(t) - t
    # Longest run of rows that are older than a row before them
    on_time = np.flatnonzero(np.concatenate([[True], late <= 0.0, [True]]))
    longest = int(np.diff(on_time).max()) - 1
    if 0 < longest <= LATE_ROWS and late.max() <= LATE_S:
        order = np.argsort(t, kind="stable")
        notes.append(
            f"{name}: {int((late > 0.0).sum())} of {len(t)} rows came after later "
            f"ones, by up to {late.max():.3g} s, and were sorted."
        )
        t = t[order]
        rows = rows[order]
    t, note = _join_after_jumps(t, rows, name)
    return t, rows, " ".join([*notes, note]).strip()


def _join_after_jumps(t: Array, rows: NDArray[np.intp], name: str) -> tuple[Array, str]:
    """Joins the parts between which the clock was set; returns stamps (T,) [s] and a note."""
    step = np.diff(t)
    is_jump = (step < 0.0) | (step > MAX_CLOCK_PAUSE_S)
    if not is_jump.any() or is_jump.all():
        return t, ""
    usual = float(np.median(step[~is_jump]))
    k = int(np.argmax(is_jump))
    first = f"row {rows[k + 1]}, by {abs(step[k]):.3g} s"
    direction = "back" if step[k] < 0.0 else "ahead"
    count = format_times(int(is_jump.sum()))
    note = (
        f"{name}: the clock was set {direction} {count} ({first}); the parts were "
        f"joined, a usual step of {usual:.3g} s apart."
    )
    return t + accumulate(np.where(is_jump, usual - step, 0.0)), note


def _find_stray(t: Array) -> NDArray[np.bool_]:
    """Selects the few stamps (T,) that break the order and are far from their neighbours."""
    if len(t) < 5:
        return np.zeros(len(t), dtype=np.bool_)
    is_backward = np.diff(t) < 0.0
    is_beside = np.append(is_backward, False) | np.append(False, is_backward)
    middle = np.median(sliding_window_view(np.pad(t, 2, mode="reflect"), 5), axis=1)
    is_stray = is_beside & (np.abs(t - middle) > LATE_S)
    return np.asarray(is_stray & (is_stray.mean() <= MOST_STRAY))


def format_times(count: int) -> str:
    """Returns `once`, or how many times."""
    return "once" if count == 1 else f"{count} times"


def select_new_rows(
    t: Array, values: Array, name: str
) -> tuple[NDArray[np.bool_], str]:
    """Selects rows (T,) that do not repeat stamp and values (T, D) of the row before."""
    is_repeated = (np.diff(t) == 0.0) & (np.diff(values, axis=0) == 0.0).all(axis=1)
    note = ""
    if is_repeated.any():
        note = (
            f"{name}: {int(is_repeated.sum())} of {len(t)} rows repeat the previous "
            "row, including its stamp, and were left out."
        )
    return np.append(True, ~is_repeated), note
