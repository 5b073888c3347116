"""record_node: drives a robot so that it shows its whole motion, and records it.

Parameters of `record_node`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import Imu, JointState

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import BackendError, BridgeError
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.drive_log import DriveLog
from nics_drl_bridge.nodes.qos import QosWatch
from nics_drl_bridge.nodes.runner import EXIT_BAD_INPUT, declare, last_word, run_node
from nics_drl_bridge.recording.excite import PERIOD_S, STILL_S, DrivePlan
from nics_drl_bridge.recording.recording import Recording
from nics_drl_bridge.recording.topic_roles import TopicRoles, topic_roles
from nics_drl_bridge.recording.write import check_out, write_drive
from nics_drl_bridge.robot.spec import load_robot

Array = NDArray[np.float64]
PATIENCE_S = 10.0
POLL_S = 0.01
HALT_S = 0.5
"""Zero is repeated for this long [s]: a best-effort subscriber may miss one."""
PERIOD_NS = round(PERIOD_S * NS_PER_S)


@dataclass(frozen=True)
class DriveResult:
    """Result of a drive.

    Attributes:
        complete: whether it was completed.
        failure: the reason if it was not; None if it was, or if it was interrupted.
        recording: what was saved; None if nothing was.
        line: one sentence about it.
    """

    complete: bool
    failure: BridgeError | None
    recording: Recording | None
    line: str


class RecordNode(QosWatch):
    """Sends `cmd_vel` at 20 Hz; writes `odom`, `joint_states`, `imu` and `pose` to a recording.

    The centre of the circle is the robot's place at the start; each segment of the drive is chosen
    from the robot's position by odometry. The drive ends with zero commands, also on a signal, on
    an error, when odometry is silent, and when the robot leaves the circle; what was recorded
    until then is saved. If this process is killed, only the robot's own timeout on `cmd_vel` stops
    it.

    Args:
        context: of the node.
        given: parameters that override those of the command line.
    """

    def __init__(self, context: Context, given: Mapping[str, Any] | None = None) -> None:
        overrides = [Parameter(name, value=value) for name, value in (given or {}).items()]
        super().__init__("record_node", context=context, parameter_overrides=overrides)
        self.outcome: DriveResult | None = None
        self._order = declare_drive(self)
        self._drive = self._order.plan.begin()
        self._sim_time = bool(self.get_parameter("use_sim_time").value)
        self._steady_origin_ns = time.time_ns() - time.monotonic_ns()
        self._log = DriveLog(self._order.plan.robot, self._order.roles, self._now_ns)
        kind = TwistStamped if self._order.stamped else Twist
        self._topic = self.create_publisher(kind, "cmd_vel", qos.COMMAND)
        self.create_subscription(Odometry, "odom", self._on_odometry, qos.SENSOR)
        self.create_subscription(PoseStamped, "pose", self._log.pose, qos.SENSOR)
        self.create_subscription(JointState, "joint_states", self._log.joints, qos.SENSOR)
        self.create_subscription(Imu, "imu", self._log.imu, qos.SENSOR)
        self._began, self._heard = time.monotonic(), -np.inf
        self._ticks, self._origin_ns = 0, 0
        self._stamp_ns = 0
        self._pose: Array | None = None
        self._start: Array = np.zeros(3)
        # Steady: the robot's guard must not depend on the time source of the node.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(POLL_S, self._on_time, clock=steady)

    def _now_ns(self) -> int:
        """Returns simulated time, or the system time at the start plus steady time [ns]."""
        if self._sim_time:
            # Odometry may arrive before its tick of /clock.
            return max(int(self.get_clock().now().nanoseconds), self._stamp_ns)
        return self._steady_origin_ns + time.monotonic_ns()

    def _on_odometry(self, message: Odometry) -> None:
        self._stamp_ns = max(self._stamp_ns, conversions.stamp_from_ros(message.header.stamp))
        pose = self._log.odometry(message)
        if pose is None:
            return
        self._pose, self._heard = pose, time.monotonic()
        if self._ticks:
            self._drive.see(geometry.between(self._start, pose))
            self._on_time()  # at once: with a fast simulated time a poll may be a tick late

    def _on_time(self) -> None:
        if self.outcome is not None:
            return
        try:
            if self._ticks or self._ready():
                self._go_on()
        except BridgeError as error:
            self._end(error)
            return
        if self._drive.done:
            self._end(None, complete=True)

    def _ready(self) -> bool:
        """True if the robot listens and reports its pose; raises BackendError after 10 s."""
        listeners = self._topic.get_subscription_count()
        if self._pose is not None and listeners > 0 and self._now_ns() > 0:
            others = self.count_publishers(self._topic.topic_name) - 1
            if others > 0:
                raise BackendError(
                    f"topic {self._topic.topic_name!r}: {others} other publisher(s) would drive "
                    "the robot too; end them, or remap the topic."
                )
            self._start, self._origin_ns = self._pose, self._now_ns()
            return True
        if time.monotonic() - self._began > PATIENCE_S:
            name, missing = (
                ("odom", "nothing arrived")
                if self._pose is None
                else ("cmd_vel", "nobody listened")
            )
            raise BackendError(
                f"topic {self._place(name)}: {missing} within {PATIENCE_S:g} s; start the robot, "
                "or correct namespace, ROS_DOMAIN_ID or remapping."
            )
        return False

    def _place(self, topic: str) -> str:
        """Returns a topic's full name, with namespace and domain, for messages."""
        return (
            f"{self.resolve_topic_name(topic)!r} (namespace {self.get_namespace()!r}, ROS domain "
            f"{self.context.get_domain_id()})"
        )

    def _go_on(self) -> None:
        """Sends the command if one is due."""
        self._guard()
        due = (self._now_ns() - self._origin_ns) // PERIOD_NS + 1 - self._ticks
        if due <= 0:
            return
        if self._ticks < STILL_S / PERIOD_S <= self._ticks + due:
            self._log.check()
        for _ in range(due):  # several if time advances in larger steps
            command = self._drive.next()
            self._ticks += 1
        self._send(command)

    def _guard(self) -> None:
        """Raises BackendError if the robot must not continue."""
        age = time.monotonic() - self._heard
        if age > self._order.odom_timeout:
            raise BackendError(
                f"topic {self._place('odom')}: nothing new for {age:.2f} s, which may be "
                f"{self._order.odom_timeout:g} s; find out why odometry stopped."
            )
        bound, radius = self._order.plan.bound, self._order.plan.robot.footprint_radius
        x, y, _ = geometry.between(self._start, self._start if self._pose is None else self._pose)
        if np.hypot(x, y) + radius > bound:
            raise BackendError(
                f"the robot left its circle of {bound:g} m, at x {x:.2f}, y {y:.2f} m "
                f"from the start with a radius of {radius:g} m; give it a larger bound, less "
                "speed, or the parameters that it really has."
            )

    def _send(self, command: Array) -> None:
        self._topic.publish(self._message(self._order.plan.robot.to_cmd_vel(command)))
        self._log.command(command)

    def _message(self, twist: Array) -> Twist | TwistStamped:
        message = conversions.twist_to_ros(twist)
        if not self._order.stamped:
            return message
        stamped = TwistStamped(twist=message)
        stamped.header.stamp = conversions.stamp_to_ros(self._now_ns())
        return stamped

    def stop(self) -> None:
        """Leaves the robot at rest, and saves what was recorded."""
        if self.outcome is None:
            self._end(None)

    def _end(self, failure: BridgeError | None, complete: bool = False) -> None:
        """Stops the robot, saves, and ends the node, however the drive ended."""
        self.outcome = DriveResult(complete, failure, None, "")
        recording, told = None, "the robot was not moved, nothing is recorded"
        if self._ticks:
            self._halt()
            recording, told = self._save()
        if not complete:
            stopped = "the robot was told to stop; " if self._ticks else ""
            told = f"{failure or 'interrupted:'} {stopped}{told}"
        self.outcome = DriveResult(complete, failure, recording, told)
        self.context.try_shutdown()

    def _halt(self) -> None:
        until = time.monotonic() + HALT_S
        zero = np.zeros(len(self._order.plan.robot.command))
        while time.monotonic() < until:
            self._send(zero)
            time.sleep(PERIOD_S)
        last_word(self._topic, self._message(np.zeros(3)))

    def _save(self) -> tuple[Recording | None, str]:
        """Saves the recording; returns it with a clause about it."""
        try:
            recording = self._log.recording()
            write_drive(recording, self._order.out, self._order.plan.robot)
        except (BridgeError, OSError) as error:
            return None, f"nothing was saved ({error})"
        return recording, f"{self._log.seconds:.1f} s are recorded in {self._order.out}"


