"""Converts any bag to MCAP for Foxglove, including type definitions and transforms."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.middleware.measurement import ODOM, SCAN
from nics_drl_bridge.middleware.playback import SCAN_TYPE
from nics_drl_bridge.recording import topic_roles
from nics_drl_bridge.recording.bag_file import BagFile, Message, open_bag
from nics_drl_bridge.recording.messages import Offer
from nics_drl_bridge.recording.write import FRAMES, open_bag_sink

MOVING = "/tf"
FIXED = "/tf_static"
OFFERS = {FIXED: (Offer(1, transient_local=True),)}
Row = tuple[str, int, bytes]
"""Topic, receive time [ns] and bytes of a message."""


def convert(
    path: str | Path, out: str | Path, model: SimulatorModel | None = None
) -> list[str]:
    """Writes a bag of ROS 2 or 1 as MCAP, and returns the added topics.

    A viewer needs transforms to place scans. A bag without transforms gets those of its odometry
    and, with a model, of the lidar's mount. Raises RecordingError.
    """
    with open_bag(path) as bag, open_bag_sink(out) as sink:
        rows = list[Row]()
        for topic, kind in bag.types.items():
            sink.add_topic(
                topic, kind, bag.offers(topic), definition=bag.get_definition(topic)
            )
            rows += ((topic, ns, data) for ns, data in bag.read_serialized(topic))
        transforms = [
            *_convert_moving(bag, sink.store),
            *_convert_fixed(bag, sink.store, model),
        ]
        added = list(dict.fromkeys(topic for topic, _, _ in transforms))
        for topic in added:
            sink.add_topic(topic, topic_roles.TRANSFORMS, OFFERS.get(topic, ()))
        for row in sorted(rows + transforms, key=lambda row: row[1]):
            sink.write(*row)
    return added


def _convert_moving(bag: BagFile, store: Any) -> Iterator[Row]:
    if MOVING in bag.types:
        return
    for message in _make_messages(bag, f"/{ODOM}", topic_roles.ODOMETRY):
        odometry = message.content
        pose = odometry.pose.pose
        place = pose.position.x, pose.position.y, pose.position.z
        transform = _transform(
            store, odometry.header, odometry.child_frame_id, place, pose.orientation
        )
        yield MOVING, message.receive_ns, transform


def _convert_fixed(
    bag: BagFile, store: Any, model: SimulatorModel | None
) -> Iterator[Row]:
    scans = _make_messages(bag, f"/{SCAN}", SCAN_TYPE)
    if model is None or FIXED in bag.types or not scans:
        return
    x, y, heading = model.lidar.mount
    half = heading / 2.0
    turned = store.types["geometry_msgs/msg/Quaternion"](
        0.0, 0.0, np.sin(half), np.cos(half)
    )
    base = FRAMES[1]
    for message in _make_messages(bag, f"/{ODOM}", topic_roles.ODOMETRY)[:1]:
        base = message.content.child_frame_id
    scan = scans[0].content.header
    header = store.types["std_msgs/msg/Header"](scan.stamp, base)
    transform = _transform(store, header, scan.frame_id, (x, y, 0.0), turned)
    yield FIXED, bag.span_ns[0], transform


def _make_messages(bag: BagFile, topic: str, kind: str) -> list[Message]:
    return bag.read_messages(topic) if bag.types.get(topic) == kind else []


def _transform(
    store: Any, header: Any, child: str, place: tuple[float, float, float], turned: Any
) -> bytes:
    types = store.types
    moved = types["geometry_msgs/msg/Transform"](
        types["geometry_msgs/msg/Vector3"](*place), turned
    )
    message = types[topic_roles.TRANSFORMS](
        [types[topic_roles.TRANSFORM](header, child, moved)]
    )
    return bytes(store.serialize_cdr(message, topic_roles.TRANSFORMS))
