"""The whole stack for a long time: does anything grow, and does the robot ever stop unasked?

Two things run at once. In one DDS domain a robot drives to ever new goals as it would in the
field, in real time, each part a process: `simulator_node`, `middleware_node`, `policy_node` and
`command_gate`. In another, a Gymnasium env begins and drives episodes over lock-step topics as
fast as it can. Memory (resident), threads and file descriptors of each process, and of this one,
are taken after a warm-up and until the end. A stop is explained if this script asked for it.

Bars: no unexplained stop, nothing grows, and both robots drove: goals and metres for each minute,
episodes and their steps. The controls never arm the gate, or open a file in each episode.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from campaign import Given, Result, at_least, at_most, missed_bars, run_campaign
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from parts.processes import Use, use_of
from std_srvs.srv import Trigger

from nics_drl_bridge.env.registry import NAVIGATION, register_envs
from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.processes import NodeProcess, free_domain_id
from nics_drl_bridge.nodes.spun_node import SpunNode

ROBOT = "differential"
WORLD = "empty"
GOALS = np.array([[1.5, 0.0], [1.5, 1.5], [0.0, 1.5], [-1.5, 0.0], [0.0, -1.5]])
NEAR_M = 0.35
STEPS_PER_EPISODE = 20
SAMPLE_S = 5.0
PATIENCE_S = 90.0
GOAL_AGAIN_S = 1.0
BARS = {
    "unexplained_stops": at_most(0),
    "rss_growth_mb": at_most(10.0),
    "fds_growth": at_most(0),
    "threads_growth": at_most(0),
    "resets": at_least(1),
    "steps": at_least(1),
    "driven_in_episodes_m": at_least(0.2),
}
DRIVEN_M, GOALS_REACHED = 2.0, 1.0
"""In each minute, at least."""


class Drive(SpunNode):
    """Arms the gate, sends goals one after the other, and counts the stops that the gate tells of.

    Args:
        domain_id: of the robot.
        armed: whether the gate is taken for armed, so that nobody asks it.

    Attributes:
        goals: how many were reached.
        stops: rule -> how often it stopped the robot since it was armed.
        driven_m: how far the robot truly drove [m].
    """

    def __init__(self, domain_id: int, armed: bool) -> None:
        self.driven_m = 0.0
        self._place = None
        super().__init__("soak", domain_id)
        self.goals = 0
        self.stops = {}
        self._sent_s = 0.0
        self.armed = armed
        self._asked_s = 0.0
        self._answer = None
        self._goal = self.node.create_publisher(PoseStamped, "goal_pose", qos.COMMAND)
        self._arm = self.node.create_client(Trigger, "command_gate/arm")
        self.node.create_subscription(Odometry, "ground_truth", self._look, qos.SENSOR)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._read, 10)

    def _look(self, message: Odometry) -> None:
        pose = conversions.odometry_from_ros(message)[0]
        before = self._place
        self._place = pose[:2]
        self.driven_m += (
            0.0 if before is None else float(np.hypot(*(pose[:2] - before)))
        )
        goal = GOALS[self.goals % len(GOALS)]
        now = time.monotonic()
        if np.hypot(*(pose[:2] - goal)) < NEAR_M:
            self.goals += 1
            self._sent_s = 0.0
        elif now - self._sent_s > GOAL_AGAIN_S:
            self._sent_s = now
            told = PoseStamped()
            told.header.frame_id = "map"
            told.pose.position.x, told.pose.position.y = map(float, goal)
            self._goal.publish(told)

    def _read(self, message: DiagnosticArray) -> None:
        for status in message.status:
            for value in status.values:
                if value.key.startswith("stopped, "):
                    self.stops[value.key.removeprefix("stopped, ")] = int(value.value)

    def arm(self) -> None:
        """Asks the gate until it grants."""
        now = time.monotonic()
        if self._answer is not None and self._answer.done():
            self.armed = bool(self._answer.result().success)
            self._answer = None
        if (
            not self.armed
            and now - self._asked_s > 1.0
            and self._arm.service_is_ready()
        ):
            self._asked_s, self._answer = now, self._arm.call_async(Trigger.Request())

    def go_on(self) -> None:
        """Handles what has come."""
        for _ in range(20):
            self.spin(0.0)


class Episodes:
    """Short episodes of an env over lock-step topics, one after the other.

    Attributes:
        env: that drives.
        resets, steps: how many.
        driven_m: how far its robot drove, by its own estimate [m].
    """

    def __init__(self, domain_id: int, leaks: bool) -> None:
        self._opened: list[Any] | None = [] if leaks else None
        self.driven_m = 0.0
        self._place = np.zeros(2)
        register_envs()
        options = {"domain_id": domain_id, "timeout_s": PATIENCE_S}
        self.env = gymnasium.make(
            NAVIGATION,
            backend="dds",
            model=ROBOT,
            world="arena",
            backend_options=options,
        )
        self.resets = 0
        self.steps = 0
        self._left = 0
        self._rng = np.random.default_rng(0)

    def go_on(self) -> None:
        """A reset or a step."""
        if self._left == 0:
            self._place = self.env.reset(seed=self.resets)[1]["pose"][:2]
            self.resets += 1
            if self._opened is not None:
                self._opened.append(open("/dev/null"))  # noqa: SIM115  (it is to leak)
            self._left = STEPS_PER_EPISODE
            return
        action = self._rng.uniform(-1.0, 1.0, self.env.action_space.shape).astype(
            np.float32
        )
        _, _, ended, cut, info = self.env.step(action)
        self.steps += 1
        before = self._place
        self._place = info["pose"][:2]
        self.driven_m += float(np.hypot(*(self._place - before)))
        self._left = 0 if ended or cut else self._left - 1


@dataclass(frozen=True)
class Soak:
    """What is running.

    Attributes:
        drive: of the robot in real time.
        episodes: of the env.
        uses: name -> what a process uses now.
    """

    drive: Drive
    episodes: Episodes
    uses: Callable[[], dict[str, Use]]


def begin(stack: ExitStack, control: str | None) -> Soak:
    """Starts everything; it ends with the stack."""
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    field = free_domain_id()
    track = free_domain_id()
    gate = {"model": ROBOT, "limits": ROBOT, "black_box": str(folder / "black_box")}
    gate |= {"use_sim_time": True, "e_stop_required": False}
    parts: dict[str, tuple[str, dict[str, Any], int]] = {
        "simulator_node": ("simulator_node", {"model": ROBOT, "world": WORLD}, field),
        "middleware_node": ("middleware_node", {"model": ROBOT}, field),
        "policy_node": ("policy_node", {"model": ROBOT}, field),
        "command_gate": ("command_gate", gate, field),
        "lockstep_simulator_node": (
            "simulator_node",
            {"model": ROBOT, "world": "arena", "mode": "lockstep"},
            track,
        ),
    }
    processes = {
        name: stack.enter_context(NodeProcess(node, folder / name, given, domain))
        for name, (node, given, domain) in parts.items()
    }
    drive = Drive(field, armed=control == "standing")
    try:
        episodes = Episodes(track, leaks=control == "leak")
    except BackendError:
        for process in processes.values():
            process.check()  # raises with the log of the one that is to blame
        raise
    stack.callback(drive.close)
    stack.callback(episodes.env.close)

    def uses() -> dict[str, Use]:
        for process in processes.values():
            process.check()
        return {name: use_of(p.pid) for name, p in processes.items()} | {
            "env": use_of()
        }

    return Soak(drive, episodes, uses)


def run(soak: Soak, seconds: float) -> list[dict[str, Use]]:
    """Lets everything go on for a time; what was used every few seconds."""
    samples = [soak.uses()]
    end = time.monotonic() + seconds
    due = time.monotonic()
    while (now := time.monotonic()) < end:
        soak.drive.go_on()
        soak.drive.arm()
        soak.episodes.go_on()
        if now > due:
            samples.append(soak.uses())
            due = now + SAMPLE_S
    return samples


def growth(
    samples: list[dict[str, Use]], of: Callable[[Use], float]
) -> dict[str, float]:
    """By process: the least of the last tenth minus the least of the first tenth of the samples.

    The least, since a garbage collector lets memory swing.
    """
    tenth = max(1, len(samples) // 10)
    return {
        name: min(of(one[name]) for one in samples[-tenth:])
        - min(of(one[name]) for one in samples[:tenth])
        for name in samples[0]
    }


def measure(given: Given) -> Result:
    """Runs everything and tells what grew."""
    control = given.control
    with ExitStack() as stack:
        soak = begin(stack, control)
        deadline = time.monotonic() + PATIENCE_S
        while not (soak.drive.armed and (soak.drive.goals or control == "standing")):
            run(soak, 1.0)
            if time.monotonic() > deadline:
                break
        run(soak, 60.0 * given.warm_up)
        before = dict(soak.drive.stops)
        known = counts(soak)
        samples = run(soak, 60.0 * given.minutes)
        stops = {
            rule: count - before.get(rule, 0)
            for rule, count in soak.drive.stops.items()
            if count > before.get(rule, 0)
        }
        memory = growth(samples, lambda use: use.rss_mb)
        return {
            "rss_growth_mb": round(max(memory.values()), 2),
            "fds_growth": int(max(growth(samples, lambda use: use.files).values())),
            "threads_growth": int(
                max(growth(samples, lambda use: use.threads).values())
            ),
            "unexplained_stops": sum(stops.values()),
            "stops": stops,
            "rss_growth_mb_by_process": {
                name: round(v, 2) for name, v in memory.items()
            },
            **{name: round(now - known[name], 3) for name, now in counts(soak).items()},
            "minutes": given.minutes,
        }


def counts(soak: Soak) -> dict[str, float]:
    """What was done until now."""
    return {
        "goals_reached": soak.drive.goals,
        "driven_m": soak.drive.driven_m,
        "resets": soak.episodes.resets,
        "steps": soak.episodes.steps,
        "driven_in_episodes_m": soak.episodes.driven_m,
    }


def judge(result: Result) -> list[str]:
    minutes = result["minutes"]
    goals = int(GOALS_REACHED * minutes)  # of whole minutes
    rates = {
        "driven_m": at_least(DRIVEN_M * minutes),
        "goals_reached": at_least(goals),
    }
    return missed_bars(result, BARS | rates)


OPTIONS = {"minutes": 10.0, "warm-up": (1.0, "minutes before it counts")}

if __name__ == "__main__":
    run_campaign(measure, judge, OPTIONS)
