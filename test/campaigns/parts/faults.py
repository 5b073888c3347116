"""The faults that are put around a gate, and by when each must have stopped the robot."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from parts.faulty_robot import ALL, Robot
from sensor_msgs.msg import LaserScan

from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.nodes import conversions
from nics_drl_bridge.nodes.processes import NodeProcess

SOON_S = 0.10
LATE_S = 0.40
FROZEN_S = 0.5


@dataclass(frozen=True)
class Around:
    """What an injection can break: the robot, and the processes of policy and gate."""

    robot: Robot
    policy: NodeProcess | None
    gate: NodeProcess | None


Injection = Callable[[Around], object]


@dataclass(frozen=True)
class Fault:
    """A way in which something breaks.

    Attributes:
        limit_s: by when the robot must have been told to stop [s].
        inject: breaks it. Of several, each in turn.
        since: the topic whose last good datum the limit counts from; empty for the fault itself.
        policy: whether it needs the policy's process.
        first_word: whether only the first command after the fault must be a zero; the robot may
            drive on then.
    """

    limit_s: float
    inject: Injection | Sequence[Injection]
    since: str = ""
    policy: bool = False
    first_word: bool = False


def _silence(*topics: str) -> Injection:
    return lambda around: around.robot.silent.update(topics)


def _twist(x: float, turn: float) -> Injection:
    def change(message: TwistStamped) -> TwistStamped:
        message.twist = conversions.twist_to_ros([x, 0.0, turn])
        return message

    return lambda around: around.robot.change.update({"cmd_vel_raw": change})


def _stamp(topic: str, off_s: float, growing: bool = False) -> Injection:
    """Moves a topic's stamps; further with each message, if wanted."""

    def inject(around: Around) -> None:
        sent = [0]

        def change(message: Any) -> Any:
            sent[0] += 1
            off = off_s * (sent[0] if growing else 1)
            stamp = conversions.stamp_from_ros(message.header.stamp) + round(
                off * NS_PER_S
            )
            message.header.stamp = conversions.stamp_to_ros(stamp)
            return message

        around.robot.change[topic] = change

    return inject


def _freeze(topic: str, stamped: bool = False) -> Injection:
    """Repeats the last good message, as a frozen driver does; with the stamp of now if wanted."""

    def inject(around: Around) -> None:
        held = around.robot.last[topic]

        def change(message: Any) -> Any:
            if stamped:
                held.header.stamp = message.header.stamp
            return held

        around.robot.change[topic] = change

    return inject


def _alternate(around: Around) -> None:
    """Two pictures in turn, as of a driver that swaps two buffers."""
    shown = [list(around.robot.last["scan"].ranges)]
    sent = [0]

    def change(message: LaserScan) -> LaserScan:
        if len(shown) < 2:
            shown.append(list(message.ranges))
        sent[0] += 1
        message.ranges = shown[sent[0] % 2]
        return message

    around.robot.change["scan"] = change


def _freeze_but_one(around: Around) -> None:
    """The same picture, in which one beam flickers."""
    shown = list(around.robot.last["scan"].ranges)
    sent = [0]

    def change(message: LaserScan) -> LaserScan:
        sent[0] += 1
        message.ranges = [shown[0] + 1e-3 * sent[0], *shown[1:]]
        return message

    around.robot.change["scan"] = change


def _few_beams(around: Around) -> None:
    def change(message: LaserScan) -> LaserScan:
        message.ranges = message.ranges[:100]
        return message

    around.robot.change["scan"] = change


def _nan_scan(around: Around) -> None:
    def change(message: LaserScan) -> LaserScan:
        message.ranges = [float("nan")] * len(message.ranges)
        return message

    around.robot.change["scan"] = change


def _teleport(x: float, y: float) -> Injection:
    """Odometry shows the robot elsewhere from now on."""

    def change(message: Odometry) -> Odometry:
        message.pose.pose.position.x += x
        message.pose.pose.position.y += y
        return message

    return lambda around: around.robot.change.update({"odom": change})


