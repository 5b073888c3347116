"""Bags over ROS 2: records a robot's messages as sent, and plays them back as recorded."""

import contextlib
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rcl_interfaces.srv import GetParameters
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock as ClockMessage

from nics_drl_bridge import defaults
from nics_drl_bridge.config import parse_namespace
from nics_drl_bridge.errors import BackendError, RecordingError, suggest
from nics_drl_bridge.nodes.conversions import (
    find_message_type,
    stamp_to_ros,
)
from nics_drl_bridge.nodes.listener import holds, open_context
from nics_drl_bridge.nodes.qos import BridgeNode, make_offer, make_profile
from nics_drl_bridge.nodes.runner import DELIVERY_S, call_periodically, run_node
from nics_drl_bridge.recording.bag_file import BagFile, open_bag
from nics_drl_bridge.recording.messages import Offer
from nics_drl_bridge.recording.write import BagSink, Storage, open_bag_sink

ROBOT = (  # topics of a robot, in its namespace
    "scan",
    "odom",
    "cmd_vel",
    "cmd_vel_raw",
    "joint_states",
    "imu",
    "imu/data",
    "pose",
    "ground_truth",
    "odometry/filtered",
    "e_stop",
    "goal_pose",
)
SHARED = ("/tf", "/tf_static", "/clock", "/diagnostics")
LOOK_S = 0.25  # period of the search for new topics [s]
FLUSH_S = 1.0  # maximum time lost if the process is killed [s]
QUEUE = 1000
CLOCK = "/clock"
# wall time between `/clock` messages while waiting for the next message of the bag
CLOCK_PERIOD_NS = 10_000_000
USUAL_DEPTH = 100  # queue depth of a topic whose quality of service is not in the bag
NAP_S = 0.05
PATIENCE_S = 60.0
# the type of a field in a `.msg` file
FIELD = re.compile(r"^\s*([A-Za-z][A-Za-z0-9_]*(?:/[A-Za-z0-9_/]+)?)")
# time for subscribers to discover the topics before the first message [s]
DISCOVERY_S = 1.0
ALONE_S = 5.0  # maximum wait for a subscriber before playing without one [s]


def collect_message_texts(kind: str) -> dict[str, str]:
    """Returns the `.msg` texts of a type and of the types in it, as far as they are installed."""
    texts: dict[str, str] = {}
    waiting = [kind]
    while waiting:
        kind = waiting.pop()
        file = _find_message_file(kind)
        if kind in texts or file is None:
            continue
        texts[kind] = file.read_text(encoding="utf-8")
        for field in filter(None, map(FIELD.match, texts[kind].splitlines())):
            package, _, name = field[1].rpartition("/")
            if package or name[0].isupper():
                folder = (package or kind).split("/")[0]
                waiting.append(f"{folder}/msg/{name}")
    return texts


def _find_message_file(kind: str) -> Path | None:
    from ament_index_python.search_paths import get_search_paths

    package, _, name = kind.split("/")
    prefixes = [sys.prefix]
    # the variable is not set if ROS 2 comes from wheels
    with contextlib.suppress(OSError):
        prefixes = [*get_search_paths(), sys.prefix]
    files = (
        Path(prefix) / "share" / package / "msg" / f"{name}.msg" for prefix in prefixes
    )
    return next((file for file in files if file.is_file()), None)


@dataclass(frozen=True)
class BagOrder:
    """Topics to record, and options."""

    out: Path  # folder of the bag
    topics: tuple[str, ...] = ()  # names; empty: `ROBOT` and `SHARED`
    # True: record every topic or, with a namespace, all of its topics and `SHARED`
    everything: bool = False
    namespace: str = ""  # prefix of topic names without a leading slash
    duration: float | None = None  # stop after this time [s]; None: never
    storage: Storage = defaults.BAG_STORAGE  # file format
    use_sim_time: bool = False  # True: take receive times from `/clock`

    def wants(self, topic: str) -> bool:
        """Returns True if a topic is to be recorded."""
        space = parse_namespace(self.namespace)
        if self.everything:
            return not space or topic.startswith(f"{space}/") or topic in SHARED
        names = self.topics or (*ROBOT, *SHARED)
        return topic in {
            name if name.startswith("/") else f"{space}/{name}" for name in names
        }


