"""record_node: drives a robot through its full range of motion, and records it."""

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from numpy.typing import ArrayLike
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from sensor_msgs.msg import Imu, JointState

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import BackendError, BridgeError
from nics_drl_bridge.exit_codes import EXIT_BAD_INPUT
from nics_drl_bridge.interface import NS_PER_S, Array
from nics_drl_bridge.middleware.measurement import CMD_VEL
from nics_drl_bridge.nodes import conversions, qos, runner
from nics_drl_bridge.nodes.command_types import expect_stamped
from nics_drl_bridge.nodes.parameters import IMU, STAMPED, list_drive_rows
from nics_drl_bridge.recording.drive_log import DriveLog
from nics_drl_bridge.recording.excite import PERIOD_S, STILL_S, DrivePlan
from nics_drl_bridge.recording.imu_axis import GyroReader
from nics_drl_bridge.recording.messages import (
    get_stamp,
    read_imu,
    read_pose,
)
from nics_drl_bridge.recording.recording import Recording
from nics_drl_bridge.recording.topic_roles import (
    TopicRoles,
    list_imu_topics,
    load_topic_roles,
)
from nics_drl_bridge.recording.write import check_out, write_drive
from nics_drl_bridge.robot.spec import load_robot

PATIENCE_S = 10.0
POLL_S = 0.01
# zero is repeated for this long [s]: a best-effort subscriber may miss one
HALT_S = 0.5
PERIOD_NS = round(PERIOD_S * NS_PER_S)


def declare_drive(node: Node) -> tuple[DrivePlan, Path, TopicRoles]:
    """Declare the parameters of a drive; return plan, file and roles. Raises ConfigError."""
    values = {row.name: runner.declare_row(node, row) for row in list_drive_rows()}
    robot = load_robot(values["robot"])
    robot.require_cmd_vel()
    pattern = [values[name] for name in ("bound", "duration", "speed", "seed")]
    out = check_out(Path(values["out"]))
    return DrivePlan(robot, *pattern), out, load_topic_roles(values["topics"] or None)


@dataclass(frozen=True)
class DriveResult:
    """Result of a drive."""

    complete: bool
    failure: BridgeError | None  # why the drive failed; None also if it was interrupted
    recording: Recording | None  # the saved recording
    line: str  # one sentence about it


