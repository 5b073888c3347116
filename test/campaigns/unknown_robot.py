"""A robot that nobody here modelled, driven by the documented commands.

The robot is a skid-steer in DART (`parts/dart_skid_steer.py`): a real process behind ROS 2
topics, with wheel odometry that believes in turns that slip, and a gyro. It is recorded in an open
place, a simulator is generated, a policy is trained, and then gate, estimator and policy drive it
to goals among pillars. Each goal is given relative to the robot, and judged by the true pose, which
no node hears. Afterwards its body is held again and again while its wheels go on, each time at
another moment of a drive, and the gate has to stop it.
"""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from campaign import FOLDER, Given, Result, run_campaign
from geometry_msgs.msg import PoseStamped, TwistStamped
from numpy.typing import NDArray
from skid_rover import PILLARS
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from nics_drl_bridge.config import share_folder
from nics_drl_bridge.nodes.processes import NodeProcess, free_domain_id
from nics_drl_bridge.nodes.spun_node import SpunNode

Array = NDArray[np.float64]

SUCCESS_BAR = 0.95
HELD_BAR_S = 1.0
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

OPEN_PLACE = {"size": [30.0, 30.0], "pillars": []}
FIELD = {"size": [12.0, 12.0], "pillars": [list(pillar) for pillar in PILLARS]}
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

    def __init__(self, folder: Path, domain_id: int, with_imu: bool, seed: int) -> None:
        self.folder = folder
        self._with_imu = with_imu
        self._seed = seed
        chosen = {
            "ROS_DOMAIN_ID": str(domain_id),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        }
        self._environment = os.environ | chosen
        folder.mkdir(parents=True, exist_ok=True)
        files = {
            "robot.yaml": ROBOT,
            "limits.yaml": LIMITS,
            "field.yaml": WORLD,
            "training.yaml": yaml.safe_dump(training_settings()),
            "open_place.json": json.dumps(OPEN_PLACE),
            "field.json": json.dumps(FIELD),
        }
        for name, text in files.items():
            (folder / name).write_text(text)

    def nics(self, line: str) -> str:
        """Runs a `nics` command in the folder; returns what it printed."""
        words = line.split()
        command = [str(Path(sys.executable).with_name("nics")), *words]
        done = subprocess.run(
            command,
            cwd=self.folder,
            env=self._environment,
            capture_output=True,
            text=True,
        )
        (self.folder / f"{words[0]}.log").write_text(done.stdout + done.stderr)
        if done.returncode != 0:
            raise SystemExit(f"nics {line} ended with {done.returncode}: {done.stderr}")
        return done.stdout

    @contextmanager
    def driver(self, place: str) -> Iterator[None]:
        """The robot's own driver in a place, until the end of the block."""
        command = [sys.executable, "-m", "parts.dart_skid_steer"]
        command += ["--place", str(self.folder / place), "--seed", str(self._seed)]
        if not self._with_imu:
            command.append("--no-imu")
        with (self.folder / "driver.log").open("wb") as log:
            process = subprocess.Popen(
                command, cwd=FOLDER, env=self._environment, stdout=log, stderr=log
            )
        try:
            yield
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(10.0)

    def record(self) -> None:
        """Drives the robot in an open place and records it."""
        if (self.folder / "drive").exists():
            return
        with self.driver("open_place.json"):
            self.nics(
                "record --robot robot.yaml --out drive --bound 5 --duration 90 --yes"
            )

    def generate(self) -> str:
        """Generates the simulator; returns the report."""
        if not (self.folder / "rover" / "model.yaml").exists():
            self.nics("generate drive --robot robot.yaml --out rover")
        return (self.folder / "rover" / "report.txt").read_text()

    def train(self) -> Path:
        """Trains the policy; returns its file."""
        if not (self.folder / "policies").exists():
            self.nics(
                "train --robot rover --world field.yaml --settings training.yaml "
                f"--seeds {self._seed} --out policies"
            )
        return self.folder / "policies" / f"seed_{self._seed}" / "policy.onnx"