class BagRecorder(BridgeNode):
    """Writes wanted topics to a bag; `say` gets each topic that starts or can't be recorded."""

    def __init__(
        self,
        order: BagOrder,
        sink: BagSink,
        say: Callable[[str], None],
        **options: Any,
    ) -> None:
        overrides = [Parameter("use_sim_time", value=order.use_sim_time)]
        super().__init__(
            "bag_recorder",
            parameter_overrides=overrides,
            start_parameter_services=False,
            **options,
        )
        self._order = order
        self._sink = sink
        self._say = say
        self.skipped: dict[str, str] = {}  # topic -> sentence with the reason
        self._heard: dict[str, tuple[Offer, Subscription[Any]]] = {}
        self._began = self._flushed = time.monotonic()
        call_periodically(self, LOOK_S, self._look)
        self._look()

    def _look(self) -> None:
        now = time.monotonic()
        if now - self._flushed >= FLUSH_S:
            self._flushed = now
            with self._end_by_fault():
                self._sink.flush()
        if (
            self._order.duration is not None
            and now - self._began >= self._order.duration
        ):
            self.context.try_shutdown()
            return
        for topic, kinds in self.get_topic_names_and_types():
            if self._order.wants(topic):
                self._listen(topic, kinds)

    def _listen(self, topic: str, kinds: Sequence[str]) -> None:
        publishers = self.get_publishers_info_by_topic(topic)
        if not publishers or topic in self.skipped:
            return
        offers = [make_offer(info.qos_profile) for info in publishers]
        lasting = all(offer.transient_local for offer in offers)
        wanted = Offer(QUEUE, all(offer.reliable for offer in offers), lasting)
        subscribed = self._heard.get(topic)
        if subscribed is not None and subscribed[0] in (wanted, Offer(QUEUE, False)):
            return
        kind = find_message_type(kinds[0])
        if len(kinds) > 1 or kind is None:
            why = f"is of {kinds[0]}, whose package is not installed; install it to record it"
            if len(kinds) > 1:
                why = f"has publishers of {' and '.join(kinds)}; stop those of the wrong type"
            self.skipped[topic] = f"{topic} {why}."
            self._say(f"not recorded: {self.skipped[topic]}")
            return
        if subscribed is None:
            with self._end_by_fault():
                self._sink.add_topic(
                    topic, kinds[0], offers, collect_message_texts(kinds[0])
                )
            self._say(f"{topic} ({kinds[0]})")
        else:
            self.destroy_subscription(subscribed[1])
        take = partial(self._take, topic)
        profile = make_profile(wanted)
        self._heard[topic] = (
            wanted,
            self.create_subscription(kind, topic, take, profile, raw=True),
        )

    def _take(self, topic: str, data: bytes, info: Any) -> None:
        received = info.get("received_timestamp") or time.time_ns()
        if self._order.use_sim_time:
            received = self.get_clock().now().nanoseconds
        if received > 0 and self._sink.fault is None:
            with self._end_by_fault():
                self._sink.write(topic, int(received), data)

    @contextmanager
    def _end_by_fault(self) -> Iterator[None]:
        """Ends the recording when its storage fails; `record_bag` raises the fault."""
        try:
            yield
        except Exception:
            if self._sink.fault is None:
                raise
            self.context.try_shutdown()


def record_bag(order: BagOrder, say: Callable[[str], None]) -> dict[str, int]:
    """Records until the duration ends or a signal comes; returns message counts by topic.

    Raises BackendError if nothing was received, and RecordingError.
    """
    with open_bag_sink(order.out, order.storage, keep=True) as sink:
        node = run_node(partial(BagRecorder, order, sink, say), ["nics"])
        if sink.fault is not None:
            raise sink.fault
        if not sum(sink.counts.values()):
            skipped = " ".join(node.skipped.values())
            fix = "start the robot, or correct --topics, --namespace or ROS_DOMAIN_ID."
            fix += f" Not recorded: {skipped}" if skipped else ""
            raise BackendError(
                f"no topic had any messages, so no bag was written; {fix}"
            )
    return sink.counts


Timed = tuple[int, str, bytes]  # receive time [ns], topic, data


@dataclass(frozen=True)
class PlayOrder:
    """A bag to play, and options."""

    path: Path
    topics: Sequence[str] = ()  # names; empty: all of its topics
    rate: float = 1.0  # seconds of the bag per second
    loop: bool = False  # True: start again at the end
    # True: publish receive times on `/clock`, instead of the bag's own clock
    clock: bool = True
    namespace: str = ""  # prefix of topic names
    lockstep: str | None = None  # node that must have received each message

    def list_wanted(self, bag: BagFile) -> list[str]:
        """Returns the topics to play. Raises RecordingError if the bag lacks one."""
        names = [name if name.startswith("/") else f"/{name}" for name in self.topics]
        for name in names:
            if name not in bag.types:
                raise RecordingError(
                    f"{bag.place}: has no topic {name!r}; {suggest(name, bag.types)}"
                )
        left_out = {*bag.empty, *([CLOCK] if self.clock else [])}
        return [topic for topic in sorted(names or bag.types) if topic not in left_out]


