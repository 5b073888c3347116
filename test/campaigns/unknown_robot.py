"""A robot that nobody here modelled, driven by the documented commands.

The robot is a skid-steer in DART (`parts/dart_skid_steer.py`): a real process behind ROS 2
topics, with wheel odometry that believes in turns that slip, and a gyro. It is recorded in an open
place, a simulator is generated, a policy is trained, and then gate, estimator and policy drive it
to goals among pillars. Each goal is given relative to the robot, and judged by the true pose, which
no node hears. Afterwards its body is held again and again while its wheels go on, each time at
another moment of a drive, and the gate has to stop it.
"""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from campaign import (
    FOLDER,
    Given,
    Result,
    at_least,
    at_most,
    run_campaign,
    tell,
)
from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Odometry
from parts.processes import call_apart, make_environment
from skid_rover import PILLARS
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from nics_drl_bridge.config import share_folder
from nics_drl_bridge.geometry import between
from nics_drl_bridge.interface import Array
from nics_drl_bridge.nodes import conversions
from nics_drl_bridge.nodes.listener import SpunNode
from nics_drl_bridge.nodes.processes import NodeProcess, choose_domain_id

DRIVER = FOLDER / "parts" / "dart_skid_steer.py"
# The task ends at this distance from the goal by the estimate; the rest is for its drift [m].
GOAL_RADIUS = 0.2
TRUE_RADIUS = 0.4  # within which the true pose counts as at the goal [m]
GOAL_DISTANCE = (2.0, 5.0)
GOAL_CLEARANCE = 0.9  # of a goal from pillars and walls [m]
GOAL_PATIENCE_S = 60.0
ANSWER_S = 3.0  # within which the policy takes up a goal
GATE_S = 10.0  # within which the gate answers
REST_S = 1.0  # at rest for so long, the robot has ended a drive
HELD_PATIENCE_S = 10.0  # within which a held body is stopped, or never
DRIVES_BEFORE_HOLD_S = (0.2, 5.0)  # between the first moving command and a hold

# size of the walls [m], and pillars
OPEN_PLACE = ((30.0, 30.0), ())
SIZE = np.array([12.0, 12.0])
FIELD = (tuple(SIZE.tolist()), PILLARS)
WORLD = f"""
name: field
size: [12.0, 12.0]
obstacles:
  - shapes: [{{kind: circle, radius: 0.2}}, {{kind: circle, radius: 0.35}}]
    count: 10
    gap: 1.2
clearance: 0.9
goal_distance: {list(GOAL_DISTANCE)}
"""
ROBOT = """
name: rover
kind: skid_steer
footprint: [[0.45, 0.34], [-0.45, 0.34], [-0.45, -0.34], [0.45, -0.34]]
lidar: rplidar_a2
parameters: {track: 0.57, wheel_radius: 0.165}
command:
  - {name: forward_command, unit: m/s, min: -0.8, max: 0.8, cmd_vel: linear.x}
  - {name: turn_command, unit: rad/s, min: -1.2, max: 1.2, cmd_vel: angular.z}
"""
LIMITS = """
robot: rover
commands:
  forward_command: {min: -0.4, max: 0.8, rate: 2.0, jerk: 40.0}
  turn_command: {min: -1.2, max: 1.2, rate: 6.0, jerk: 120.0}
"""


