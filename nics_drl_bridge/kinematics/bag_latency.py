"""The latency that a bag shows: how long after its stamp a message was received."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.kinematics.bag_file import BagFile, Message
from nics_drl_bridge.kinematics.bag_messages import stamp
from nics_drl_bridge.kinematics.latency import Delay, Latency
from nics_drl_bridge.kinematics.stamping import SAME_CLOCK_S
from nics_drl_bridge.kinematics.topic_roles import ODOMETRY

SCAN = "sensor_msgs/msg/LaserScan"
LEAST_MESSAGES = 20
PERCENTILES = (5.0, 50.0, 95.0)
SPANNED = 0.9
"""The share of an even distribution that lies between the first and the last of them."""


def latency_of(bag: BagFile, odom: str | None = None) -> Latency:
    """Measures the delays of scan and odometry in a bag.

    Only stamps of the recorder's own clock tell them; where a topic is not there, has too few
    messages or is stamped by another clock, its delay is not known.

    Args:
        bag: an open bag.
        odom: the topic of odometry; the one of that type or name by default.
    """
    scan, odom = _topic(bag, SCAN, "scan"), odom or _topic(bag, ODOMETRY, "odom")
    return Latency(
        scan=None if scan is None else _delay(bag.messages(scan)),
        odom=None if odom is None else _delay(bag.messages(odom)),
    )


def _topic(bag: BagFile, kind: str, name: str) -> str | None:
    """The one topic of a type, or the one of several that has the usual name."""
    of_kind = [topic for topic, one in bag.types.items() if one == kind and topic not in bag.empty]
    named = [topic for topic in of_kind if re.search(rf"(^|/){name}$", topic)]
    found = of_kind if len(of_kind) == 1 else named
    return found[0] if len(found) == 1 else None


def _delay(messages: Sequence[Message]) -> Delay | None:
    """The delays of messages with stamps, as an even distribution."""
    if len(messages) < LEAST_MESSAGES:
        return None
    stamps = np.array([stamp(m.content) for m in messages], dtype=np.int64)
    late = (np.array([m.receive_ns for m in messages], dtype=np.int64) - stamps) * S_PER_NS
    late = late - np.array([_sweep(m) for m in messages])
    low, middle, high = np.percentile(late, PERCENTILES)
    if not stamps.all() or not SAME_CLOCK_S[0] <= middle <= SAME_CLOCK_S[1]:
        return None
    jitter = float(high - low) / SPANNED
    return Delay(least=max(0.0, float(middle) - jitter / 2.0), jitter=jitter)


def _sweep(message: Message) -> float:
    """From the stamp of a scan, which is that of beam 0, to its last beam [s]."""
    scan = message.content
    if not hasattr(scan, "ranges"):
        return 0.0
    return max(0.0, float(scan.time_increment)) * max(0, len(scan.ranges) - 1)
