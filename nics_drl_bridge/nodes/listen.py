"""Facts about a live robot, collected by listening, for `report.doctor`."""

import time
from functools import partial
from typing import Any

from rclpy.node import Node

from nics_drl_bridge import defaults
from nics_drl_bridge.nodes.conversions import find_message_type
from nics_drl_bridge.nodes.listener import SpunNode
from nics_drl_bridge.nodes.qos import make_offer, make_profile
from nics_drl_bridge.recording.messages import Offer
from nics_drl_bridge.report.doctor_facts import (
    GYRO,
    KINDS,
    Endpoints,
    Facts,
    name_of_gyro,
    names_in,
)

NAME = "nics_doctor"
LOOK_S = 0.2
DISCOVERY_S = 10.0
# matches any offer, so it hears every topic
ANY_PUBLISHER = make_profile(Offer(100, reliable=False))


def listen(
    seconds: float,
    namespace: str = "",
    domain_id: int | None = None,
    imu: str = defaults.IMU_TOPIC,
) -> Facts:
    """Listen for a time [s] after the first message, awaited for at most 10 s; send nothing."""
    spun = SpunNode(NAME, domain_id)
    facts = Facts(f"the robot in {namespace or '/'}", True, names_in(namespace, imu))
    subscribed: set[str] = set()
    began = time.monotonic()
    end = None
    try:
        while time.monotonic() < (began + DISCOVERY_S if end is None else end):
            _look(spun.node, facts, subscribed, imu)
            spun.until(lambda: False, LOOK_S)
            if end is None and facts.heard:
                end = time.monotonic() + seconds
        _look(spun.node, facts, subscribed, imu)
    finally:
        spun.close()
    facts.end_ns = time.time_ns()
    return facts


def _look(node: Node, facts: Facts, subscribed: set[str], imu: str) -> None:
    for topic, kinds in node.get_topic_names_and_types():
        publishers = node.get_publishers_info_by_topic(topic)
        subscribers = node.get_subscriptions_info_by_topic(topic)
        offered = {info.topic_type for info in publishers} or set(kinds)
        facts.topics[topic] = Endpoints(
            tuple(sorted(offered)),
            tuple(make_offer(info.qos_profile) for info in publishers),
            tuple(
                make_offer(info.qos_profile)
                for info in subscribers
                if info.node_name != NAME
            ),
        )
    if GYRO in facts.names and GYRO not in subscribed:
        types = {
            topic: ends.types for topic, ends in facts.topics.items() if ends.offers
        }
        facts.names[GYRO] = name_of_gyro(facts.names, imu, types)
    for role, topic in facts.names.items():
        there = facts.topics.get(topic, Endpoints(()))
        wanted = [kind for kind in there.types if kind in KINDS[role]]
        if there.offers and wanted and role not in subscribed:
            subscribed.add(role)
            kind = find_message_type(wanted[0])
            take = partial(_take, facts, role)
            node.create_subscription(kind, topic, take, ANY_PUBLISHER)


def _take(facts: Facts, role: str, message: Any, info: Any) -> None:
    facts.take(role, int(info.get("received_timestamp") or time.time_ns()), message)
