"""policy_node: runs a policy on a robot's topics."""

import math
import time
import traceback
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, TwistStamped

from nics_drl_bridge.errors import BridgeError, ConfigError, shorten
from nics_drl_bridge.gate import inputs
from nics_drl_bridge.generator import SimulatorModel, open_model
from nics_drl_bridge.interface import NS_PER_S, S_PER_NS, Array, RobotView
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.middleware.measurement import ODOM, SCAN
from nics_drl_bridge.middleware.middleware import rehearse
from nics_drl_bridge.middleware.uncertainty import compute_uncertainty_gain
from nics_drl_bridge.nodes import conversions, qos, runner
from nics_drl_bridge.nodes.frames import GoalFrames
from nics_drl_bridge.nodes.operator import GoalAnswer
from nics_drl_bridge.nodes.robot_topics import SILENCE_S, RobotTopics
from nics_drl_bridge.nodes.runner import ACTIVE, UNCONFIGURED, ManagedNode, Wish
from nics_drl_bridge.pacing import ActionPace, Answer, Deadline
from nics_drl_bridge.policy.file.stateful import begin, resume
from nics_drl_bridge.policy.policies import open_policy

# time between two looks at cancelled goals and silent data, as a fraction of the control period
POLLS = 0.5
LONGEST_REASON = 300  # maximum length of a policy's error text [characters]


