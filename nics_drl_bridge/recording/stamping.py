"""Stamps: each stream's time axis and clock, by the headers' stamps or by receipt."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.recording.recording import Stream
from nics_drl_bridge.recording.topic_roles import Stamps

Nanoseconds = NDArray[np.int64]

RECEIVE, HEADER = "receive", "header"
SAME_CLOCK_S = (-0.001, 0.05)  # median delay from header to receipt on the recorder's own clock
MAX_WANDER_S = 1.0  # the delay from headers of one clock to their receipt varies by less
STALLED = 2.0  # percentage of messages that a stalled recorder may have received even later,
MAX_STALL_S = 30.0  # but by no more than this
MAX_LATE = 0.01  # share of messages that may arrive after one with a later stamp
MAX_UNSTAMPED = 0.05  # share that may lack a stamp at the start: a simulation has no time yet
ROBOT_STREAMS = ("command", "state", "wheels", "imu")  # of one computer, and so of one clock


@dataclass(frozen=True)
class TopicData:
    """Data read from a topic."""

    topic: str
    receive_ns: Nanoseconds  # (T,) times of receipt
    header_ns: Nanoseconds | None  # (T,) stamps of the headers; None if the type has no header
    values: Array  # (T, D)

    def rows(self, keep: NDArray[np.bool_] | NDArray[np.intp]) -> TopicData:
        """Returns the messages selected by `keep`, a mask (T,) or indices."""
        header = None if self.header_ns is None else self.header_ns[keep]
        return TopicData(self.topic, self.receive_ns[keep], header, self.values[keep])


def streams(
    data: Mapping[str, TopicData],
    stamps: Stamps,
    place: str,
    of_robot: Collection[str] = ROBOT_STREAMS,
) -> dict[str, Stream]:
    """Stamps each stream, from near 0 on; RecordingError: headers are missing or unusable."""
    # With `auto`, by headers if there are any. Those less than 50 ms before their receipt are of
    # the recorder's clock, others of a foreign one: shifted by the median delay, they leave a small
    # offset for calibration. Command, state, wheels and IMU share one clock, by receipt if need be.
    # Late messages are sorted; those before a simulation's first time are dropped.
    if stamps != "receive":
        data = {name: _in_order(part, place) for name, part in data.items()}
    origin = min(int(part.receive_ns.min()) for part in data.values())
    if stamps == "receive":
        return {name: _by_receipt(part, origin) for name, part in data.items()}
    headers = {name: _header(part, stamps, place) for name, part in data.items()}
    if stamps == "header":
        first = min(int(ns.min()) for ns in headers.values() if ns is not None)
        clocks = dict.fromkeys(data, (HEADER, origin - first))
    else:
        clocks = _clocks(data, headers, place)
    robot = {clocks[name][0] for name in of_robot if name in data}
    made = {}
    for name, part in data.items():
        ns, (clock, shift) = headers[name], clocks[name]
        if ns is None or (len(robot) > 1 and name in of_robot):
            made[name] = _by_receipt(part, origin)
        else:
            made[name] = Stream(_seconds(ns + shift - origin), part.values, clock)
    return made


def _clocks(
    data: Mapping[str, TopicData], headers: Mapping[str, Nanoseconds | None], place: str
) -> dict[str, tuple[str, int]]:
    """Returns each stream's clock, and the shift of its stamps to the recorder's clock [ns]."""
    foreign: dict[str, int] = {}
    clocks = dict.fromkeys(data, (RECEIVE, 0))
    for name, ns in headers.items():
        if ns is None:
            continue
        topic, delay = data[name].topic, data[name].receive_ns - ns
        median, least, most = int(np.median(delay)), delay.min(), delay.max()
        usual = np.percentile(delay, 100.0 - STALLED)
        wander = max(usual - median, median - least) * S_PER_NS
        if wander > MAX_WANDER_S or (most - median) * S_PER_NS > MAX_STALL_S:
            raise RecordingError(
                f"{place}: topic {topic!r}: its header stamps lie {least * S_PER_NS:.3f} to "
                f"{most * S_PER_NS:.3f} s before their receipt, so they are of several clocks or "
                "of a simulated time at another rate; write `stamps: receive` into the topics "
                "file, and record a simulation with `ros2 bag record --use-sim-time`."
            )
        if not SAME_CLOCK_S[0] <= median * S_PER_NS <= SAME_CLOCK_S[1]:
            alike = (c for c, d in foreign.items() if abs(d - median) * S_PER_NS < SAME_CLOCK_S[1])
            clock = next(alike, f"{HEADER} of {topic}" if foreign else HEADER)
            clocks[name] = (clock, foreign.setdefault(clock, median))
    return clocks


def _header(part: TopicData, stamps: Stamps, place: str) -> Nanoseconds | None:
    ns, topic = part.header_ns, f"{place}: topic {part.topic!r}"
    if ns is None or not ns.any():
        if stamps == "header":
            fault = "its messages have no header stamps"
            raise RecordingError(f"{topic}: {fault}; write `stamps: auto` into the topics file.")
        return None
    if not ns.all():
        fault = f"{(ns == 0).sum()} of {len(ns)} headers have no stamp"
        raise RecordingError(f"{topic}: {fault}; write `stamps: receive` into the topics file.")
    return ns


def _in_order(part: TopicData, place: str) -> TopicData:
    """Drops unstamped messages at the start, and sorts the few late ones by stamp."""
    ns = part.header_ns
    if ns is None or not ns.any():
        return part
    first = int(np.argmax(ns != 0))
    if first <= MAX_UNSTAMPED * len(ns):
        part, ns = part.rows(np.arange(first, len(ns))), ns[first:]
    if not ns.all():
        return part
    late = np.maximum.accumulate(ns) - ns
    if np.mean(late > 0) > MAX_LATE or late.max() * S_PER_NS > MAX_WANDER_S:
        k = int(np.argmax(late > 0))
        fault = f"the header stamps run backwards at message {k}, by {late[k] * S_PER_NS:.3f} s"
        advice = "write `stamps: receive` into the topics file, or cut the bag there"
        raise RecordingError(f"{place}: topic {part.topic!r}: {fault}; {advice}.")
    return part.rows(np.argsort(ns, kind="stable"))


def _by_receipt(part: TopicData, origin: int) -> Stream:
    order = np.argsort(part.receive_ns, kind="stable")
    return Stream(_seconds(part.receive_ns[order] - origin), part.values[order], RECEIVE)


def _seconds(ns: Nanoseconds) -> Array:
    return np.asarray(ns * S_PER_NS, dtype=np.float64)
