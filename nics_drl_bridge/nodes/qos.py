"""Quality of service of each kind of topic, with the reason.

A publisher that is reliable matches subscribers of both kinds, one that is best effort only those
that ask for no more: what this package publishes is reliable, what it subscribes to is best effort
wherever a lost message does no harm. So RViz, `ros2 topic echo`, Nav2 and drivers of every kind
match it as they are. Nothing is kept for late joiners (volatile): a robot's old data mislead.

Says which peer offers or asks for a quality of service that does not fit, and what to do.

Who is at the other end of a topic.
"""

from __future__ import annotations

from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
    qos_policy_name_from_kind,
)
from rclpy.qos import QoSCompatibility as Compatibility
from rclpy.subscription import Subscription

from nics_drl_bridge.recording.messages import Offer


def _keep_last(depth: int, reliability: ReliabilityPolicy) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=reliability,
        durability=DurabilityPolicy.VOLATILE,
    )


SENSOR = _keep_last(5, ReliabilityPolicy.BEST_EFFORT)
"""Subscribing to scans, odometry, poses, IMU. A new datum beats a repeated old one: on a lossy link
a reliable scan arrives half a second late and looks fresh. It matches every publisher. In lock-step
too: an acknowledgement of each datum is a tenth of a step, and what is lost is asked for again."""

SENSOR_RELIABLE = _keep_last(10, ReliabilityPolicy.RELIABLE)
"""Publishing them, so that subscribers of both kinds match."""

EVERY_COMMAND = _keep_last(10, ReliabilityPolicy.RELIABLE)
"""Commands in lock-step: each moves the world, so that a second publisher does not go unnoticed by
replacing the first one's. Also `e_stop`, of which no press may be overwritten."""

COMMAND = _keep_last(1, ReliabilityPolicy.RELIABLE)
"""Commands and goals: only the newest counts, and it has to arrive."""

TRANSFORMS = _keep_last(100, ReliabilityPolicy.RELIABLE)
"""`/tf`: as tf2's own broadcasters, whose listeners ask for reliable."""

FIXED_TRANSFORMS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""`/tf_static`: told once, and again to everybody who comes later."""

DIAGNOSTICS = _keep_last(10, ReliabilityPolicy.RELIABLE)
"""`/diagnostics`: rare and small, and each one may tell of something else; as the diagnostic
aggregator expects it."""


try:
    from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
except ModuleNotFoundError:  # Humble
    from rclpy.qos_event import PublisherEventCallbacks, SubscriptionEventCallbacks


MOMENT_S = 0.5
SENTENCE = (
    "{topic}: no message passes between this node and {peer}: the {policy} that the publisher "
    "offers ({offered}) is less than what the subscription asks for ({asked}); let {cure}."
)


class QosWatch(Node):
    """A node each of whose publishers and subscriptions tells of peers that it can't talk to."""

    def create_publisher(self, kind: Any, topic: str, qos: Any, **options: Any) -> Publisher:
        """As rclpy's."""
        watched = {"event_callbacks": self.publisher_events(topic, qos)}
        return super().create_publisher(kind, topic, qos, **watched | options)

    def publisher_events(self, topic: str, qos: Any) -> PublisherEventCallbacks:
        """What a publisher that rclpy makes without `create_publisher` is to be given."""
        return PublisherEventCallbacks(
            incompatible_qos=lambda event: self._warn(event, topic, qos, publishing=True)
        )

    def create_subscription(
        self, kind: Any, topic: str, callback: Any, qos: Any, **options: Any
    ) -> Subscription:
        """As rclpy's."""
        watched = SubscriptionEventCallbacks(
            incompatible_qos=lambda event: self._warn(event, topic, qos, publishing=False)
        )
        options = {"event_callbacks": watched} | options
        return super().create_subscription(kind, topic, callback, qos, **options)

    def _warn(self, event: Any, topic: str, qos: Any, publishing: bool) -> None:
        """Warns in a moment: the name of a peer is told later than its quality of service."""
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        resolved = self.resolve_topic_name(topic)

        def say() -> None:
            self.destroy_timer(timer)
            self.get_logger().warning(self._sentence(resolved, qos, policy, publishing))

        timer = self.create_timer(MOMENT_S, say, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _sentence(self, topic: str, qos: Any, policy: str, publishing: bool) -> str:
        """What does not fit at a resolved topic; the policy is named as rclpy names it."""
        ours = qos if isinstance(qos, QoSProfile) else QoSProfile(depth=qos)
        name, theirs = self._misfit(topic, ours, publishing)
        own, other = (_value(profile, policy) for profile in (ours, theirs))
        offered, asked = (own, other) if publishing else (other, own)
        cure = (
            f"{name} ask for {own}" if publishing else f"{name} offer {own}, or put a relay between"
        )
        return SENTENCE.format(
            topic=topic, peer=name, policy=policy.lower(), offered=offered, asked=asked, cure=cure
        )

    def _misfit(self, topic: str, ours: QoSProfile, publishing: bool) -> tuple[str, Any]:
        """Name and profile of the last peer that does not fit, as far as it is known."""
        look = (
            self.get_subscriptions_info_by_topic
            if publishing
            else (self.get_publishers_info_by_topic)
        )
        for peer in reversed(look(topic)):
            pair = (ours, peer.qos_profile) if publishing else (peer.qos_profile, ours)
            if qos_check_compatible(*pair)[0] == Compatibility.ERROR:
                return owner(peer) or "a peer", peer.qos_profile
        return "a peer", None


def _value(profile: Any, policy: str) -> str:
    """The value of a policy in a profile, in words."""
    value = getattr(profile, policy.lower(), None)
    return str(getattr(value, "name", value) or "unknown").lower().replace("_", " ")


UNKNOWN = "_UNKNOWN_"


def owner(end: Any) -> str | None:
    """Full name of the node of a `TopicEndpointInfo`; None while only the end itself is known.

    A node's name travels apart from its ends.
    """
    name = f"{end.node_namespace.rstrip('/')}/{end.node_name}"
    return None if UNKNOWN in name else name


def offer_of(profile: QoSProfile) -> Offer:
    """What a publisher offers, or a subscriber asks for."""
    return Offer(
        max(profile.depth, 1),
        profile.reliability != ReliabilityPolicy.BEST_EFFORT,
        profile.durability == DurabilityPolicy.TRANSIENT_LOCAL,
    )