class PolicyNode(ManagedNode):
    """Answers each scan with a `cmd_vel_raw` of the same stamp, until the goal is reached."""

    def __init__(self, **options: Any) -> None:
        super().__init__("policy_node", "policy", **options)
        self._leaders = runner.open_parts("policy", self)
        self._acted_ns = 0
        self._answer: GoalAnswer | None = None  # to the newest goal
        runner.diagnose(self, "policy", self._look)

    def ignores(self, name: str) -> bool:
        """Return True for a parameter in a file that means nothing to a policy."""
        return any(leader.ignores(name) for leader in self._leaders)

    def configure(self) -> None:
        """Open model and policy, and subscribe."""
        model = self._model = open_model(runner.get_text(self, "model"))
        self._open_policy(model)
        goal = self._goal = np.array(self.get_parameter("goal").value, np.float64)
        if len(goal) != 2 or not (abs(goal).max() <= 1e8 or np.isnan(goal).all()):
            raise ConfigError(
                "parameter 'goal': must be [x, y] within 1e8 m, or both NaN to wait for "
                f"goal_pose, not {goal.tolist()}."
            )
        self._read_pace(model.control_period)
        self._acted_ns = 0
        self._answer = None
        self._raw = self.create_lifecycle_publisher(
            TwistStamped, inputs.RAW, qos.COMMAND
        )
        goals = self.create_subscription(
            PoseStamped, "goal_pose", self._on_goal, qos.COMMAND
        )
        self.undo.callback(self.destroy_subscription, goals)
        self._topics = RobotTopics(self, model, self._act, self._act, self._on_lidar)
        self.undo.callback(self._topics.close)
        # covariance of the pose when the goal was set
        self._covariance = self._topics.middleware.estimator.covariance[:3, :3]
        self._topics.subscribe_initial_pose()
        self._frames = GoalFrames(self, self._topics)
        self.undo.callback(self._frames.close)
        for leader in self._leaders:
            self.undo.callback(leader.close)
            leader.open(
                self._topics,
                self._frames,
                model,
                self._toward,
                lambda: begin(self._policy),
            )
        timer = runner.call_periodically(self, POLLS * model.control_period, self._act)
        self.undo.callback(self.destroy_timer, timer)
        self._due = runner.call_periodically(self, model.control_period, self._act)
        self._due.cancel()  # until a scan comes before an action is due
        self.undo.callback(self.destroy_timer, self._due)

    def _read_pace(self, period_s: float) -> None:
        names = ("rate", "deadline", "late_limit")
        rate, limit_s, patience = (self.get_parameter(name).value for name in names)
        if rate < 0.0 or limit_s <= 0.0:
            raise ConfigError(
                f"parameters rate {rate}, deadline {limit_s}: must be at least 0, and more "
                "than 0."
            )
        if np.isnan(limit_s):
            limit_s = 0.5 * period_s
        self._deadline = Deadline(limit_s, patience)
        pace_s = 0.0
        if np.isnan(rate):
            pace_s = period_s
        elif rate > 0.0:
            pace_s = 1.0 / rate
        self._pace = ActionPace(pace_s)

    def activate(self) -> None:
        """Start with a fresh state of the policy."""
        begin(self._policy)

    def deactivate(self) -> None:
        """Leave a zero command behind."""
        try:
            for leader in self._leaders:
                leader.stop("the node is deactivated")
        finally:
            runner.publish_last(self._raw, self._message(np.zeros(3), self._acted_ns))

    def _open_policy(self, model: SimulatorModel) -> None:
        name = runner.get_text(self, "policy")
        self._policy, self._task = open_policy(name, model)
        sensors = (sensor.name for sensor in self._task.sensors)
        self._needed = (SCAN, ODOM, *sensors)  # topics for an action
        view = rehearse(model)  # compiles everything now
        self._task.judge(view, {"goal": np.zeros(2)})
        self._asked(view, np.zeros(2))
        begin(self._policy)

    def _on_lidar(self, lidar: LidarSpec) -> None:
        self._open_policy(replace(self._model, lidar=lidar))
        begin, end = np.degrees([lidar.angles[0], lidar.angles[-1]])
        done = "used" if self._task.scan is None else "resampled"
        self.get_logger().info(
            f"scans of {lidar.beams} beams from {begin:.4g} to {end:.4g} deg are {done}"
        )

    def _on_goal(self, message: PoseStamped) -> None:
        stamp_ns = conversions.stamp_from_ros(message.header.stamp)
        if any(leader.active or leader.led for leader in self._leaders):
            reason = "a goal_pose is ignored while an action leads the robot"
            self.get_logger().info(reason, throttle_duration_sec=5.0)
            self._answer = GoalAnswer(stamp_ns, False, reason)
            return
        try:
            goal = self._frames.in_map(message)
        except ConfigError as error:
            self.get_logger().error(f"{error} The previous goal stays.")
            self._answer = GoalAnswer(stamp_ns, False, str(error))
            return
        if not np.array_equal(goal, self._goal):
            begin(self._policy)
        self._goal = goal
        self._covariance = self._topics.middleware.estimator.covariance[:3, :3]
        place = f"({self._goal[0]:.2f}, {self._goal[1]:.2f}) m"
        self._answer = GoalAnswer(stamp_ns, True, f"{place} in the map")
        self.get_logger().info(f"new goal {place}")

    def _act(self, _: int = 0) -> None:
        if self.state != ACTIVE:
            return
        ticks = [leader.tick() for leader in self._leaders]
        if any(ticks):
            self._raw.publish(self._message(np.zeros(3), self._acted_ns))
        newest = self._topics.middleware.cache.newest
        begin_s = time.monotonic()
        if not newest.keys() >= set(self._needed):
            return
        scan_ns = newest[SCAN].stamp_ns
        if scan_ns < self._acted_ns:  # a simulation's clock was set back
            self._acted_ns = 0
            begin(self._policy)
        fresh = newest[ODOM].stamp_ns >= scan_ns > self._acted_ns
        if not fresh:
            return
        self._due.cancel()
        wait_s = self._pace.get_wait(begin_s)
        if wait_s > 0.0:
            self._due.timer_period_ns = math.ceil(wait_s * NS_PER_S)
            self._due.reset()
            return
        self._pace.acted(begin_s)
        self._acted_ns = scan_ns
        twist = self._twist()
        answer = self._deadline.judge(time.monotonic() - begin_s)
        if answer is not Answer.SEND:
            fault = f"inference was late ({self._deadline.late} so far); its command is dropped"
            self.get_logger().warning(fault, throttle_duration_sec=5.0)
        if answer is not Answer.DROP:
            if answer is Answer.SEND and np.isfinite(twist).all():
                sent = twist
            else:
                sent = np.zeros(3)
            self._raw.publish(self._message(sent, scan_ns))

    def _look(self) -> runner.Condition:
        if self.state == UNCONFIGURED:
            return runner.Condition(self.state, runner.OK, facts={})
        done = self._deadline
        longest = f"{1e3 * self._deadline.longest_s:.2f}"
        facts: dict[str, object] = {
            "answered": done.answered,
            "late": done.late,
            "longest inference [ms]": longest,
        }
        if self._answer is not None:
            facts.update(self._answer.to_facts())
        message = f"{self.state}; {done.late} late inferences"
        level = runner.WARN if done.late else runner.OK
        silent = self._topics.list_silent(self._needed, SILENCE_S)
        if silent:
            message = f"{message}; nothing on {', '.join(silent)}"
            level = runner.STALE
        elif done.stops:
            message = f"{message}, the robot is stopped"
            level = runner.ERROR
        return runner.Condition(message, level, facts, self._model.robot.name)

    def _twist(self) -> Array:
        for leader in self._leaders:
            if leader.active:
                self._goal = np.full(2, np.nan)  # the previous goal is given up
                twist: Array = leader.twist()
                return twist
        if not (self._topics.located and np.isfinite(self._goal).all()):
            return np.zeros(3)
        verdict = self._task.judge(self._topics.view(), {"goal": self._goal})
        if verdict.reached or verdict.touched:
            if verdict.touched:
                why = "the robot touches something and is stopped"
            else:
                now = self._topics.middleware.estimator.covariance[:3, :3]
                gained = compute_uncertainty_gain(self._covariance, now)
                told = gained.describe_since("it was set")
                why = f"goal reached, as believed; {told}"
            self.get_logger().info(why, throttle_duration_sec=5.0)
            return np.zeros(3)
        return self._toward(self._goal).twist

    def _toward(self, goal: Array) -> Wish:
        view = self._topics.view()
        warning = resume(self._policy, self._acted_ns * S_PER_NS)
        if warning:
            self.get_logger().warning(warning, throttle_duration_sec=5.0)
        return Wish(
            self._asked(view, goal),
            bool(self._task.judge(view, {"goal": goal}).touched),
        )

    def _asked(self, view: RobotView, goal: Array) -> Array:
        try:
            action = self._policy.act(self._task.observation(view, {"goal": goal}))
            return self._task.robot.to_cmd_vel(self._task.command(action))
        except BridgeError:
            raise
        except Exception as error:
            self.get_logger().debug(traceback.format_exc())
            place = traceback.extract_tb(error.__traceback__)[-1]
            words = shorten(f"{type(error).__name__}: {error}", LONGEST_REASON)
            name = self.get_parameter("policy").value
            where = f"{place.filename}, line {place.lineno}"
            fix = "the robot is stopped; fix the policy."
            raise BridgeError(
                f"policy {name!r} raised {words} ({where}); {fix}"
            ) from error

    def _message(self, twist: Array, stamp_ns: int) -> TwistStamped:
        frame = runner.get_text(self, "base_frame")
        return conversions.stamped_to_ros(twist, stamp_ns, frame)


main = partial(runner.run_node, PolicyNode, sole_name="policy_node")
