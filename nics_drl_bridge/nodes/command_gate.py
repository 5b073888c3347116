"""command_gate: passes the policy's commands on while they can be trusted.

Inputs of the gate, read from serialised messages (`wire`) into records of `safety`.

rclpy would first make a Python object of each field, which at 50 Hz costs the gate more than
deciding.

Real-time priority of a process, if the system allows it.
"""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable
from functools import partial

import numpy as np
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry as OdometryMessage
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from nics_drl_bridge.gate import shield
from nics_drl_bridge.gate.black_box import Entry
from nics_drl_bridge.gate.gate import decide
from nics_drl_bridge.gate.inputs import (
    Arm,
    Command,
    Estimate,
    EStop,
    Input,
    Odometry,
    Press,
    Reset,
    Scan,
    Tick,
)
from nics_drl_bridge.gate.limits import PERIOD_S
from nics_drl_bridge.gate.state import Decision, begin
from nics_drl_bridge.lidar.spec import LidarSpec, from_device
from nics_drl_bridge.nodes import qos, wire
from nics_drl_bridge.nodes.conversions import is_rotation
from nics_drl_bridge.nodes.diagnostics import Condition, Diagnostics
from nics_drl_bridge.nodes.gate_log import GateLog
from nics_drl_bridge.nodes.gate_parameters import declare_gate
from nics_drl_bridge.nodes.qos import QosWatch
from nics_drl_bridge.nodes.runner import declare, last_word, run_node
from nics_drl_bridge.nodes.wire import UNREADABLE, TwistWriter

STALE_S = 0.05
"""A motion that was decided on longer ago than this is decided on again [s]."""