class _Player:
    def __init__(self, node: Node, stopping: threading.Event, order: PlayOrder) -> None:
        self._node = node
        self._stopping = stopping
        self._order = order
        self.publishers: dict[str, Publisher] = {}
        self._clock = None
        if order.clock:
            self._clock = node.create_publisher(ClockMessage, CLOCK, 10)
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._barrier = None
        if order.lockstep:
            service = f"/{order.lockstep.strip('/')}/get_parameters"
            self._barrier = node.create_client(GetParameters, service)

    def offer_bag(self, say: Callable[[str], None]) -> list[Timed]:
        """Offers the topics of the bag; returns its messages by receive time, then by topic."""
        timed: list[Timed] = []
        with open_bag(self._order.path) as bag:
            for topic in self._order.list_wanted(bag):
                kind = bag.types[topic]
                if self._offer(topic, kind, bag.offers(topic)):
                    messages = bag.read_serialized(topic)
                    timed += ((ns, topic, data) for ns, data in messages)
                else:
                    why = f"is of {kind}, whose package is not installed"
                    say(f"left out: {topic} {why}.")
        if not timed:
            raise RecordingError(
                f"{self._order.path}: contains nothing that can be played here."
            )
        return sorted(timed, key=lambda message: message[:2])

    def _offer(self, topic: str, kind: str, offers: tuple[Offer, ...]) -> bool:
        message_class = find_message_type(kind)
        if message_class is None:
            return False
        name = topic
        if topic not in (CLOCK, "/tf", "/tf_static"):
            name = f"{parse_namespace(self._order.namespace)}{topic}"
        best = Offer(  # compatible with every subscriber of any original publisher
            max((offer.depth for offer in offers), default=USUAL_DEPTH),
            not offers or any(offer.reliable for offer in offers),
            any(offer.transient_local for offer in offers),
        )
        self.publishers[topic] = self._node.create_publisher(
            message_class, name, make_profile(best)
        )
        return True

    def wait_for_subscribers(self) -> None:
        publishers = self.publishers.values()
        count_subscribers = self._node.count_subscribers
        self._stopping.wait(DISCOVERY_S)
        self._wait(
            lambda: any(publisher.get_subscription_count() for publisher in publishers),
            ALONE_S,
        )
        self._wait(  # until all known subscribers are connected
            lambda: all(
                p.get_subscription_count() >= count_subscribers(p.topic_name)
                for p in publishers
            ),
            PATIENCE_S,
        )
        if self._barrier is not None and not self._wait(
            self._barrier.service_is_ready, PATIENCE_S
        ):
            fix = "start it, or correct its name, namespace or ROS_DOMAIN_ID."
            peer = f"node {self._order.lockstep!r}"
            raise BackendError(f"{peer}: not found within {PATIENCE_S:g} s; {fix}")

    def _wait(self, condition: Callable[[], bool], patience_s: float) -> bool:
        return holds(lambda: condition() or self._stopping.is_set(), patience_s, NAP_S)

    def play(self, messages: list[Timed]) -> int:
        now = first = messages[0][0]
        began = time.monotonic_ns()
        rate = self._order.rate
        lockstep = bool(self._order.lockstep)
        for sent, (due, topic, data) in enumerate(messages):
            while not lockstep and now < due and not self._stopping.is_set():
                now = min(due, now + round(CLOCK_PERIOD_NS * rate))
                at = began + round((now - first) / rate)
                self._stopping.wait(max(at - time.monotonic_ns(), 0) * 1e-9)
                self._tick(now)
            if self._stopping.is_set():
                return sent
            if lockstep:
                self._tick(due)
            self.publishers[topic].publish(data)
            self._wait_for_peer()
        return len(messages)

    def _tick(self, now_ns: int) -> None:
        if self._clock is not None:
            self._clock.publish(ClockMessage(clock=stamp_to_ros(now_ns)))

    def _wait_for_peer(self) -> None:
        """Waits for the peer's answer: a node handles messages before later requests."""
        if self._barrier is None:
            return
        future = self._barrier.call_async(GetParameters.Request(names=["use_sim_time"]))
        self._executor.spin_until_future_complete(future, timeout_sec=PATIENCE_S)
        if not future.done():
            fix = f"{PATIENCE_S:g} s; it hangs or has ended: start it again."
            peer = f"node {self._order.lockstep!r}"
            raise BackendError(f"{peer}: has not answered for {fix}")


def play_bag(order: PlayOrder, say: Callable[[str], None]) -> int:
    """Publishes a bag until its end, SIGINT or SIGTERM; returns the number of published messages.

    Raises RecordingError if the bag is damaged, lacks a topic, or none of its types is installed,
    BackendError if the peer does not answer.
    """
    stopping = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopping.set())
    context = open_context([])
    node = Node("bag_player", context=context, start_parameter_services=False)
    try:
        player = _Player(node, stopping, order)
        timed = player.offer_bag(say)
        player.wait_for_subscribers()
        sent = player.play(timed)
        while order.loop and not stopping.is_set():
            sent += player.play(timed)
        # Destroying the node would drop undelivered messages.
        for each in player.publishers.values():
            each.wait_for_all_acked(Duration(seconds=DELIVERY_S))
        return sent
    finally:
        node.destroy_node()
        context.try_shutdown()