class Workshop:
    """The folder of a run, and the commands that a user would type in it."""

    def __init__(self, folder: Path, domain_id: int, has_imu: bool, seed: int) -> None:
        self.folder = folder
        self.domain_id = domain_id
        self._has_imu = has_imu
        self._seed = seed
        self.policy = folder / "policies" / f"seed_{seed}" / "policy.onnx"
        folder.mkdir(parents=True, exist_ok=True)
        files = {
            "robot.yaml": ROBOT,
            "limits.yaml": LIMITS,
            "field.yaml": WORLD,
            "training.yaml": yaml.safe_dump(choose_settings()),
        }
        for name, text in files.items():
            (folder / name).write_text(text)

    def run_nics(self, made: str, line: str) -> None:
        """Runs a `nics` command in the folder, unless what it makes is there."""
        if (self.folder / made).exists():
            return
        words = line.split()
        done = subprocess.run(
            [str(Path(sys.executable).with_name("nics")), *words],
            cwd=self.folder,
            env=make_environment(self.domain_id),
            capture_output=True,
            text=True,
        )
        (self.folder / f"{words[0]}.log").write_text(done.stdout + done.stderr)
        if done.returncode != 0:
            raise SystemExit(f"nics {line} ended with {done.returncode}: {done.stderr}")

    def start_driver(self, place: Any) -> Any:
        """Starts the robot's own driver in a place; it runs until the end of the block."""
        call = f"run(*{place!r}, {self._seed}, {self._has_imu})"
        return call_apart(str(DRIVER), self.domain_id, call, stdout=subprocess.DEVNULL)

    def prepare(self) -> None:
        """Records the robot in an open place, generates its simulator and trains a policy."""
        with self.start_driver(OPEN_PLACE):
            self.run_nics(
                "drive",
                "record --robot robot.yaml --out drive --bound 5 --duration 90 --yes",
            )
        self.run_nics(
            "rover/model.yaml", "generate drive --robot robot.yaml --out rover"
        )
        self.run_nics(
            "policies",
            "train --robot rover --world field.yaml --settings training.yaml "
            f"--seeds {self._seed} --out policies",
        )


def choose_settings() -> dict[str, Any]:
    """Returns the shipped settings of a robot like this one, with a smaller goal."""
    file = share_folder() / "config" / "training" / "own_differential.yaml"
    settings: dict[str, Any] = yaml.safe_load(file.read_text())
    settings["task_options"]["goal_radius"] = GOAL_RADIUS
    return settings


