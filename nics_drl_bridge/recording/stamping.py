"""Stamps: time axis and clock of each stream of a bag.

A message has two times: its receipt by the bag, and, if it has a header, the sender's stamp. The
header's is better, since it has no transport jitter; but a Twist has none, and the sender's clock
may differ from the recorder's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.recording.recording import Stream
from nics_drl_bridge.recording.topic_roles import Stamps

Array = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]

RECEIVE, HEADER = "receive", "header"
SAME_CLOCK_S = (-0.001, 0.05)
"""Range of the median delay from header to receipt [s] if both are of the recorder's clock."""
MAX_WANDER_S = 1.0
"""The delay from headers of one clock to their receipt varies by less than this [s]."""
STALLED = 2.0
"""Percentage of messages that a stalled recorder may have received even later,"""
MAX_STALL_S = 30.0
"""but by no more than this [s]."""
MAX_LATE = 0.01
"""Share of messages that may arrive after one with a later stamp."""
MAX_UNSTAMPED = 0.05
"""Share of messages at the start that may lack a stamp: a simulation has no time yet."""
ROBOT_STREAMS = ("command", "state", "wheels", "imu")
"""Streams from the robot's own computer, which must share a clock."""


@dataclass(frozen=True)
class TopicData:
    """Data read from a topic.

    Attributes:
        topic: its name.
        receive_ns: (T,) times of receipt [ns].
        header_ns: (T,) stamps of the headers [ns]; None if the type has no header.
        values: (T, D).
    """

    topic: str
    receive_ns: Nanoseconds
    header_ns: Nanoseconds | None
    values: Array

    def rows(self, keep: NDArray[np.bool_] | NDArray[np.intp]) -> TopicData:
        """Returns the messages selected by `keep`, a mask (T,) or indices."""
        header = None if self.header_ns is None else self.header_ns[keep]
        return TopicData(self.topic, self.receive_ns[keep], header, self.values[keep])


def streams(data: Mapping[str, TopicData], stamps: Stamps, place: str) -> dict[str, Stream]:
    """Assigns a time axis to each stream.

    With `auto`, a stream is stamped by its headers if it has any. Headers less than 50 ms before
    their receipt are of the recorder's clock, which also stamps streams without header (clock
    `receive`). Others are of a foreign clock (`header`): their stamps are shifted by the median
    delay, so that only a small offset is left for calibration. Command, state, wheels and IMU are
    put on one clock, by receipt if need be. The few messages that arrived after one with a later
    stamp are sorted, and those before a simulation's first time are dropped.

    Args:
        data: messages by stream name; empty ones are not allowed.
        stamps: which of the two times to use, see `TopicRoles`.
        place: the recording's name, for errors.

    Returns:
        Streams by name; their times begin near 0.

    Raises:
        RecordingError: headers are missing, of several clocks, or run backwards.
    """
    if stamps == "receive":
        return _by_receipt(data, _origin(data))
    data = {name: _in_order(part, place) for name, part in data.items()}
    headers = {name: _header(part, stamps, place) for name, part in data.items()}
    if stamps == "header":
        origin = min(int(ns.min()) for ns in headers.values() if ns is not None)
        return {
            name: Stream(_seconds(ns - origin), data[name].values, HEADER)
            for name, ns in headers.items()
            if ns is not None
        }
    return _auto(data, headers, place)


def _auto(
    data: Mapping[str, TopicData], headers: Mapping[str, Nanoseconds | None], place: str
) -> dict[str, Stream]:
    clocks = _clocks(data, headers, place)
    robot = {clocks[name][0] for name in ROBOT_STREAMS if name in data}
    origin, made = _origin(data), {}
    for name, part in data.items():
        ns, (clock, shift) = headers[name], clocks[name]
        if ns is None or (len(robot) > 1 and name in ROBOT_STREAMS):
            made.update(_by_receipt({name: part}, origin))
        else:
            made[name] = Stream(_seconds(ns + shift - origin), part.values, clock)
    return made


