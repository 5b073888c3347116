"""Quality of service for each kind of topic, with the reason.

Reliable publishers match all subscribers, so this package publishes reliably, and subscribes with
best effort wherever a lost message does no harm. Late joiners get no old data, which would mislead.
"""

import contextlib
import copy
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any

from rclpy import qos as rclpy_qos
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSPolicyKind, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.gate import inputs
from nics_drl_bridge.middleware.measurement import CMD_VEL
from nics_drl_bridge.recording.messages import Offer

try:
    from rclpy.event_handler import (
        SubscriptionEventCallbacks,
        UnsupportedEventTypeError,
    )
except ModuleNotFoundError:  # Humble
    from rclpy.qos_event import (
        SubscriptionEventCallbacks,
        UnsupportedEventTypeError,
    )


def make_profile(offer: Offer) -> QoSProfile:
    """Return an offer, or a request, as a profile."""
    reliability = rclpy_qos.ReliabilityPolicy
    durability = rclpy_qos.DurabilityPolicy
    return QoSProfile(
        history=rclpy_qos.HistoryPolicy.KEEP_LAST,
        depth=offer.depth,
        reliability=reliability.RELIABLE if offer.reliable else reliability.BEST_EFFORT,
        durability=durability.TRANSIENT_LOCAL
        if offer.transient_local
        else durability.VOLATILE,
    )


def make_offer(profile: QoSProfile) -> Offer:
    """Return what a publisher offers, or a subscriber requests."""
    return Offer(
        max(profile.depth, 1),
        profile.reliability != rclpy_qos.ReliabilityPolicy.BEST_EFFORT,
        profile.durability == rclpy_qos.DurabilityPolicy.TRANSIENT_LOCAL,
    )


SENSOR = make_profile(Offer(5, reliable=False))
"""Subscriptions to scans, odometry, poses, IMU; they match every publisher. A new datum is worth
more than a repeated old one: on a lossy link a reliable scan arrives half a second late and looks
fresh. Lock-step uses this too: acknowledging each datum takes a tenth of a step, and lost data are
requested again."""

# publishers of the same topics; they match subscribers of both kinds
SENSOR_RELIABLE = make_profile(Offer(10))

EVERY_COMMAND = make_profile(Offer(10))
"""Commands in lock-step, each of which moves the world, and commands whose publisher the gate
checks: a second publisher must not replace the first one's command unnoticed."""

E_STOP = QoSProfile(
    history=rclpy_qos.HistoryPolicy.KEEP_ALL,
    reliability=rclpy_qos.ReliabilityPolicy.RELIABLE,
    durability=rclpy_qos.DurabilityPolicy.VOLATILE,
)
"""Subscriptions to `e_stop`. A press is a single message. The heartbeats after it, also those of
another publisher, must not push it out of the queue while nobody reads."""

# commands and goals: only the newest counts, and it must arrive
COMMAND = make_profile(Offer(1))
# `/tf`: like tf2's own, whose listeners request reliable
TRANSFORMS = make_profile(Offer(100))
# `/tf_static`, `map`: late joiners get them too
LATCHED = make_profile(Offer(1, transient_local=True))
# as the diagnostic aggregator expects `/diagnostics`
DIAGNOSTICS = make_profile(Offer(10))

UNKNOWN = "_UNKNOWN_"
MOST_WAITING = 10_000  # most messages taken at once, in case a publisher never pauses

# prefix of the parameters that override a topic's quality of service
OVERRIDES = "qos_overrides."
# Topics (names before remapping) whose quality of service decides whether a robot stops.
FIXED_TOPICS = (CMD_VEL, inputs.RAW, inputs.E_STOP, "ackermann_cmd")


def get_given_values(node: Node) -> dict[str, Parameter]:
    """Return the initial values that the user has given to a node's parameters, by their names."""
    values: dict[str, Parameter] = getattr(node, "given", {})
    return values