class Operator(SpunNode):
    """A person with a button and a map: gives goals, arms the gate, and judges by the true pose."""

    def __init__(self, seed: int, domain_id: int) -> None:
        super().__init__("operator", domain_id)
        self._pillars = np.array(PILLARS)
        self._rng = np.random.default_rng(seed)
        self.pose: Array | None = None
        self.touched = False
        self.commanded: list[tuple[float, bool]] = []  # time [s], whether it moves
        self._policy_moves = False  # since the last goal
        node = self.node
        node.create_subscription(Odometry, "true_pose", self._take_pose, 10)
        node.create_subscription(Bool, "touched", self._take_touch, 10)
        node.create_subscription(TwistStamped, "cmd_vel", self._take_command, 10)
        node.create_subscription(TwistStamped, "cmd_vel_raw", self._take_wish, 10)
        self._goal = node.create_publisher(PoseStamped, "goal_pose", 1)
        self._button = node.create_publisher(Bool, "e_stop", 10)
        self._hold = node.create_publisher(Bool, "hold", 10)
        node.create_timer(0.05, lambda: self._button.publish(Bool(data=False)))

    def _take_pose(self, message: Odometry) -> None:
        self.pose = conversions.odometry_from_ros(message)[0]

    def _take_touch(self, message: Bool) -> None:
        self.touched |= message.data

    def _take_command(self, message: TwistStamped) -> None:
        moves = bool(conversions.twist_from_ros(message).any())
        self.commanded.append((time.monotonic(), moves))

    def _take_wish(self, message: TwistStamped) -> None:
        self._policy_moves |= bool(conversions.twist_from_ros(message).any())

    def is_policy_there(self) -> bool:
        """Returns whether a node listens to goals."""
        return self._goal.get_subscription_count() > 0

    def ask_gate(self, service: str) -> tuple[bool, str]:
        """Calls a service of the gate; returns whether it agreed and what it said."""
        try:
            answer = self.call_service(Trigger, f"command_gate/{service}", GATE_S)
        except TimeoutError as error:
            return False, str(error)
        return bool(answer.success), str(answer.message)

    def arm(self, patience_s: float) -> str:
        """Arms the gate, asking again until it agrees; returns its last refusal, or nothing."""
        deadline = time.monotonic() + patience_s
        message = "not asked"
        while time.monotonic() < deadline:
            agreed, message = self.ask_gate("arm")
            if agreed:
                return ""
            self.ask_gate("reset")
            self.until(lambda: False, 0.5)
        return message

    def draw_goal(self) -> Array:
        """Draws a free place at some distance from the robot (2,) [m], in the world."""
        assert self.pose is not None
        while True:
            goal = self._rng.uniform(-0.5, 0.5, 2) * (SIZE - 2.0 * GOAL_CLEARANCE)
            far = math.dist(goal, self.pose[:2])
            to_pillars = np.hypot(*(self._pillars[:, :2] - goal).T)
            is_free = (to_pillars - self._pillars[:, 2]).min() >= GOAL_CLEARANCE
            if is_free and GOAL_DISTANCE[0] <= far <= GOAL_DISTANCE[1]:
                return goal

    def send_goal(self, goal: Array) -> None:
        """Sends a goal of the world, relative to where the robot stands."""
        assert self.pose is not None
        relative = between(self.pose, np.array([*goal, self.pose[2]]))
        self._policy_moves = False
        self._goal.publish(conversions.pose_to_ros(relative, 0, "base_link"))

    def drive_to(self, goal: Array) -> float:
        """Lets the robot drive; returns how far from the goal it rests [m], NaN if it does not."""
        begin_s = time.monotonic()
        self.send_goal(goal)
        while not self.until(lambda: self._policy_moves, ANSWER_S):
            if time.monotonic() - begin_s > GOAL_PATIENCE_S:
                return math.nan
            self.send_goal(goal)  # it may have come before the policy knew where it is
        ended = self.until(lambda: self.is_at_rest(begin_s), GOAL_PATIENCE_S)
        self.commanded.clear()
        if not ended or self.pose is None:
            return math.nan
        return math.dist(self.pose[:2], goal)

    def is_driving(self) -> bool:
        """Returns whether the newest command moves the robot."""
        return bool(self.commanded) and self.commanded[-1][1]

    def is_at_rest(self, since_s: float) -> bool:
        """Returns whether the robot moved after a moment and has been at rest for a while since."""
        moved = [at for at, moves in self.commanded if moves and at > since_s]
        return bool(moved) and time.monotonic() - moved[-1] > REST_S

    def hold(self, held: bool) -> None:
        """Holds the robot's body, or lets it go."""
        self._hold.publish(Bool(data=held))


@dataclass
class Drives:
    """What became of the goals."""

    # true distance from each goal when the robot came to rest [m]; NaN after a time-out
    away_m: list[float] = field(default_factory=list)
    refusals: list[str] = field(default_factory=list)  # of the gate to be armed
    armings: int = 0


def drive_to_goals(operator: Operator, goals: int) -> Drives:
    """Drives to so many goals; the gate is armed again where it has stopped the robot."""
    drives = Drives()
    armed = False
    while len(drives.away_m) < goals:
        if not armed:
            refusal = operator.arm(60.0)
            if refusal:
                drives.refusals.append(refusal)
                break
            drives.armings += 1
        away = operator.drive_to(operator.draw_goal())
        drives.away_m.append(away)
        tell(f"goal {len(drives.away_m)}: {away:.2f} m away")
        armed = not math.isnan(away)
        if not armed:
            operator.ask_gate("reset")
    return drives


