"""A process that hears `cmd_vel` as a real base does; it starts quickly, without the simulator."""

import multiprocessing
import time
from collections.abc import Mapping
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from geometry_msgs.msg import Twist
from rclpy.node import Node

from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.nodes import qos
from nics_drl_bridge.nodes.listener import SpunNode
from nics_drl_bridge.recording.messages import read_command


def listen_to_commands(node: Node, out: Connection) -> None:
    """Report for each `cmd_vel` when it arrived [s], its twist, and when it was written [ns]."""

    def tell(message: Twist, info: Mapping[str, Any]) -> None:
        twist = np.array(read_command(message))
        arrival_s = time.monotonic()
        if "received_timestamp" in info:  # the message then waited for this call
            arrival_s -= (time.time_ns() - info["received_timestamp"]) / NS_PER_S
        out.send((arrival_s, twist, info["source_timestamp"]))

    node.create_subscription(Twist, "cmd_vel", tell, qos.EVERY_COMMAND)


def hear(domain_id: int | None, out: Connection) -> None:
    """Report commands as a base does; end with the parent process, even if that is killed."""
    base = SpunNode("base", domain_id)
    listen_to_commands(base.node, out)
    parent = multiprocessing.parent_process()
    while parent is None or parent.is_alive():
        base.spin(timeout_s=1.0)
