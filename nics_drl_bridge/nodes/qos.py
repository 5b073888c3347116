"""Quality of service for each kind of topic, with the reason.

Reliable publishers match all subscribers, so this package publishes reliably, and subscribes best
effort wherever a lost message does no harm. Nothing is kept for late joiners: old data mislead.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy import qos as rclpy_qos
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

from nics_drl_bridge.recording.messages import Offer

try:
    from rclpy.event_handler import (
        PublisherEventCallbacks,
        SubscriptionEventCallbacks,
        UnsupportedEventTypeError,
    )
except ModuleNotFoundError:  # Humble
    from rclpy.qos_event import (
        PublisherEventCallbacks,
        SubscriptionEventCallbacks,
        UnsupportedEventTypeError,
    )


def profile_of(offer: Offer) -> QoSProfile:
    """Returns an offer, or a request, as a profile."""
    reliability, durability = rclpy_qos.ReliabilityPolicy, rclpy_qos.DurabilityPolicy
    return QoSProfile(
        history=rclpy_qos.HistoryPolicy.KEEP_LAST,
        depth=offer.depth,
        reliability=reliability.RELIABLE if offer.reliable else reliability.BEST_EFFORT,
        durability=durability.TRANSIENT_LOCAL if offer.transient_local else durability.VOLATILE,
    )


def offer_of(profile: QoSProfile) -> Offer:
    """Returns what a publisher offers, or a subscriber requests."""
    return Offer(
        max(profile.depth, 1),
        profile.reliability != rclpy_qos.ReliabilityPolicy.BEST_EFFORT,
        profile.durability == rclpy_qos.DurabilityPolicy.TRANSIENT_LOCAL,
    )


SENSOR = profile_of(Offer(5, reliable=False))
"""Subscriptions to scans, odometry, poses, IMU. A new datum beats a repeated old one: on a lossy
link a reliable scan arrives half a second late and looks fresh. It matches every publisher. Also in
lock-step: acknowledging each datum takes a tenth of a step, and lost data are requested again."""

SENSOR_RELIABLE = profile_of(Offer(10))  # publishers of the same: subscribers of both kinds match

EVERY_COMMAND = profile_of(Offer(10))
"""Commands in lock-step: each moves the world, and a second publisher must not replace the
first one's unnoticed."""

E_STOP = QoSProfile(
    history=rclpy_qos.HistoryPolicy.KEEP_ALL,
    reliability=rclpy_qos.ReliabilityPolicy.RELIABLE,
    durability=rclpy_qos.DurabilityPolicy.VOLATILE,
)
"""Subscriptions to `e_stop`. A press lasts for a single message, and the heartbeats that follow it,
also those of another publisher, must not push it out of the queue while nobody reads it."""

COMMAND = profile_of(Offer(1))  # commands and goals: only the newest counts, and it has to arrive
# Commands of which the gate looks at the publisher, too: the one that a second publisher sends
# at the same moment must not replace the first one's unnoticed.
EVERY_POLICY = profile_of(Offer(10))
TRANSFORMS = profile_of(Offer(100))  # `/tf`: like tf2's own, whose listeners request reliable
LATCHED = profile_of(Offer(1, transient_local=True))  # `/tf_static`, `map`: for late joiners too
DIAGNOSTICS = profile_of(Offer(10))  # as the diagnostic aggregator expects `/diagnostics`

MOMENT_S, UNKNOWN = 0.5, "_UNKNOWN_"
MOST_WAITING = 10_000  # messages that are taken at once, if a publisher never pauses