def stop_held_body(operator: Operator, drives_for_s: float) -> float:
    """Holds the body after it has driven for so long; returns the time to the last moving command.

    It is NaN [s] if the robot cannot be armed or does not drive, and inf if it is never stopped.
    """
    while True:
        if operator.arm(60.0):
            return math.nan
        operator.commanded.clear()
        operator.send_goal(operator.draw_goal())
        if not operator.until(operator.is_driving, 20.0):
            return math.nan
        operator.until(lambda: False, drives_for_s)
        if operator.is_driving():
            break
    operator.hold(True)
    held_s = time.monotonic()
    stops = operator.until(lambda: operator.is_at_rest(0.0), HELD_PATIENCE_S)
    moved = [at for at, moves in operator.commanded if moves]
    operator.hold(False)
    return moved[-1] - held_s if stops else math.inf


def hold_again_and_again(operator: Operator, holds: int, seed: int) -> list[float]:
    """Returns after how long each of so many held bodies was stopped [s]."""
    rng = np.random.default_rng(seed)
    delays = []
    for _ in range(holds):
        delays.append(stop_held_body(operator, rng.uniform(*DRIVES_BEFORE_HOLD_S)))
        tell(f"hold {len(delays)}: stopped after {delays[-1]:.2f} s")
        if math.isnan(delays[-1]):
            break
    return delays


def start_bridge(workshop: Workshop, control: str | None) -> ExitStack:
    """Starts gate, estimator and policy as `vehicle.launch.py` does; returns what ends them."""
    folder = workshop.folder
    shared = {"model": str(folder / "rover"), "enable_stamped_cmd_vel": True}
    gate = shared | {"limits": str(folder / "limits.yaml")}
    nodes = {
        "command_gate": gate | {"stop_when_held": control != "no_gate_rule"},
        "middleware_node": shared,
        "policy_node": shared | {"policy": str(workshop.policy)},
    }
    stack = ExitStack()
    for name, parameters in nodes.items():
        node = NodeProcess(name, folder / "nodes", parameters, workshop.domain_id)
        stack.enter_context(node)
    return stack


def measure(given: Given) -> Result:
    """Records, generates, trains and drives."""
    domain_id = choose_domain_id()
    with ExitStack() as stack:
        temporary = stack.enter_context(tempfile.TemporaryDirectory())
        folder = (given.folder or Path(temporary)).resolve()
        has_imu = given.control != "no_gyro"
        workshop = Workshop(folder, domain_id, has_imu, given.seed)
        workshop.prepare()
        operator = Operator(given.seed, domain_id)
        stack.callback(operator.close)
        stack.enter_context(workshop.start_driver(FIELD))
        stack.enter_context(start_bridge(workshop, given.control))
        if not operator.until(lambda: operator.pose is not None, 30.0):
            raise SystemExit("the robot's driver is silent.")
        if not operator.until(operator.is_policy_there, 120.0):
            raise SystemExit("the policy does not listen; see nodes/policy_node.log.")
        drives = drive_to_goals(operator, given.goals)
        held_s = hold_again_and_again(operator, given.holds, given.seed)
        report = (folder / "rover" / "report.txt").read_text()
    reached = [away <= TRUE_RADIUS for away in drives.away_m]
    return {
        "report": report.splitlines()[:8],
        "success": sum(reached) / max(len(reached), 1),
        "touched": int(operator.touched),
        "refused": len(drives.refusals),
        "latest_s": max(
            held_s, key=lambda delay: (math.isnan(delay), delay), default=0.0
        ),
        "held_stopped_after_s": held_s,
        **vars(drives),
    }


BARS = {
    "success": at_least(0.95, "success by true pose"),
    "touched": at_most(0, "things that the robot touched"),
    "refused": at_most(0, "times that the gate could not be armed"),
    "latest_s": at_most(1.0, "time until a held body was stopped [s]"),
}
OPTIONS = {
    "goals": 40,
    "seed": (0, "of goals, noise and the training"),
    "holds": (20, "how often its body is held"),
    "folder": {"type": Path, "help": "keep all files there, and use what is there"},
}

if __name__ == "__main__":
    run_campaign(measure, BARS, OPTIONS)
