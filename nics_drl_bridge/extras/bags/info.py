"""Contents of a bag: its topics with their message counts, rates and clocks."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.recording.bag_file import BagFile, open_bag, read_times
from nics_drl_bridge.recording.stamping import MAX_WANDER_S, SAME_CLOCK_S, Nanoseconds

GAP = 3.0  # a longer silence, in median periods, is a gap
NO_HEADER = "no header"
UNSTAMPED = "never stamped"
UNKNOWN = "unknown type"
RECORDER = "recorder's"
FOREIGN = "another"
SEVERAL = "several"


@dataclass(frozen=True)
class BagTopic:
    """A topic of a bag."""

    topic: str
    type: str
    count: int  # number of messages
    rate_hz: float | None = None  # inverse of the median period
    # receive time of the first message, since the start of the bag
    first_s: float | None = None
    last_s: float | None = None
    gaps: int = 0  # number of silences of more than three median periods
    longest_gap_s: float | None = None
    clock: str = UNKNOWN  # clock of the header stamps, or why there are none
    # median of receive time minus stamp; None without stamps
    delay_s: float | None = None
    jitter_s: float | None = None  # 95 % minus 5 % quantile of that delay
    backwards: int = 0  # number of stamps earlier than the previous one


@dataclass(frozen=True)
class BagInfo:
    """Contents of a bag."""

    path: str
    size_bytes: int  # total size of its files
    start_ns: int  # first receive time, on the recorder's clock
    duration_s: float  # from the first to the last receive time
    messages: int  # number of messages
    topics: tuple[BagTopic, ...]


def read_bag_info(path: str | Path) -> BagInfo:
    """Reads a whole bag and describes its contents. Raises RecordingError if it is damaged."""
    path = Path(path)
    with open_bag(path) as bag:
        received = {topic: _read_receipt(bag, topic) for topic in sorted(bag.types)}
        times = np.concatenate([ns for ns, _ in received.values()])
        start = int(times.min())
        duration_s = (int(times.max()) - start) * S_PER_NS
        topics = tuple(
            _describe_topic(topic, bag.types[topic], ns - start, delays)
            for topic, (ns, delays) in received.items()
        )
    return BagInfo(
        str(path), _measure_size(path), start, duration_s, len(times), topics
    )


def _measure_size(path: Path) -> int:
    """Returns the total size of a bag's files [bytes]."""
    files = [path] if path.is_file() else filter(Path.is_file, path.iterdir())
    return sum(file.stat().st_size for file in files)


def _read_receipt(bag: BagFile, topic: str) -> tuple[Nanoseconds, Nanoseconds | str]:
    if not bag.can_decode(topic):
        return np.array(
            [ns for ns, _ in bag.read_serialized(topic)], dtype=np.int64
        ), UNKNOWN
    receive, stamps = read_times(bag.read_messages(topic))
    if stamps is None:
        return receive, NO_HEADER
    return receive, receive - stamps if stamps.any() else UNSTAMPED


def _describe_topic(
    topic: str, kind: str, since: Nanoseconds, delays: Nanoseconds | str
) -> BagTopic:
    clock: dict[str, Any] = {"clock": delays}
    if not isinstance(delays, str):
        quantiles = np.percentile(delays * S_PER_NS, (5.0, 50.0, 95.0))
        low, middle, high = quantiles.tolist()
        clock = {
            "clock": FOREIGN,
            "delay_s": middle,
            "jitter_s": high - low,
            "backwards": int((np.diff(since - delays) < 0).sum()),
        }
        if high - low > MAX_WANDER_S:
            clock["clock"] = SEVERAL
        elif SAME_CLOCK_S[0] <= middle <= SAME_CLOCK_S[1]:
            clock["clock"] = RECORDER
    if not len(since):
        return BagTopic(topic, kind, 0, **clock)
    intervals = np.diff(since) * S_PER_NS
    usual = float(np.median(intervals)) if len(intervals) else 0.0
    return BagTopic(
        topic,
        kind,
        len(since),
        rate_hz=1.0 / usual if usual > 0.0 else None,
        first_s=float(since[0] * S_PER_NS),
        last_s=float(since[-1] * S_PER_NS),
        gaps=int((intervals > GAP * usual).sum()) if usual > 0.0 else 0,
        longest_gap_s=float(intervals.max()) if len(intervals) else None,
        **clock,
    )
