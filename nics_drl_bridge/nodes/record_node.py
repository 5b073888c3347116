"""record_node: drives a robot so that it shows its whole motion, and records it."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import BackendError, BridgeError, ConfigError, StaleDataError
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.kinematics.exploration import STILL_S, Exploration, plan
from nics_drl_bridge.kinematics.pattern import Space
from nics_drl_bridge.kinematics.prediction import PERIOD_S, Motion, model_motion, textbook_motion
from nics_drl_bridge.kinematics.spec import RobotSpec, load_robot
from nics_drl_bridge.kinematics.topic_roles import topic_roles
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.drive_log import DriveLog
from nics_drl_bridge.nodes.runner import EXIT_BAD_INPUT, declare, last_word, run_node

Array = NDArray[np.float64]
PATIENCE_S = 10.0
SUFFIX = ".npz"
SHORTEST_S = 5.0
"""An interrupted drive that lasted less [s] is not worth saving."""


def motion_of(robot: str, model: str) -> tuple[RobotSpec, Motion]:
    """The robot, and what predicts its motion: a model if one is named, else the textbook."""
    if not model:
        spec = load_robot(robot)
        return spec, textbook_motion(spec)
    known = open_model(model)
    return known.robot, model_motion(known.kinematics)


class RecordNode(Node):
    """Sends `cmd_vel` at 20 Hz, listens to `odom`, `pose` and `joint_states`, writes a recording.

    The space lies around the place where the robot stands at the start; the drive is planned
    anew from the odometry at each turn. It ends with zero commands, and also does so at a
    signal, at an error, when the odometry is silent, and when the robot leaves the space; what
    was recorded until then is saved.

    Args:
        context: to live in.
        given: parameters, before those of the command line.
    """

    def __init__(self, context: Context, given: Mapping[str, Any] | None = None) -> None:
        overrides = [Parameter(name, value=value) for name, value in (given or {}).items()]
        super().__init__("record_node", context=context, parameter_overrides=overrides)
        spec = self._prepare()
        self.failure: BridgeError | None = None
        self._saved = False
        self._topic = self.create_publisher(Twist, "cmd_vel", qos.COMMAND)
        self.create_subscription(Odometry, "odom", self._on_odometry, qos.SENSOR)
        self.create_subscription(PoseStamped, "pose", self._on_pose, qos.SENSOR)
        self.create_subscription(JointState, "joint_states", self._on_joints, qos.SENSOR)
        self._began, self._ticks = time.monotonic(), 0
        self._start: Array | None = None
        self._pose, self._heard = np.zeros(3), 0.0
        self._spec = spec
        # Steady: a drive's period must not depend on whose time the node follows.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(PERIOD_S, self._on_time, clock=steady)

    def _prepare(self) -> RobotSpec:
        """Declares the parameters and plans the drive."""
        robot = declare(self, "robot", "ackermann", "A shipped robot or a YAML file.")
        about = "Folder of a SimulatorModel that predicts the drive; the textbook does if empty."
        spec, motion = motion_of(str(robot), str(declare(self, "model", "", about)))
        out = str(declare(self, "out", "drive.npz", "File of the recording."))
        self._out = check_out(Path(out))
        sides = declare(self, "space", [4.0, 4.0], "Length and width of the space [m].")
        if len(sides) != 2 or not all(0.0 < side < np.inf for side in sides):
            raise ConfigError(f"parameter 'space': must be [length, width] in m, not {sides}")
        duration = float(declare(self, "duration", 60.0, "Of the drive [s]."))
        seed = int(declare(self, "seed", 0, "Of the drive."))
        self._timeout = float(
            declare(self, "odom_timeout", 0.5, "Stops after this silence of odom [s].")
        )
        topics = str(declare(self, "topics", "", "YAML file that names joints; optional."))
        self._space = Space(*map(float, sides))
        expected = plan(spec, motion, self._space, duration, seed)
        self._drive = Exploration(
            spec, motion, self._space, duration, np.random.default_rng(seed), expected.slower
        )
        self._log = DriveLog(spec, topic_roles(Path(topics) if topics else None))
        return spec

    def _on_odometry(self, message: Odometry) -> None:
        pose = self._log.odometry(message)
        if pose is None:
            return
        self._heard = time.monotonic()
        if self._start is None:
            self._start = pose
        self._pose = geometry.between(self._start, pose)
        self._drive.see(self._pose)

    def _on_pose(self, message: PoseStamped) -> None:
        self._log.pose(message)

    def _on_joints(self, message: JointState) -> None:
        self._log.joints(message)

    def _on_time(self) -> None:
        try:
            if self._ticks or self._ready():
                self._drive_on()
        except BridgeError as error:
            self.failure = error
        if self.failure is not None or self._drive.done:
            self.stop()
            self.context.try_shutdown()

    def _drive_on(self) -> None:
        self._guard()
        if self._ticks == round(STILL_S / PERIOD_S):
            self._log.check_state()
        self._send(self._drive.next())
        self._ticks += 1

    def _ready(self) -> bool:
        """Whether the robot listens and tells where it is; it is waited for 10 s."""
        listeners = self._topic.get_subscription_count()
        if self._start is not None and listeners > 0:
            others = self.count_publishers(self._topic.topic_name) - 1
            if others > 0:
                raise BackendError(
                    f"topic 'cmd_vel': {others} other publisher(s) would drive the robot too; end "
                    "them, or remap the topic."
                )
            return True
        if time.monotonic() - self._began > PATIENCE_S:
            if self._start is None:
                raise StaleDataError("odom", float("inf"), PATIENCE_S)
            raise BackendError(
                f"topic 'cmd_vel': no robot listens to it within {PATIENCE_S:g} s; start the "
                "robot, or remap the topic."
            )
        return False

    def _guard(self) -> None:
        """Raises BackendError when the robot must not go on."""
        age = time.monotonic() - self._heard
        if age > self._timeout:
            raise StaleDataError("odom", age, self._timeout)
        if self._space.excess(self._pose, self._spec.footprint_radius) > 0.0:
            x, y, _ = self._pose
            raise BackendError(
                f"the robot left its space of {self._space.length:g} x {self._space.width:g} m, "
                f"at x {x:.2f}, y {y:.2f} m from the start; give it more space, or a model of "
                "this robot with --model."
            )

    def _send(self, command: Array) -> None:
        self._topic.publish(conversions.twist_to_ros(self._spec.to_cmd_vel(command)))
        self._log.command(command)

    @property
    def complete(self) -> bool:
        """Whether the drive went to its end and is saved."""
        return self._drive.done and self._saved

    def stop(self) -> None:
        """Leaves the robot standing still, then saves what was recorded."""
        last_word(self._topic, conversions.twist_to_ros(np.zeros(3)))
        if self._saved or self._log.seconds < SHORTEST_S:
            return
        self._saved = True
        try:
            self._log.save(self._out)
        except BridgeError as error:
            self._saved, self.failure = False, self.failure or error
            return
        self.get_logger().info(f"{self._log.seconds:.1f} s recorded in {self._out}")


def check_out(path: Path) -> Path:
    """The file of a recording to write.

    Raises:
        ConfigError: it has another suffix, or is there already.
    """
    if path.suffix != SUFFIX:
        raise ConfigError(f"{path}: the recording must be named *{SUFFIX}.")
    if path.exists():
        raise ConfigError(f"{path}: is there already; give another name, or remove it.")
    return path


def record(given: Mapping[str, Any] | None = None, args: Sequence[str] | None = None) -> bool:
    """Drives and records.

    Args:
        given: parameters, before those of the command line.
        args: the command line, `sys.argv` by default.

    Returns:
        Whether the drive went to its end; otherwise it was interrupted.

    Raises:
        BridgeError: why it ended before.
    """
    nodes: list[RecordNode] = []

    def make(context: Context) -> RecordNode:
        nodes.append(RecordNode(context, given))
        return nodes[-1]

    run_node(make, args)
    if nodes[-1].failure is not None:
        raise nodes[-1].failure
    return nodes[-1].complete


def main(args: list[str] | None = None) -> None:
    """Entry point of the executable."""
    try:
        record(args=args)
    except BridgeError as error:
        sys.stderr.write(f"{error}\n")
        raise SystemExit(EXIT_BAD_INPUT) from None


if __name__ == "__main__":
    main()
