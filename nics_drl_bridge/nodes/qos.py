"""Quality of service of each kind of topic, with the reason."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy


def _keep_last(depth: int, reliability: ReliabilityPolicy) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=reliability,
        durability=DurabilityPolicy.VOLATILE,
    )


SENSOR = _keep_last(5, ReliabilityPolicy.BEST_EFFORT)
"""Scans and odometry: a new one beats a repeated old one. Matches every publisher."""

SENSOR_RELIABLE = _keep_last(10, ReliabilityPolicy.RELIABLE)
"""What the simulator offers, so that subscribers of both kinds match it; and what a lock-step
client asks for, because there a lost datum would never be sent again."""

EVERY_COMMAND = _keep_last(10, ReliabilityPolicy.RELIABLE)
"""Commands in lock-step: each moves the world, so that a second publisher does not go unnoticed by
replacing the first one's."""

COMMAND = _keep_last(1, ReliabilityPolicy.RELIABLE)
"""Commands: only the newest counts, and it has to arrive."""

TRANSFORMS = _keep_last(100, ReliabilityPolicy.RELIABLE)
"""`/tf`: as tf2's own broadcasters, whose listeners ask for reliable."""

FIXED_TRANSFORMS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""`/tf_static`: told once, and again to everybody who comes later."""