class QosWatch(Node):
    """A node whose publishers and subscriptions report peers that they can't talk to."""

    def create_publisher(self, kind: Any, topic: str, qos: Any, **options: Any) -> Publisher:
        """Creates a publisher; see rclpy."""
        watched = {"event_callbacks": self.publisher_events(topic, qos)}
        return super().create_publisher(kind, topic, qos, **watched | options)

    def publisher_events(self, topic: str, qos: Any) -> PublisherEventCallbacks:
        """Returns the callbacks for a publisher that rclpy makes without `create_publisher`."""
        warn = partial(self._warn, topic=topic, qos=qos, publishing=True)
        return PublisherEventCallbacks(incompatible_qos=warn)

    def create_subscription(
        self, kind: Any, topic: str, callback: Any, qos: Any, **options: Any
    ) -> Subscription:
        """Creates a subscription; see rclpy."""
        options = {"event_callbacks": self._subscription_events(topic, qos)} | options
        return super().create_subscription(kind, topic, callback, qos, **options)

    def create_lossless_subscription(
        self, kind: Any, topic: str, callback: Any, qos: Any, lost: Callable[[int], None]
    ) -> Subscription:
        """Creates a raw subscription that reports how many messages the middleware has lost."""
        events = self._subscription_events(topic, qos)
        events.message_lost = lambda event: lost(event.total_count_change)
        options = {"event_callbacks": events, "raw": True}
        try:
            return self.create_subscription(kind, topic, callback, qos, **options)
        except UnsupportedEventTypeError:
            self.get_logger().warning(f"{topic}: this middleware does not report lost messages")
            return self.create_subscription(kind, topic, callback, qos, raw=True)

    def _subscription_events(self, topic: str, qos: Any) -> SubscriptionEventCallbacks:
        warn = partial(self._warn, topic=topic, qos=qos, publishing=False)
        return SubscriptionEventCallbacks(incompatible_qos=warn)

    def _warn(self, event: Any, topic: str, qos: Any, publishing: bool) -> None:
        """Warns after a moment: a peer's name is known later than its quality of service."""
        policy = rclpy_qos.qos_policy_name_from_kind(event.last_policy_kind)
        resolved = self.resolve_topic_name(topic)

        def say() -> None:
            self.destroy_timer(timer)
            ours = qos if isinstance(qos, QoSProfile) else QoSProfile(depth=qos)
            name, theirs = self._misfit(resolved, ours, publishing)
            own, other = (_value(profile, policy) for profile in (ours, theirs))
            offered, asked = (own, other) if publishing else (other, own)
            cure = f"ask for {own}" if publishing else f"offer {own}, or put a relay between"
            self.get_logger().warning(
                f"{resolved}: no message passes between this node and {name}: the {policy.lower()} "
                f"that the publisher offers ({offered}) is less than what the subscription asks "
                f"for ({asked}); let {name} {cure}."
            )

        timer = self.create_timer(MOMENT_S, say, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _misfit(self, topic: str, ours: QoSProfile, publishing: bool) -> tuple[str, Any]:
        kind = "subscriptions" if publishing else "publishers"
        for peer in reversed(getattr(self, f"get_{kind}_info_by_topic")(topic)):
            pair = (ours, peer.qos_profile) if publishing else (peer.qos_profile, ours)
            if rclpy_qos.qos_check_compatible(*pair)[0] == rclpy_qos.QoSCompatibility.ERROR:
                return owner(peer) or "a peer", peer.qos_profile
        return "a peer", None


def take_waiting(subscription: Subscription) -> list[bytes]:
    """Takes the messages that wait in the queue of a raw subscription, oldest first."""
    contents: list[bytes] = []
    with subscription.handle:
        while len(contents) < MOST_WAITING:
            taken = subscription.handle.take_message(subscription.msg_type, True)
            if taken is None:
                break
            contents.append(taken[0])
    return contents


def _value(profile: Any, policy: str) -> str:
    value = getattr(profile, policy.lower(), None)
    return str(getattr(value, "name", value) or "unknown").lower().replace("_", " ")


def owner(end: Any) -> str | None:
    """Returns the full name of an endpoint's node; None until it is discovered."""
    name = f"{end.node_namespace.rstrip('/')}/{end.node_name}"
    return None if UNKNOWN in name else name
