"""Playback of a recorded bag over DDS, with the bag's own time on `/clock`."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from rcl_interfaces.srv import GetParameters
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock

from nics_drl_bridge.errors import BackendError, RecordingError, nearest
from nics_drl_bridge.nodes import conversions
from nics_drl_bridge.nodes.conversions import message_type
from nics_drl_bridge.nodes.qos import profile_of
from nics_drl_bridge.nodes.runner import DELIVERY_S, open_context
from nics_drl_bridge.recording.bag_file import BagFile, opened
from nics_drl_bridge.recording.messages import Offer

CLOCK = "/clock"
CLOCK_PERIOD_NS = 10_000_000
"""Period of `/clock` between messages [ns of wall time]; it also precedes all but the first."""
QUEUE = 100
"""Depth for a topic whose publishers' quality of service is not in the bag."""
NAP_S = 0.05
PATIENCE_S = 60.0
DISCOVERY_S = 1.0
"""Time for subscribers to discover the topics before the first message [s]."""
ALONE_S = 5.0
"""Longest wait for a first subscriber; after it, the bag is played without one [s]."""


@dataclass(frozen=True)
class PlayOrder:
    """Bag to play, and options.

    Attributes:
        bag: folder or file of the bag.
        topics: to play; all if empty.
        rate: seconds of the bag per second of wall time.
        loop: whether to start again at the end; time on `/clock` then jumps back.
        clock: whether `/clock` is published; the bag's own is then not played.
        namespace: put in front of the topics' names, except `/clock`, `/tf`, `/tf_static`.
        lockstep: a node that must have taken each message before the next one is sent.
        domain_id: DDS domain; the environment's by default.
    """

    bag: Path
    topics: tuple[str, ...] = ()
    rate: float = 1.0
    loop: bool = False
    clock: bool = True
    namespace: str = ""
    lockstep: str | None = None
    domain_id: int | None = None


Timed = tuple[int, int, str, bytes]
"""Time of receipt [ns], rank of the topic among equal times, topic, message."""


class _Player:
    """Publishes messages one after another, when they are due."""

    def __init__(self, node: Node, order: PlayOrder, stopping: threading.Event) -> None:
        self._node, self._order, self._stopping = node, order, stopping
        self._publishers: dict[str, Publisher] = {}
        self._clock = node.create_publisher(Clock, CLOCK, 10) if order.clock else None
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._barrier = None
        if order.lockstep:
            service = f"/{order.lockstep.strip('/')}/get_parameters"
            self._barrier = node.create_client(GetParameters, service)

    def offer(self, topic: str, kind: str, offers: tuple[Offer, ...]) -> bool:
        """Opens a topic; returns False if its type is not installed."""
        found = message_type(kind)
        if found is None:
            return False
        space = self._order.namespace.strip("/")
        shared = topic in (CLOCK, "/tf", "/tf_static")
        name = topic if shared or not space else f"/{space}{topic}"
        best = Offer(  # matches any subscriber of one of the publishers
            max((offer.depth for offer in offers), default=QUEUE),
            not offers or any(offer.reliable for offer in offers),
            any(offer.transient_local for offer in offers),
        )
        self._publishers[topic] = self._node.create_publisher(found, name, profile_of(best))
        return True

    def ready(self) -> None:
        """Waits for the node in lock-step, or a while for subscribers."""
        began = time.monotonic()
        until = began + PATIENCE_S
        self._stopping.wait(DISCOVERY_S)
        while not self._heard() and time.monotonic() < began + ALONE_S:
            if self._stopping.wait(NAP_S):
                return
        while not self._matched() and time.monotonic() < until and not self._stopping.is_set():
            self._stopping.wait(NAP_S)
        while self._barrier is not None and not self._barrier.service_is_ready():
            if self._stopping.is_set():
                return
            if time.monotonic() > until:
                raise BackendError(
                    f"node {self._order.lockstep!r}: not found within {PATIENCE_S:g} s; start it, "
                    "or correct its name, namespace or ROS_DOMAIN_ID."
                )
            self._stopping.wait(NAP_S)

    def _heard(self) -> bool:
        """True if any of the topics has a subscriber."""
        return any(each.get_subscription_count() for each in self._publishers.values())

    def _matched(self) -> bool:
        """True if all known subscribers have found the topics."""
        return all(
            each.get_subscription_count() >= self._node.count_subscribers(each.topic_name)
            for each in self._publishers.values()
        )

    def finish(self) -> None:
        """Waits for delivery: messages are lost if their publisher goes before."""
        for each in self._publishers.values():
            each.wait_for_all_acked(Duration(seconds=DELIVERY_S))

    def play(self, messages: list[Timed]) -> int:
        """Publishes all messages; returns their number, fewer if it is stopped."""
        first, began, sent = messages[0][0], time.monotonic_ns(), 0
        now = first
        for due, _, topic, data in messages:
            while self._order.lockstep is None and now < due and not self._stopping.is_set():
                now = min(due, now + round(CLOCK_PERIOD_NS * self._order.rate))
                at = began + round((now - first) / self._order.rate)
                self._stopping.wait(max(at - time.monotonic_ns(), 0) * 1e-9)
                self._tick(now)
            if self._stopping.is_set():
                break
            if self._order.lockstep is not None:
                self._tick(due)
            self._publishers[topic].publish(data)
            sent += 1
            self._wait_for_peer()
        return sent

    def _tick(self, now_ns: int) -> None:
        if self._clock is not None:
            self._clock.publish(Clock(clock=conversions.stamp_to_ros(now_ns)))

    def _wait_for_peer(self) -> None:
        """Waits for the peer's answer: a node takes messages before requests that arrive later."""
        if self._barrier is None:
            return
        future = self._barrier.call_async(GetParameters.Request(names=["use_sim_time"]))
        self._executor.spin_until_future_complete(future, timeout_sec=PATIENCE_S)
        if not future.done():
            raise BackendError(
                f"node {self._order.lockstep!r}: has not answered for {PATIENCE_S:g} s; it hangs "
                "or has ended: start it anew."
            )