@contextlib.contextmanager
def override_qos(node: Node, topic: str, end: str) -> Iterator[dict[str, Any]]:
    """Yield the options with which rclpy makes a `publisher` or `subscription` of a topic.

    Raises ConfigError for a topic whose quality of service is fixed, and within the context for a
    value that rclpy refuses.
    """
    prefix = f"{OVERRIDES}{node.resolve_topic_name(topic)}.{end}."
    given = get_given_values(node)
    names = sorted(name for name in given if name.startswith(prefix))
    if names and topic.rsplit("/", 1)[-1] in FIXED_TOPICS:
        raise ConfigError(
            f"parameter {names[0]!r}: can't be overridden, because the robot's stop depends on "
            "it; leave it out."
        )
    if not names:
        yield {}
        return
    kinds = [kind for kind in QoSPolicyKind if f"{prefix}{kind.name.lower()}" in given]
    try:
        yield {"qos_overriding_options": QoSOverridingOptions(kinds)}
    except RuntimeError as error:
        raise ConfigError(
            f"parameter {names[0]!r}: {error}; correct it, or leave it out."
        ) from None


class BridgeNode(Node):
    """A node whose topics' quality of service can be overridden, except for `FIXED_TOPICS`.

    The parameters are `qos_overrides.TOPIC.publisher.POLICY` (or `subscription`), as in any ROS 2
    node. The keyword arguments are those of rclpy's Node.
    """

    def __init__(self, name: str, **options: Any) -> None:
        self.given: dict[str, Parameter] = {}  # the values that the user has given
        self._is_begun = False
        super().__init__(
            name, automatically_declare_parameters_from_overrides=True, **options
        )

    def declare_parameters(
        self, namespace: str, parameters: Any, ignore_override: bool = False
    ) -> Any:
        """Declare parameters; see rclpy, which calls this first with all values that are given.

        Those are noted, and declared when their meaning is known: an empty list has no type yet.
        """
        if ignore_override and not self._is_begun:
            self._is_begun = True
            for name, value, _ in parameters:
                self.given[name] = Parameter(name, value=value)
            return []
        return super().declare_parameters(namespace, parameters, ignore_override)

    def create_publisher(
        self, kind: Any, topic: str, qos: Any, **options: Any
    ) -> Publisher:
        """Create a publisher; see rclpy."""
        with override_qos(self, topic, "publisher") as chosen:
            return super().create_publisher(
                kind, topic, copy_profile(qos), **chosen, **options
            )

    def create_subscription(
        self, kind: Any, topic: str, callback: Any, qos: Any, **options: Any
    ) -> Subscription:
        """Create a subscription; see rclpy."""
        with override_qos(self, topic, "subscription") as chosen:
            return super().create_subscription(
                kind, topic, callback, copy_profile(qos), **chosen, **options
            )

    def create_lossless_subscription(
        self,
        kind: Any,
        topic: str,
        callback: Any,
        qos: Any,
        lost: Callable[[int], object],
    ) -> Subscription:
        """Create a raw subscription that reports how many messages the middleware has lost."""
        create = partial(self.create_subscription, kind, topic, callback, qos, raw=True)
        events = SubscriptionEventCallbacks(
            message_lost=lambda event: lost(event.total_count_change)
        )
        try:
            return create(event_callbacks=events)
        except UnsupportedEventTypeError:
            self.get_logger().warning(
                f"{topic}: this middleware does not report lost messages"
            )
            return create()


def take_waiting(subscription: Subscription) -> list[bytes]:
    """Take the waiting messages from the queue of a raw subscription, oldest first."""
    contents: list[bytes] = []
    with subscription.handle:
        while len(contents) < MOST_WAITING:
            taken = subscription.handle.take_message(subscription.msg_type, True)
            if taken is None:
                break
            contents.append(taken[0])
    return contents


def copy_profile(qos: Any) -> QoSProfile:
    """Return a copy of a profile, because rclpy writes overridden policies into its argument."""
    return copy.copy(qos) if isinstance(qos, QoSProfile) else QoSProfile(depth=qos)


def find_owner(end: Any) -> str | None:
    """Return the full name of an endpoint's node, or None until it is discovered."""
    name = f"{end.node_namespace.rstrip('/')}/{end.node_name}"
    return None if UNKNOWN in name else name


def list_owners(ends: Iterable[Any]) -> list[str]:
    """Return the full names of the nodes of endpoints, as far as they are discovered."""
    names = map(find_owner, ends)
    return [name for name in names if name is not None]