def _jump(seconds: int) -> Injection:
    return lambda around: setattr(around.robot, "jump_ns", seconds * NS_PER_S)


def _signal(how: signal.Signals, republished: bool = False) -> Injection:
    """Ends or stops the policy; somebody may go on with its last command."""

    def inject(around: Around) -> None:
        if around.policy is not None:
            os.kill(around.policy.pid, how)
            around.robot.republished = republished

    return inject


def _freeze_gate(around: Around) -> None:
    """Stops the gate itself for a while; what it said before is heard before it goes on."""
    if around.gate is not None:
        os.kill(around.gate.pid, signal.SIGSTOP)
        around.robot.until(lambda: False, FROZEN_S)
        around.robot.heard.clear()
        os.kill(around.gate.pid, signal.SIGCONT)


FAULTS: dict[str, Fault] = {
    "policy_killed": Fault(LATE_S, _signal(signal.SIGKILL), policy=True),
    "policy_frozen": Fault(LATE_S, _signal(signal.SIGSTOP), policy=True),
    "policy_hung": Fault(
        LATE_S, _signal(signal.SIGSTOP, republished=True), policy=True
    ),
    "scan_silent": Fault(LATE_S, _silence("scan"), "scan"),
    "odom_silent": Fault(LATE_S, _silence("odom"), "odom"),
    "nan_scan": Fault(LATE_S, _nan_scan, "scan"),
    "clock_jump": Fault(LATE_S, (_jump(10), _jump(-10), _jump(1), _jump(-1)), "scan"),
    "e_stop": Fault(
        SOON_S,
        (
            lambda around: around.robot.press(),
            lambda around: around.robot.call("e_stop"),
        ),
    ),
    "e_stop_silent": Fault(LATE_S, _silence("e_stop"), "e_stop"),
    "all_silent": Fault(LATE_S, _silence(*ALL), "scan"),
    "command_silent": Fault(LATE_S, _silence("cmd_vel_raw"), "cmd_vel_raw"),
    "command_frozen": Fault(LATE_S, _freeze("cmd_vel_raw"), "cmd_vel_raw"),
    "command_nan": Fault(LATE_S, _twist(float("nan"), 0.0), "cmd_vel_raw"),
    "command_inf": Fault(LATE_S, _twist(float("inf"), 0.0), "cmd_vel_raw"),
    "command_absurd": Fault(LATE_S, _twist(1e9, 0.0), "cmd_vel_raw"),
    "command_from_the_future": Fault(
        LATE_S, _stamp("cmd_vel_raw", 3600.0), "cmd_vel_raw"
    ),
    "scan_of_another_lidar": Fault(LATE_S, _few_beams, "scan"),
    "scan_stamps_frozen": Fault(LATE_S, _freeze("scan"), "scan"),
    "scan_from_the_future": Fault(LATE_S, _stamp("scan", 3600.0), "scan"),
    "stamps_run_ahead": Fault(
        LATE_S,
        (_stamp("scan", 0.35, growing=True), _stamp("odom", 0.35, growing=True)),
        "scan",
    ),
    "stamps_creep": Fault(1.20, _stamp("scan", 0.02, growing=True), "scan"),
    "odom_teleports": Fault(
        LATE_S, (_teleport(3.0, 0.0), _teleport(0.0, -1.0)), "odom"
    ),
    "scan_frozen": Fault(1.50, _freeze("scan", stamped=True), "scan"),
    "scan_alternates": Fault(1.50, _alternate, "scan"),
    "scan_frozen_but_one_beam": Fault(1.50, _freeze_but_one, "scan"),
    "no_motion": Fault(1.10, lambda around: setattr(around.robot, "stuck", True)),
    "gate_frozen": Fault(FROZEN_S + LATE_S, _freeze_gate, first_word=True),
}
