"""Recording of what a robot publishes, as sent, without touching the robot."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.parameter import Parameter
from rclpy.subscription import Subscription

from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.nodes.conversions import message_texts, message_type
from nics_drl_bridge.nodes.qos import QosWatch, offer_of, profile_of
from nics_drl_bridge.nodes.runner import run_node
from nics_drl_bridge.recording.messages import Offer
from nics_drl_bridge.recording.write import BagSink, Storage, bag_sink

ROBOT = (
    "scan", "odom", "cmd_vel", "cmd_vel_raw", "joint_states", "imu", "pose", "ground_truth",
    "odometry/filtered", "e_stop",
)  # fmt: skip
"""Topics of a robot, in its namespace."""
SHARED = ("/tf", "/tf_static", "/clock", "/diagnostics")
LOOK_S = 0.25
"""Period of the search for new topics [s]."""
FLUSH_S = 1.0
"""Greatest span that is lost if the process is killed [s]."""
QUEUE = 1000


@dataclass(frozen=True)
class BagOrder:
    """Topics to record, and options.

    Attributes:
        out: folder of the bag.
        topics: their names; those of `ROBOT` and `SHARED` if empty.
        everything: records every topic; with a namespace, all of it and `SHARED`.
        namespace: of the robot; prefix of topic names without a leading slash.
        duration: stops after this time [s]; None for never.
        storage: format of the file.
        use_sim_time: takes times of receipt from `/clock`.
    """

    out: Path
    topics: tuple[str, ...] = ()
    everything: bool = False
    namespace: str = ""
    duration: float | None = None
    storage: Storage = "mcap"
    use_sim_time: bool = False

    def wants(self, topic: str) -> bool:
        """True if a topic is to be recorded."""
        space = f"/{self.namespace.strip('/')}" if self.namespace.strip("/") else ""
        if self.everything:
            return not space or topic.startswith(f"{space}/") or topic in SHARED
        names = self.topics or (*ROBOT, *SHARED)
        return topic in {name if name.startswith("/") else f"{space}/{name}" for name in names}


class BagRecorder(QosWatch):
    """Writes the messages of all wanted topics into a bag, serialised as received.

    A subscription requests the best quality of service that all publishers of its topic offer, so
    that none of them is left out; their offers are stored in the bag.

    Args:
        context: of the node.
        order: what to record.
        sink: of the bag.
        say: called with a sentence when a topic begins or can't be recorded.
    """

    def __init__(
        self, context: Context, order: BagOrder, sink: BagSink, say: Callable[[str], None]
    ) -> None:
        given = [Parameter("use_sim_time", value=order.use_sim_time)]
        super().__init__(
            "bag_recorder", context=context, parameter_overrides=given,
            start_parameter_services=False,
        )  # fmt: skip
        self._order, self._sink, self._say = order, sink, say
        self._heard: dict[str, tuple[Offer, Subscription[Any]]] = {}
        self.skipped: dict[str, str] = {}
        self._began = self._flushed = time.monotonic()
        self.create_timer(LOOK_S, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._look()

    def _look(self) -> None:
        now = time.monotonic()
        if now - self._flushed >= FLUSH_S:
            self._flushed = now
            self._sink.flush()
        if self._order.duration is not None and now - self._began >= self._order.duration:
            self.context.try_shutdown()
            return
        for topic, kinds in self.get_topic_names_and_types():
            if self._order.wants(topic):
                self._listen(topic, kinds)

    def _listen(self, topic: str, kinds: Sequence[str]) -> None:
        """Subscribes to a topic, or again if a new publisher offers less."""
        publishers = self.get_publishers_info_by_topic(topic)
        if not publishers or topic in self.skipped:
            return
        offers = [offer_of(info.qos_profile) for info in publishers]
        wanted = Offer(
            QUEUE, all(o.reliable for o in offers), all(o.transient_local for o in offers)
        )
        known = self._heard.get(topic)
        if known is not None and known[0] in (wanted, Offer(QUEUE, False)):
            return
        kind = message_type(kinds[0])
        if len(kinds) > 1 or kind is None:
            self._skip(topic, kinds)
            return
        if known is None:
            self._sink.add_topic(topic, kinds[0], offers, message_texts(kinds[0]))
            self._say(f"{topic} ({kinds[0]})")
        else:
            self.destroy_subscription(known[1])
        subscription = self.create_subscription(
            kind, topic, self._taker(topic), profile_of(wanted), raw=True
        )
        self._heard[topic] = wanted, subscription

    def _skip(self, topic: str, kinds: Sequence[str]) -> None:
        if len(kinds) > 1:
            why = f"has publishers of {' and '.join(kinds)}; end those of the wrong type"
        else:
            why = f"is of {kinds[0]}, whose package is not installed; install it to record it"
        self.skipped[topic] = f"{topic} {why}."
        self._say(f"not recorded: {self.skipped[topic]}")

    def _taker(self, topic: str) -> Callable[[Any, Any], None]:
        def take(data: bytes, info: Any) -> None:
            received = self._received_ns(info)
            if received > 0:
                self._sink.write(topic, received, data)

        return take

    def _received_ns(self, info: Any) -> int:
        if self._order.use_sim_time:
            return int(self.get_clock().now().nanoseconds)
        return int(info.get("received_timestamp") or time.time_ns())


def record_bag(order: BagOrder, say: Callable[[str], None]) -> dict[str, int]:
    """Records until the duration is over, SIGINT or SIGTERM.

    Args:
        order: what to record.
        say: called with a sentence when a topic begins or can't be recorded.

    Returns:
        The number of messages of each topic.

    Raises:
        BackendError: nothing was received.
        RecordingError: the bag can't be written.
    """
    nodes: list[BagRecorder] = []
    with bag_sink(order.out, order.storage) as sink:

        def make(context: Context) -> BagRecorder:
            nodes.append(BagRecorder(context, order, sink, say))
            return nodes[-1]

        run_node(make, ["nics"])
        skipped = nodes[-1].skipped.values() if nodes else ()
        if not sum(sink.counts.values()):
            raise BackendError(
                "nothing was heard on any of the topics, so no bag is written; start the robot, "
                "or correct --topics, --namespace or ROS_DOMAIN_ID."
                + (f" Not recorded: {' '.join(skipped)}" if skipped else "")
            )
    return sink.counts