class RecordNode(qos.BridgeNode):
    """Sends `cmd_vel` at 20 Hz, and zeros at the end or on a fault; records what it hears."""

    def __init__(self, **options: Any) -> None:
        super().__init__("record_node", **options)
        self.outcome: DriveResult | None = None
        self._plan, self._out, roles = declare_drive(self)
        self._drive = self._plan.begin()
        self._sim_time = runner.get_flag(self, "use_sim_time")
        self._steady_origin_ns = time.time_ns() - time.monotonic_ns()
        self._log = DriveLog(self._plan.robot, roles, self._now_ns)
        self._topic: Publisher | None = None
        if STAMPED in qos.get_given_values(self):
            self._speak(runner.get_flag(self, STAMPED))
        self.create_subscription(Odometry, "odom", self._on_odometry, qos.SENSOR)
        self.create_subscription(
            JointState, "joint_states", self._log.take_joints, qos.SENSOR
        )
        take_pose = partial(self._take, "pose", read_pose)
        self.create_subscription(PoseStamped, "pose", take_pose, qos.SENSOR)
        self._imu_topic = ""  # the first topic that is heard
        self._gyro = GyroReader()
        for topic in list_imu_topics(runner.get_text(self, IMU), by_default=True):
            self.create_subscription(
                Imu, topic, partial(self._take_imu, topic), qos.SENSOR
            )
        self._began = time.monotonic()
        self._heard = -np.inf
        self._ticks = 0
        self._origin_ns = 0
        self._stamp_ns = 0
        self._pose: Array | None = None
        self._frame = ""  # of the robot, by its odometry
        self._start: Array = np.zeros(3)
        # On the steady clock: the guard must not depend on the node's time source.
        runner.call_periodically(self, POLL_S, self._on_time)

    def _speak(self, stamped: bool) -> None:
        self._stamped = stamped
        command = TwistStamped if stamped else Twist
        self._topic = self.create_publisher(command, CMD_VEL, qos.COMMAND)

    def _now_ns(self) -> int:
        if self._sim_time:
            # Odometry may arrive before its tick of /clock.
            return max(int(self.get_clock().now().nanoseconds), self._stamp_ns)
        return self._steady_origin_ns + time.monotonic_ns()

    def _take(self, topic: str, row: Callable[[Any], ArrayLike], message: Any) -> None:
        self._log.add(topic, get_stamp(message), row(message))

    def _take_imu(self, topic: str, message: Imu) -> None:
        self._imu_topic = self._imu_topic or topic
        measured = self._gyro.read(message) if topic == self._imu_topic else None
        if measured is not None:
            ax, ay, _ = read_imu(message)
            self._log.add("imu", get_stamp(message), (ax, ay, measured[0]))

    def _on_odometry(self, message: Odometry) -> None:
        self._stamp_ns = max(
            self._stamp_ns, conversions.stamp_from_ros(message.header.stamp)
        )
        pose = self._log.take_odometry(message)
        if pose is None:
            return
        self._pose = pose
        self._heard = time.monotonic()
        self._frame = message.child_frame_id
        if self._ticks:
            self._drive.observe(geometry.between(self._start, pose))
            self._on_time()  # now: with fast simulated time a poll may be a tick late

    def _on_time(self) -> None:
        if self.outcome is not None:
            return
        try:
            if self._ticks or self._ready():
                self._go_on()
        except BridgeError as error:
            self._end(error)
        else:
            if self._drive.done:
                self._end(None, complete=True)

    def _ready(self) -> bool:
        topic = self.resolve_topic_name(CMD_VEL)
        if self._topic is None and self.count_subscribers(topic):
            heard = expect_stamped(self, CMD_VEL)
            self._speak(runner.get_flag(self, STAMPED) if heard is None else heard)
        listened = self._topic is not None and self._topic.get_subscription_count() > 0
        if listened and self._pose is not None and self._now_ns() > 0:
            others = self.count_publishers(topic) - 1
            if others > 0:
                reason = f"{others} other publisher(s) would drive the robot too; end them, or"
                raise BackendError(f"topic {topic!r}: {reason} remap the topic.")
            if not self._sim_time and self.count_publishers("/clock"):
                fix = "--use-sim-time takes the time of a simulator"
                self.get_logger().warning(f"/clock is published, but not used; {fix}")
            self._start = self._pose
            self._origin_ns = self._now_ns()
            return True
        if time.monotonic() - self._began > PATIENCE_S:
            name = CMD_VEL
            reason = f"nobody listened within {PATIENCE_S:g} s"
            if self._pose is None:
                name = "odom"
                reason = f"nothing arrived within {PATIENCE_S:g} s"
            fix = "start the robot, or correct namespace, ROS_DOMAIN_ID or remapping."
            raise BackendError(f"topic {self._place(name)}: {reason}; {fix}")
        return False

    def _place(self, topic: str) -> str:
        return (
            f"{self.resolve_topic_name(topic)!r} (namespace {self.get_namespace()!r}, ROS domain "
            f"{self.context.get_domain_id()})"
        )

    def _go_on(self) -> None:
        self._guard()
        due = (self._now_ns() - self._origin_ns) // PERIOD_NS + 1 - self._ticks
        if due <= 0:
            return
        if self._ticks < STILL_S / PERIOD_S <= self._ticks + due:
            self._log.check()
        for _ in range(due):  # more than one if time advances in larger steps
            command = self._drive.choose_command()
            self._ticks += 1
        self._send(command)

    def _guard(self) -> None:
        age = time.monotonic() - self._heard
        limit = runner.get_number(self, "odom_timeout")
        if age > limit:
            place = self._place("odom")
            raise BackendError(
                f"topic {place}: nothing new for {age:.2f} s (the limit is {limit:g} s); find "
                "out why odometry stopped."
            )
        bound = self._plan.bound
        radius = self._plan.robot.footprint_radius
        x, y, _ = geometry.between(
            self._start, self._start if self._pose is None else self._pose
        )
        if np.hypot(x, y) + radius > bound:
            raise BackendError(
                f"the robot left its circle of {bound:g} m, at x {x:.2f}, y {y:.2f} m from the "
                f"start with a radius of {radius:g} m; give a larger bound, less speed, or the "
                "robot's true parameters."
            )

    def _send(self, command: Array) -> None:
        robot = self._plan.robot
        if self._topic is not None:
            self._topic.publish(self._message(robot.to_cmd_vel(command)))
        self._log.add(CMD_VEL, 0, robot.pass_through_cmd_vel(command))

    def _message(self, twist: Array) -> Twist | TwistStamped:
        stamped = conversions.stamped_to_ros(twist, self._now_ns(), self._frame)
        return stamped if self._stamped else stamped.twist

    def stop(self) -> None:
        """Leave the robot at rest, and save the recording."""
        if self.outcome is None:
            self._end(None)

    def _end(self, failure: BridgeError | None, complete: bool = False) -> None:
        self.outcome = DriveResult(complete, failure, None, "")
        recording = None
        result = "the robot was not moved; nothing is recorded"
        if self._ticks:
            self._halt()
            try:
                made = self._log.make_recording()
                write_drive(made, self._out, self._plan.robot)
            except (BridgeError, OSError) as error:
                result = f"nothing was saved ({error})"
            else:
                recording = made
                result = f"{self._log.seconds:.1f} s are recorded in {self._out}"
        if not complete:
            stopped = "the robot was told to stop; " if self._ticks else ""
            result = f"{failure or 'interrupted:'} {stopped}{result}"
        self.outcome = DriveResult(complete, failure, recording, result)
        self.context.try_shutdown()

    def _halt(self) -> None:
        until = time.monotonic() + HALT_S
        zero = np.zeros(len(self._plan.robot.command))
        while time.monotonic() < until:
            self._send(zero)
            time.sleep(PERIOD_S)
        if self._topic is not None:
            runner.publish_last(self._topic, self._message(np.zeros(3)))


def record(
    values: dict[str, Any] | None = None, args: Sequence[str] | None = None
) -> DriveResult:
    """Drive and record until the end, an error or a signal; parameters may also come in `args`."""
    overrides = [Parameter(name, value=value) for name, value in (values or {}).items()]
    make = partial(RecordNode, parameter_overrides=overrides)
    node: RecordNode = runner.run_node(make, args, "record_node")
    return node.outcome or DriveResult(
        False, None, None, "interrupted: nothing was saved"
    )


def main(args: list[str] | None = None) -> None:
    """Entry point of the executable."""
    outcome = record(args=args)
    sys.stderr.write(f"record_node: {outcome.line}\n")
    if outcome.failure is not None:
        raise SystemExit(EXIT_BAD_INPUT)