def training_settings() -> dict[str, Any]:
    """Returns the shipped settings of a robot like this one, with a smaller goal."""
    file = share_folder() / "config" / "training" / "own_differential.yaml"
    settings: dict[str, Any] = yaml.safe_load(file.read_text())
    settings["task_options"]["goal_radius"] = GOAL_RADIUS
    return settings


def is_moving(message: TwistStamped) -> bool:
    """Returns whether a command moves the robot."""
    twist = message.twist
    return bool(twist.linear.x or twist.linear.y or twist.angular.z)


class Operator(SpunNode):
    """A person with a button and a map: gives goals, arms the gate, and judges by the true pose."""

    def __init__(self, place: dict[str, Any], seed: int, domain_id: int) -> None:
        super().__init__("operator", domain_id)
        self._pillars = np.array(place["pillars"])
        self._size = np.array(place["size"])
        self._rng = np.random.default_rng(seed)
        self.pose: Array | None = None
        self.touched = False
        self.commanded: list[tuple[float, bool]] = []  # time [s], whether it moves
        self._policy_moves = False  # since the last goal
        self.node.create_subscription(PoseStamped, "true_pose", self._on_pose, 10)
        self.node.create_subscription(Bool, "touched", self._on_touch, 10)
        self.node.create_subscription(TwistStamped, "cmd_vel", self._on_command, 10)
        self.node.create_subscription(TwistStamped, "cmd_vel_raw", self._on_wish, 10)
        self._goal = self.node.create_publisher(PoseStamped, "goal_pose", 1)
        self._button = self.node.create_publisher(Bool, "e_stop", 10)
        self._hold = self.node.create_publisher(Bool, "hold", 10)
        self.node.create_timer(0.05, lambda: self._button.publish(Bool(data=False)))

    def _on_pose(self, message: PoseStamped) -> None:
        turned = message.pose.orientation
        heading = 2.0 * math.atan2(turned.z, turned.w)
        self.pose = np.array(
            [message.pose.position.x, message.pose.position.y, heading]
        )

    def _on_touch(self, message: Bool) -> None:
        self.touched |= message.data

    def _on_command(self, message: TwistStamped) -> None:
        self.commanded.append((time.monotonic(), is_moving(message)))

    def _on_wish(self, message: TwistStamped) -> None:
        self._policy_moves |= is_moving(message)

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
            goal = self._rng.uniform(-0.5, 0.5, 2) * (self._size - 2.0 * GOAL_CLEARANCE)
            far = float(np.linalg.norm(goal - self.pose[:2]))
            gaps = (
                np.linalg.norm(self._pillars[:, :2] - goal, axis=1)
                - self._pillars[:, 2]
            )
            if (
                GOAL_DISTANCE[0] <= far <= GOAL_DISTANCE[1]
                and gaps.min() >= GOAL_CLEARANCE
            ):
                return goal

    def send_goal(self, goal: Array) -> None:
        """Sends a goal of the world, relative to where the robot stands."""
        assert self.pose is not None
        cos = math.cos(self.pose[2])
        sin = math.sin(self.pose[2])
        away = goal - self.pose[:2]
        message = PoseStamped()
        message.header.frame_id = "base_link"
        message.pose.position.x = float(cos * away[0] + sin * away[1])
        message.pose.position.y = float(-sin * away[0] + cos * away[1])
        message.pose.orientation.w = 1.0
        self._policy_moves = False
        self._goal.publish(message)

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
        return float(np.linalg.norm(self.pose[:2] - goal))

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
    """What became of the goals.

    Attributes:
        away: true distance from each goal when the robot came to rest [m]; NaN after a time-out.
        refusals: what the gate said where it could not be armed.
        armings: how often it was armed.
        touched: whether the robot has touched anything.
    """

    away: list[float] = field(default_factory=list)
    refusals: list[str] = field(default_factory=list)
    armings: int = 0
    touched: bool = False

    @property
    def success(self) -> float:
        """Share of the goals that were truly reached."""
        return (
            float(np.mean([away <= TRUE_RADIUS for away in self.away]))
            if self.away
            else 0.0
        )