def record(
    given: Mapping[str, Any] | None = None, args: Sequence[str] | None = None
) -> DriveResult:
    """Drives and records until the end, an error, SIGINT or SIGTERM.

    Args:
        given: parameters that override those of the command line.
        args: the command line, `sys.argv` by default.

    Returns:
        The result of the drive.
    """
    nodes: list[RecordNode] = []

    def make(context: Context) -> RecordNode:
        nodes.append(RecordNode(context, given))
        return nodes[-1]

    run_node(make, args, "record_node")
    return nodes[-1].outcome or DriveResult(False, None, None, "interrupted: nothing was saved")


def main(args: list[str] | None = None) -> None:
    """Entry point of the executable."""
    outcome = record(args=args)
    sys.stderr.write(f"record_node: {outcome.line}\n")
    if outcome.failure is not None:
        raise SystemExit(EXIT_BAD_INPUT)


if __name__ == "__main__":
    main()


@dataclass(frozen=True)
class DriveParameters:
    """Values of the parameters of `record_node`.

    Attributes:
        plan: plan of the drive.
        out: path of the recording.
        odom_timeout: silence of odometry that stops the robot [s].
        stamped: whether `cmd_vel` is a TwistStamped.
        roles: may name the joints of state and wheels.
    """

    plan: DrivePlan
    out: Path
    odom_timeout: float
    stamped: bool
    roles: TopicRoles


def declare_drive(node: Node) -> DriveParameters:
    """Declares the parameters of a drive, and reads them.

    Raises:
        ConfigError: a value can't be used.
    """
    get = partial(declare, node, read_only=True)
    robot = load_robot(get("robot", "ackermann", "A shipped robot, or its YAML file."))
    out = check_out(
        Path(get("out", "drive.npz", "File *.npz of the recording, or folder of a rosbag2."))
    )
    plan = DrivePlan(
        robot,
        bound=get("bound", 2.0, "Radius of the circle around the start to keep within [m]."),
        duration=get("duration", 60.0, "Of the drive [s]."),
        speed=get("speed", 1.0, "Share of the greatest speeds to use."),
        seed=get("seed", 0, "Of the pattern."),
    )
    topics = get("topics", "", "YAML file that names joints; none if empty.")
    silence = "Stops after this silence of odom [s]."
    return DriveParameters(
        plan,
        out,
        odom_timeout=get("odom_timeout", 0.5, silence, low=0.05, high=10.0),
        stamped=get("stamped", False, "Whether cmd_vel is a TwistStamped."),
        roles=topic_roles(Path(topics) if topics else None),
    )
