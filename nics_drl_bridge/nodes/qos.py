"""Quality of service of each kind of topic, with the reason.

A publisher that is reliable matches subscribers of both kinds, one that is best effort only those
that ask for no more: what this package publishes is reliable, what it subscribes to is best effort
wherever a lost message does no harm. So RViz, `ros2 topic echo`, Nav2 and drivers of every kind
match it as they are. Nothing is kept for late joiners (volatile): a robot's old data mislead.
"""

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