def _clocks(
    data: Mapping[str, TopicData], headers: Mapping[str, Nanoseconds | None], place: str
) -> dict[str, tuple[str, int]]:
    """Returns each stream's clock, and the shift of its stamps to the recorder's clock [ns]."""
    foreign: dict[str, int] = {}
    clocks = {}
    for name, part in data.items():
        ns = headers[name]
        if ns is None:
            clocks[name] = (RECEIVE, 0)
            continue
        delay = part.receive_ns - ns
        median = int(np.median(delay))
        usual = np.percentile(delay, 100.0 - STALLED)
        wander = max(usual - median, median - delay.min()) * S_PER_NS
        if wander > MAX_WANDER_S or (delay.max() - median) * S_PER_NS > MAX_STALL_S:
            raise RecordingError(
                f"{place}: topic {part.topic!r}: its header stamps lie "
                f"{delay.min() * S_PER_NS:.3f} to {delay.max() * S_PER_NS:.3f} s before their "
                "receipt, so they are of several clocks or of a simulated time at another rate; "
                "write `stamps: receive` into the topics "
                "file, and record a simulation with `ros2 bag record --use-sim-time`."
            )
        if SAME_CLOCK_S[0] <= median * S_PER_NS <= SAME_CLOCK_S[1]:
            clocks[name] = (RECEIVE, 0)
            continue
        alike = (c for c, d in foreign.items() if abs(d - median) * S_PER_NS < SAME_CLOCK_S[1])
        clock = next(alike, f"{HEADER} of {part.topic}" if foreign else HEADER)
        clocks[name] = (clock, foreign.setdefault(clock, median))
    return clocks


def _header(part: TopicData, stamps: Stamps, place: str) -> Nanoseconds | None:
    """Returns the checked header stamps of a topic; None if there are none."""
    ns, topic = part.header_ns, f"{place}: topic {part.topic!r}"
    empty = np.zeros(0, bool) if ns is None else ns == 0
    if ns is None or empty.all():
        if stamps == "header":
            raise RecordingError(
                f"{topic}: its messages have no header stamps; write `stamps: auto` into the "
                "topics file."
            )
        return None
    if empty.any():
        raise RecordingError(
            f"{topic}: {empty.sum()} of {len(ns)} headers have no stamp; write `stamps: "
            "receive` into the topics file."
        )
    return ns


def _in_order(part: TopicData, place: str) -> TopicData:
    """Drops unstamped messages at the start, and sorts the few late ones by stamp."""
    if part.header_ns is None or not part.header_ns.any():
        return part
    first = int(np.argmax(part.header_ns != 0))
    if first <= MAX_UNSTAMPED * len(part.header_ns):
        part = part.rows(np.arange(first, len(part.header_ns)))
    ns = part.header_ns
    if ns is None or not ns.all():
        return part
    late = np.maximum.accumulate(ns) - ns
    if np.mean(late > 0) > MAX_LATE or late.max() * S_PER_NS > MAX_WANDER_S:
        k = int(np.argmax(late > 0))
        raise RecordingError(
            f"{place}: topic {part.topic!r}: the header stamps run backwards at message {k}, by "
            f"{late[k] * S_PER_NS:.3f} s; write `stamps: receive` into the topics file, or cut the "
            "bag there."
        )
    return part.rows(np.argsort(ns, kind="stable"))


def _origin(data: Mapping[str, TopicData]) -> int:
    return min(int(part.receive_ns.min()) for part in data.values())


def _by_receipt(data: Mapping[str, TopicData], origin: int) -> dict[str, Stream]:
    made = {}
    for name, part in data.items():
        order = np.argsort(part.receive_ns, kind="stable")
        t = _seconds(part.receive_ns[order] - origin)
        made[name] = Stream(t, part.values[order], RECEIVE)
    return made


def _seconds(ns: Nanoseconds) -> Array:
    return np.asarray(ns * S_PER_NS, dtype=np.float64)