def play_bag(order: PlayOrder, say: Callable[[str], None]) -> int:
    """Publishes a bag until its end, SIGINT or SIGTERM.

    The messages are published as recorded, with the quality of service that their publishers
    offered. `/clock` gives the times of receipt, as with `ros2 bag play --clock`.

    Args:
        order: what to play.
        say: called with a sentence about each topic that is left out.

    Returns:
        The number of published messages.

    Raises:
        RecordingError: the bag is damaged, lacks a topic, or none of its types is installed.
        BackendError: the peer in lock-step does not answer.
    """
    stopping = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopping.set())
    with opened(order.bag) as bag:
        kinds = {topic: bag.types[topic] for topic in _wanted(bag, order)}
        offers = {topic: bag.offers(topic) for topic in kinds}
        messages = {topic: bag.serialized(topic) for topic in kinds}
    context = open_context([], order.domain_id)
    node = Node("bag_player", context=context, start_parameter_services=False)
    try:
        player = _Player(node, order, stopping)
        played = {t: m for t, m in messages.items() if player.offer(t, kinds[t], offers[t])}
        for topic in sorted(kinds.keys() - played.keys()):
            say(f"left out: {topic} is of {kinds[topic]}, whose package is not installed.")
        timed = _in_order(played)
        if not timed:
            raise RecordingError(f"{order.bag}: holds nothing that can be played here.")
        player.ready()
        sent = player.play(timed)
        while order.loop and not stopping.is_set():
            sent += player.play(timed)
        player.finish()
        return sent
    finally:
        node.destroy_node()
        context.try_shutdown()


def _wanted(bag: BagFile, order: PlayOrder) -> list[str]:
    names = [name if name.startswith("/") else f"/{name}" for name in order.topics]
    for name in names:
        if name not in bag.types:
            raise RecordingError(f"{bag.place}: has no topic {name!r}; {nearest(name, bag.types)}")
    return [
        topic
        for topic in sorted(names or bag.types)
        if topic not in bag.empty and not (order.clock and topic == CLOCK)
    ]


def _in_order(messages: Mapping[str, list[tuple[int, bytes]]]) -> list[Timed]:
    """Returns all messages in the order of receipt, at equal times in that of their topics."""
    ranked = enumerate(sorted(messages.items()))
    timed = [(ns, rank, topic, data) for rank, (topic, some) in ranked for ns, data in some]
    return sorted(timed, key=lambda one: one[:2])
