"""simulator_node: the fast simulator behind the topics of the hardware."""

from __future__ import annotations

import json
import time
from typing import Any

import numpy as np
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock as SteadyClock
from rclpy.clock import ClockType
from rclpy.context import Context
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, LaserScan
from std_srvs.srv import SetBool, Trigger

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import BridgeError, ConfigError, nearest
from nics_drl_bridge.lidar.scanner import RENDERERS
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.qos_watch import QosWatch
from nics_drl_bridge.nodes.runner import declare, declare_model, run_node
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import load_world

Array = NDArray[np.float64]
MODES = ("realtime", "lockstep", "as_fast_as_possible")
COVARIANCE_GROWTH_S = 1.0
"""An odometry pose is given the variance of this many seconds of drift at least."""


class SimulatorNode(QosWatch):
    """Takes `cmd_vel`, publishes `scan`, `odom`, `joint_states`, `ground_truth` and `/clock`.

    Stamps are simulated time, as on `/clock`: it begins at the system's time and never runs
    backwards, also not at a reset. `~/reset` begins the episode of the parameters
    `episode_seed` and `episode_start`; its answer is JSON with the stamp of the first data.

    Args:
        context: to live in.
    """

    def __init__(self, context: Context) -> None:
        super().__init__("simulator_node", context=context)
        model = declare_model(self)
        self._declare(model.lidar.frame)
        world = load_world(self._text("world"))
        renderer = self._choice("renderer", RENDERERS)
        self._mode = self._choice("mode", MODES)
        self._model = model
        self._simulator = FastSimulator(model, world, renderer=renderer)  # type: ignore[arg-type]
        self._identity = {"model": model.fingerprint, "world": world.fingerprint}
        self._period_ns = round(model.control_period * conversions.NANO)
        self._now_ns = time.time_ns() // self._period_ns * self._period_ns
        self._command, self._command_ns = np.zeros(len(model.robot.command)), 0
        self._paused = False
        self._simulator.step(self._command[None, None])  # compiled before anybody waits for it
        self._open_topics()
        self._begin()

    def _declare(self, laser_frame: str) -> None:
        # First, so that it also judges the values that the node is started with.
        self.add_on_set_parameters_callback(self._check_parameters)
        world, renderer = "World file, or the name of a shipped world.", "Lidar: baked or exact."
        declare(self, "world", "arena", world, read_only=True)
        declare(self, "renderer", "baked", renderer, read_only=True)
        declare(self, "mode", "realtime", f"How time runs: {', '.join(MODES)}.", read_only=True)
        rate = "Simulated seconds per second in realtime."
        declare(self, "rate", 1.0, rate, low=0.01, high=1000.0, read_only=True)
        silence = "Stops after this silence on cmd_vel [simulated s]; not in lockstep."
        declare(self, "command_timeout", 0.5, silence, low=0.0, high=3600.0)
        for frame, default in (
            ("map", "map"),
            ("odom", "odom"),
            ("base", "base_link"),
            ("laser", laser_frame),
        ):
            declare(self, f"{frame}_frame", default, f"Frame id of {default}.")
        declare(self, "episode_seed", 0, "Seed of the episode that ~/reset begins.")
        declare(self, "episode_start", [0.0, 0.0, 0.0], "Start x, y, heading of that episode.")
        declare(
            self, "episode_start_given", False, "Whether episode_start holds, or the seed's own."
        )

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            if parameter.name == "episode_start":
                values = np.array(parameter.value, dtype=np.float64)
                if values.shape != (3,) or not np.isfinite(values).all():
                    return SetParametersResult(
                        successful=False,
                        reason="episode_start must be three finite numbers: x, y, heading.",
                    )
            if parameter.name == "episode_seed" and parameter.value < 0:
                return SetParametersResult(
                    successful=False, reason="episode_seed must be 0 or more."
                )
        return SetParametersResult(successful=True)

    def _text(self, name: str) -> str:
        return str(self.get_parameter(name).value)

    def _choice(self, name: str, valid: tuple[str, ...]) -> str:
        value = self._text(name)
        if value not in valid:
            raise ConfigError(
                f"parameter {name!r}: unknown value {value!r}; {nearest(value, valid)}"
            )
        return value

    def _open_topics(self) -> None:
        self._scan_topic = self.create_publisher(LaserScan, "scan", qos.SENSOR_RELIABLE)
        self._odom_topic = self.create_publisher(Odometry, "odom", qos.SENSOR_RELIABLE)
        self._truth_topic = self.create_publisher(Odometry, "ground_truth", qos.SENSOR_RELIABLE)
        self._joint_topic = self.create_publisher(JointState, "joint_states", qos.SENSOR_RELIABLE)
        self._clock_topic = self.create_publisher(Clock, "/clock", qos.SENSOR_RELIABLE)
        commands = qos.EVERY_COMMAND if self._mode == "lockstep" else qos.COMMAND
        self.create_subscription(Twist, "cmd_vel", self._on_command, commands)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(SetBool, "~/pause", self._on_pause)
        if self._mode == "realtime":
            period = self._model.control_period / float(self.get_parameter("rate").value)
        elif self._mode == "as_fast_as_possible":
            period = 0.0
        else:
            return
        # Steady: not the node's clock, which with use_sim_time would wait for this very node.
        self.create_timer(
            period, self._on_time, clock=SteadyClock(clock_type=ClockType.STEADY_TIME)
        )

    def _on_command(self, message: Twist) -> None:
        twist = conversions.twist_from_ros(message)
        if not np.isfinite(twist).all():
            self.get_logger().warning("cmd_vel: NaN or inf ignored", throttle_duration_sec=1.0)
            return
        self._command, self._command_ns = self._model.robot.from_cmd_vel(twist), self._now_ns
        if self._mode == "lockstep" and not self._paused:
            self._advance()

    def _on_time(self) -> None:
        if self._paused:
            return
        timeout = float(self.get_parameter("command_timeout").value)
        if self._now_ns - self._command_ns > timeout * conversions.NANO:
            self._command = np.zeros_like(self._command)
        self._advance()

    def _advance(self) -> None:
        before = self._simulator.data.pose[0, 0].copy()
        self._simulator.step(self._command[None, None])
        self._now_ns += self._period_ns
        moved = geometry.log(geometry.between(before, self._simulator.data.pose[0, 0]))
        self._publish(moved / self._model.control_period)

    def _begin(self) -> None:
        given = bool(self.get_parameter("episode_start_given").value)
        start = np.array(self.get_parameter("episode_start").value, dtype=np.float64)
        seed = int(self.get_parameter("episode_seed").value)
        self._simulator.reset([seed], starts=start[None, None] if given else None)
        self._command = np.zeros_like(self._command)
        self._now_ns += self._period_ns
        self._publish(np.zeros(3))

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            self._begin()
        except BridgeError as error:
            response.success, response.message = False, str(error)
            return response
        response.success = True
        answer: dict[str, Any] = {"stamp_ns": self._now_ns, **self._identity}
        response.message = json.dumps(answer)
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._paused = bool(request.data)
        response.success, response.message = True, "paused" if self._paused else "running"
        return response

    def _publish(self, true_twist: Array) -> None:
        """Publishes the present data; `true_twist` (3,) is the mean of the period before."""
        data, now = self._simulator.data, self._now_ns
        map_frame, odom_frame, base, laser = (
            self._text(f"{name}_frame") for name in ("map", "odom", "base", "laser")
        )
        linear, angular = (std * std for std in self._model.noise.odometry)
        drift = max(float(data.steps[0]) * self._model.control_period, COVARIANCE_GROWTH_S)
        variance = (linear * drift, angular * drift, linear, angular)
        pose, twist = data.odom[0, 0], data.twist[0, 0]
        self._clock_topic.publish(Clock(clock=conversions.stamp_to_ros(now)))
        self._odom_topic.publish(
            conversions.odometry_to_ros(pose, twist, now, (odom_frame, base), variance)
        )
        self._joint_topic.publish(
            conversions.joints_to_ros(self._model.robot, data.state[0, 0], now)
        )
        self._scan_topic.publish(
            conversions.scan_to_ros(self._model.lidar, data.ranges[0, 0], now, laser)
        )
        truth = conversions.odometry_to_ros(
            data.pose[0, 0], true_twist, now, (map_frame, base), (0.0,) * 4
        )
        self._truth_topic.publish(truth)


def main(args: list[str] | None = None) -> None:
    """Entry point of the executable."""
    run_node(SimulatorNode, args)


if __name__ == "__main__":
    main()