def drive_to_goals(operator: Operator, goals: int) -> Drives:
    """Drives to so many goals; the gate is armed again where it has stopped the robot."""
    drives = Drives()
    armed = False
    while len(drives.away) < goals:
        if not armed:
            refusal = operator.arm(60.0)
            if refusal:
                drives.refusals.append(refusal)
                break
            drives.armings += 1
        away = operator.drive_to(operator.draw_goal())
        drives.away.append(away)
        print(f"goal {len(drives.away)}: {away:.2f} m away", file=sys.stderr)
        armed = not math.isnan(away)
        if not armed:
            operator.ask_gate("reset")
    drives.touched = operator.touched
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
        print(f"hold {len(delays)}: stopped after {delays[-1]:.2f} s", file=sys.stderr)
        if math.isnan(delays[-1]):
            break
    return delays


def run_bridge(
    workshop: Workshop, policy: Path, domain_id: int, control: str | None
) -> ExitStack:
    """Starts gate, estimator and policy as `vehicle.launch.py` does; returns what ends them."""
    shared = {"model": str(workshop.folder / "rover"), "enable_stamped_cmd_vel": True}
    gate = shared | {"limits": str(workshop.folder / "limits.yaml")}
    if control == "no_gate_rule":
        gate |= {"stop_when_held": False}
    nodes = {
        "command_gate": gate,
        "middleware_node": shared,
        "policy_node": shared | {"policy": str(policy)},
    }
    stack = ExitStack()
    for name, parameters in nodes.items():
        folder = workshop.folder / "nodes"
        stack.enter_context(NodeProcess(name, folder, parameters, domain_id))
    return stack


def measure(given: Given) -> Result:
    """Records, generates, trains and drives."""
    with tempfile.TemporaryDirectory() as temporary:
        return measure_in((given.folder or Path(temporary)).resolve(), given)


def measure_in(folder: Path, options: Given) -> Result:
    """Does so in a folder."""
    domain_id = free_domain_id()
    workshop = Workshop(folder, domain_id, options.control != "no_gyro", options.seed)
    workshop.record()
    report = workshop.generate()
    policy = workshop.train()
    operator = Operator(FIELD, options.seed, domain_id)
    with (
        workshop.driver("field.json"),
        run_bridge(workshop, policy, domain_id, options.control),
    ):
        if not operator.until(lambda: operator.pose is not None, 30.0):
            raise SystemExit("the robot's driver is silent; see driver.log.")
        if not operator.until(operator.is_policy_there, 120.0):
            raise SystemExit("the policy does not listen; see nodes/policy_node.log.")
        drives = drive_to_goals(operator, options.goals)
        held_s = hold_again_and_again(operator, options.holds, options.seed)
    operator.close()
    return {
        "report": report.splitlines()[:8],
        "success": drives.success,
        "away_m": drives.away,
        "touched": drives.touched,
        "armings": drives.armings,
        "refusals": drives.refusals,
        "held_stopped_after_s": held_s,
    }


def judge(result: Result) -> list[str]:
    missed = []
    if not result["success"] >= SUCCESS_BAR:
        missed.append(
            f"success {result['success']:.3f} by true pose, bar {SUCCESS_BAR:g}"
        )
    if result["touched"]:
        missed.append("the robot touched something")
    if result["refusals"]:
        missed.append(f"the gate could not be armed: {result['refusals'][-1]}")
    delays = result["held_stopped_after_s"]
    late = [delay for delay in delays if not delay <= HELD_BAR_S]
    if late:
        told = f"{len(late)} of {len(delays)} held bodies were stopped late"
        missed.append(f"{told}, after {max(late):.2f} s, bar {HELD_BAR_S:g} s")
    return missed


OPTIONS = {
    "goals": 40,
    "seed": (0, "of goals, noise and the training"),
    "holds": (20, "how often its body is held"),
    "folder": {"type": Path, "help": "keep all files there, and use what is there"},
}

if __name__ == "__main__":
    run_campaign(measure, judge, OPTIONS)
