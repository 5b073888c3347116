"""policy_node: runs a policy on a robot's topics."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PoseStamped, TwistStamped
from numpy.typing import NDArray
from rclpy.context import Context

from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.interface import RobotView
from nics_drl_bridge.middleware.view import rehearse
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.lifecycle import ACTIVE, ManagedNode
from nics_drl_bridge.nodes.robot_topics import RobotTopics, declare_sensors
from nics_drl_bridge.nodes.runner import declare, declare_model_name, last_word, run_node
from nics_drl_bridge.policy.policies import make_policy

ODOM = "odom"


class PolicyNode(ManagedNode):
    """Answers each scan with `cmd_vel_raw`, stamped with that scan, until the goal is reached.

    It observes through the same task as the Gymnasium env. The goal, in `map`, is a parameter
    at the start and the topic `goal_pose` afterwards. It listens when it is configured and commands
    when it is active; the last that it says before it is no longer is zero.

    Args:
        context: to live in.
    """

    def __init__(self, context: Context) -> None:
        super().__init__("policy_node", context)
        declare_model_name(self)
        declare_sensors(self)
        declare(self, "policy", "go_to_goal", "Name of a policy.", read_only=True)
        declare(self, "base_frame", "base_link", "Frame id of the robot.")
        about = "x, y in map [m]; NaN waits for goal_pose."
        declare(self, "goal", [float("nan")] * 2, about, read_only=True)
        self._acted_ns = 0

    def configure(self) -> None:
        """Opens model and policy, and listens."""
        model = open_model(str(self.get_parameter("model").value))
        self._task = Navigation(model.robot, model.lidar)
        self._policy = make_policy(str(self.get_parameter("policy").value), self._task)
        self._goal: NDArray[np.float64] = self._declared_goal()
        view = rehearse(model)
        self._task.judge(view, {"goal": np.zeros(2)})
        self._command(view, np.zeros(2))
        self._raw = self.create_lifecycle_publisher(TwistStamped, "cmd_vel_raw", qos.COMMAND)
        self.undo.callback(self.destroy_lifecycle_publisher, self._raw)
        goals = self.create_subscription(PoseStamped, "goal_pose", self._on_goal, qos.COMMAND)
        self.undo.callback(self.destroy_subscription, goals)
        self._topics = RobotTopics(self, model, on_odometry=self._act, on_scan=self._act)
        self.undo.callback(self._topics.close)

    def deactivate(self) -> None:
        """Leaves a zero command behind."""
        last_word(self._raw, self._message(np.zeros(3), self._acted_ns))

    def _declared_goal(self) -> NDArray[np.float64]:
        goal = self.get_parameter("goal").value
        if len(goal) != 2:
            raise ConfigError(f"parameter 'goal': must be [x, y], not {list(goal)}")
        return np.array(goal, dtype=np.float64)

    def _on_goal(self, message: PoseStamped) -> None:
        self._goal = np.array([message.pose.position.x, message.pose.position.y])
        self.get_logger().info(f"new goal ({self._goal[0]:.2f}, {self._goal[1]:.2f}) m")

    def _act(self, _: int) -> None:
        """Acts once per scan, as soon as an odometry at least as new is there."""
        if self.state != ACTIVE:
            return
        newest = self._topics.middleware.cache.newest
        if "scan" not in newest or ODOM not in newest:
            return
        scan_ns = newest["scan"].stamp_ns
        if newest[ODOM].stamp_ns < scan_ns or scan_ns <= self._acted_ns:
            return
        self._acted_ns = scan_ns
        self._raw.publish(self._message(self._twist(), scan_ns))

    def _twist(self) -> NDArray[np.float64]:
        """The command (3,) for the present view; zero without a goal, at it, or at a touch.

        Where a pose sensor tells where the robot is, zero before its first pose too.
        """
        if not (self._topics.located and np.isfinite(self._goal).all()):
            return np.zeros(3)
        view = self._topics.view()
        memory = {"goal": self._goal}
        verdict = self._task.judge(view, memory)
        if verdict.reached or verdict.touched:
            why = "touching something, stopped" if verdict.touched else "goal reached"
            self.get_logger().info(why, throttle_duration_sec=5.0)
            return np.zeros(3)
        return self._command(view, self._goal)

    def _command(self, view: RobotView, goal: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the policy wants (3,)."""
        action = self._policy.act(self._task.observation(view, {"goal": goal}))
        return self._task.robot.to_cmd_vel(self._task.command(action))

    def _message(self, twist: NDArray[np.float64], stamp_ns: int) -> TwistStamped:
        message = TwistStamped(twist=conversions.twist_to_ros(twist))
        message.header.stamp = conversions.stamp_to_ros(stamp_ns)
        message.header.frame_id = str(self.get_parameter("base_frame").value)
        return message


def main(args: list[str] | None = None) -> None:
    """Entry point of the executable."""
    run_node(PolicyNode, args)


if __name__ == "__main__":
    main()