class CommandGate(QosWatch):
    """Stands between `cmd_vel_raw` and `cmd_vel`, in its own process.

    It starts disarmed. `~/arm` lets commands pass if all checks succeed, `~/e_stop` presses the
    emergency stop, `~/reset` clears a latched stop and leaves the gate disarmed. All decisions are
    made in `safety`, on the steady clock.

    Args:
        context: of the node.
    """

    def __init__(self, context: Context) -> None:
        super().__init__("command_gate", context=context)
        parameters = declare_gate(self)
        self._config, self._lidar = parameters.config, parameters.lidar
        self._state = begin(self._config)
        self._log = GateLog(parameters, self.get_logger())
        if not self._config.e_stop_required:
            self.get_logger().warning(
                "e_stop_required is false: an e_stop that was never heard does not stop the robot. "
                "That is for simulations; set it on a vehicle."
            )
        if self._config.shield is not None:
            self.get_logger().info(parameters.shield_said)
            shield.rehearse()
        else:
            self.get_logger().warning(parameters.shield_said)
        self._out = self.create_publisher(Twist, "cmd_vel", qos.COMMAND)
        self._twists = TwistWriter()
        self._zero = self._twists.write(np.zeros(3))
        self._listen()
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(PERIOD_S, lambda: self._decide(Tick()), clock=steady)
        Diagnostics(self, "gate", self._look)
        about = "Real-time priority (SCHED_FIFO) of its process, 1 to 99; 0 for none."
        priority = declare(self, "priority", 0, about, low=0, high=HIGHEST, read_only=True)
        refused = take_priority(priority)  # once all threads exist
        if refused:
            self.get_logger().warning(refused)

    def _listen(self) -> None:
        for kind, topic, read, profile in (
            (LaserScan, "scan", partial(scan, self._lidar), qos.SENSOR),
            (OdometryMessage, "odom", odometry, qos.SENSOR),
            (OdometryMessage, "odometry/filtered", estimate, qos.SENSOR),
            (TwistStamped, "cmd_vel_raw", command, qos.COMMAND),
            (Bool, "e_stop", e_stop, qos.EVERY_COMMAND),
        ):
            taker = partial(self._take, topic, read)
            self.create_subscription(kind, topic, taker, profile, raw=True)
        self.create_service(Trigger, "~/arm", self._on_arm)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(Trigger, "~/e_stop", self._on_e_stop_call)

    def _take(self, topic: str, read: Callable[[bytes], Input], content: bytes) -> None:
        try:
            given = read(content)
        except UNREADABLE as error:  # of a middleware with another encoding
            self._log.refuse(f"{topic}: {error}")
            return
        self._decide(given)

    def _on_arm(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return self._answer(Arm(self.count_publishers(self._out.topic_name)), response)

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return self._answer(Reset(), response)

    def _on_e_stop_call(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._decide(Press())
        response.success, response.message = True, "the e-stop is pressed; ~/reset releases it"
        return response

    def _answer(self, given: Input, response: Trigger.Response) -> Trigger.Response:
        decision = self._decide(given)
        response.success, response.message = decision.granted, decision.answer
        self.get_logger().info(f"{type(given).__name__.lower()}: {decision.answer}")
        return response

    def _decide(self, given: Input) -> Decision:
        now, before = time.monotonic(), self._state
        self._state, decision = decide(self._config, before, given, now)
        # Publish first: the rest may take its time.
        instead = self._say(decision, now) if decision.publish else None
        self._log.note(Entry(now, given, before, decision))
        if instead is not None and not isinstance(given, Press):
            self._decide(instead)
        return decision

    def _say(self, decision: Decision, now: float) -> Input | None:
        """Publishes a decision; the only path to the robot except `stop`.

        Returns:
            An input to decide on instead, or None. What is not finite is sent as zero and presses
            the e-stop. A motion that was decided on too long ago, in a process frozen since, is not
            sent at all; so the clock is read immediately before.
        """
        finite, content = (
            bool(np.isfinite(decision.twist).all()),
            self._twists.write(decision.twist),
        )
        if not finite:
            self._out.publish(self._zero)
            self._log.no_number(decision.twist.tolist())
            return Press()
        if decision.cause is None and time.monotonic() - now > STALE_S:
            return Tick()
        self._out.publish(content)
        return None

    def _look(self) -> Condition:
        """Returns the finding for `/diagnostics`; other publishers are reported, not prevented."""
        found = self._log.finding(self._state)
        others = self.count_publishers(self._out.topic_name) - 1
        if others < 1:
            return found
        told = f"others publish on cmd_vel, too ({others}), and move the robot past this gate"
        self.get_logger().warning(told, throttle_duration_sec=10.0)
        return found._replace(message=f"{found.message}; {told}", warns=True)

    def stop(self) -> None:
        """Leaves a zero command behind."""
        last_word(self._out, self._zero)
        self._log.close()


def main(args: list[str] | None = None) -> None:
    """Entry point of the executable."""
    run_node(CommandGate, args, "command_gate")
    sys.stdout.flush()
    sys.stderr.flush()
    # Everything is closed. Tearing down the interpreter as well takes half a second of a core, and
    # several where others need it too.
    os._exit(0)


if __name__ == "__main__":
    main()


ROTATION = slice(3, 7)
"""Position of an odometry's quaternion among its numbers."""
VARIANCES = wire.POSE_COVARIANCE, wire.POSE_COVARIANCE + 7, wire.POSE_COVARIANCE + 35
"""Positions of the variances of x, y and heading."""


def scan(lidar: LidarSpec, content: bytes) -> Scan:
    """Reads a serialised LaserScan. Raises `wire.UNREADABLE`."""
    ranges = from_device(wire.ranges_of(content), lidar)
    return Scan(wire.stamp_of(content), ranges, wire.angles_of(content))


def odometry(content: bytes) -> Odometry:
    """Reads a serialised Odometry; without a rotation its pose is NaN. Raises `wire.UNREADABLE`."""
    pose, twist = wire.odometry_of(content)
    if not is_rotation(*wire.numbers_of(content)[ROTATION].tolist()):
        pose = np.full(3, np.nan)
    return Odometry(wire.stamp_of(content), pose, twist)


def estimate(content: bytes) -> Estimate:
    """Reads a serialised Odometry of an estimator. Raises `wire.UNREADABLE`."""
    x, y, heading = (wire.numbers_of(content)[place] for place in VARIANCES)
    with np.errstate(invalid="ignore"):  # a negative variance gives NaN, too
        std = np.sqrt([np.maximum(x, y), heading])
    return Estimate(wire.odometry_of(content)[1], std)


def command(content: bytes) -> Command:
    """Reads a serialised TwistStamped. Raises `wire.UNREADABLE`."""
    return Command(wire.stamp_of(content), np.array(wire.stamped_twist_of(content)))


def e_stop(content: bytes) -> EStop:
    """Reads a serialised Bool. Raises `wire.UNREADABLE`."""
    return EStop(wire.truth_of(content))


HIGHEST = 99
REFUSED = (
    "parameter 'priority': the system does not allow a real-time priority of {priority} ({error}); "
    "allow it by `ulimit -r {priority}`, `LimitRTPRIO={priority}` in its systemd unit or the "
    "capability CAP_SYS_NICE, or set 0. It goes on without."
)


def take_priority(priority: int) -> str:
    """Gives all threads of this process priority over every ordinary one (SCHED_FIFO).

    This includes the threads of the middleware: a gate that waits for them gains nothing by its own
    priority alone. Threads created later have the priority of their creator.

    Args:
        priority: 1 to 99; 0 leaves everything as it is.

    Returns:
        A sentence with the reason and the fix if it fails; empty otherwise.
    """
    if priority == 0:
        return ""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        for thread in os.listdir("/proc/self/task"):
            with contextlib.suppress(ProcessLookupError):  # it has ended meanwhile
                os.sched_setscheduler(int(thread), os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, AttributeError) as error:  # the latter on systems without it
        reason = str(getattr(error, "strerror", None) or "it has none").lower()
        return REFUSED.format(priority=priority, error=reason)
    return ""
