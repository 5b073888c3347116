"""The whole stack for a long time: does anything grow, and does the robot ever stop unasked?

Two things run at once. In one DDS domain a robot drives to ever new goals as it would in the
field, in real time, each part a process: `simulator_node`, `middleware_node`, `policy_node` and
`command_gate`. In another, a Gymnasium env begins and drives episodes over lock-step topics as
fast as it can. Memory (resident), threads and file descriptors of each process, and of this one,
are taken after a warm-up and until the end. No stop is asked for, so each one is unexplained.
"""

from __future__ import annotations

import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from campaign import Bars, Given, Result, at_least, at_most, run_campaign
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from parts.processes import Use, measure_use
from std_srvs.srv import Trigger

from nics_drl_bridge.env.registry import NAVIGATION, register_envs
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.listener import SpunNode
from nics_drl_bridge.nodes.processes import NodeProcess, choose_domain_id

ROBOT = "differential"
GOALS = np.array([[1.5, 0.0], [1.5, 1.5], [0.0, 1.5], [-1.5, 0.0], [0.0, -1.5]])
NEAR_M = 0.35
STEPS_PER_EPISODE = 20
SAMPLE_S = 5.0
PATIENCE_S = 90.0
GOAL_AGAIN_S = 1.0
FIRST_GOAL_MINUTES = 0.25
STOPPED = "stopped, "  # stands before a rule in the gate's diagnostics
BARS = {
    "unexplained_stops": at_most(0),
    "growth": {
        "rss_mb": {"*": at_most(10.0)},
        "files": {"*": at_most(0)},
        "threads": {"*": at_most(0)},
    },
    "resets": at_least(1),
    "steps": at_least(1),
    "driven_in_episodes_m": at_least(0.2),
}
DRIVEN_M = 2.0  # in each minute, at least
GOALS_REACHED = 1.0  # in each minute, at least


class Drive(SpunNode):
    """Arms the gate, sends goals one after the other, and counts the stops of the gate."""

    def __init__(self, domain_id: int) -> None:
        super().__init__("soak", domain_id)
        self.driven_m = 0.0
        self.goals = 0  # that were reached
        self.stops: dict[str, int] = {}  # by rule, since the gate was armed
        self._place: Any = None
        self._sent_s = 0.0
        self._goal = self.node.create_publisher(PoseStamped, "goal_pose", qos.COMMAND)
        self.node.create_subscription(Odometry, "ground_truth", self._look, qos.SENSOR)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._read, 10)

    def _look(self, message: Odometry) -> None:
        place = conversions.odometry_from_ros(message)[0][:2]
        if self._place is not None:
            self.driven_m += float(np.hypot(*(place - self._place)))
        self._place = place
        goal = GOALS[self.goals % len(GOALS)]
        now = time.monotonic()
        if np.hypot(*(place - goal)) < NEAR_M:
            self.goals += 1
            self._sent_s = 0.0
        elif now - self._sent_s > GOAL_AGAIN_S:
            self._sent_s = now
            self._goal.publish(conversions.pose_to_ros([*goal, 0.0], 0, "map"))

    def _read(self, message: DiagnosticArray) -> None:
        for value in (value for status in message.status for value in status.values):
            if value.key.startswith(STOPPED):
                self.stops[value.key.removeprefix(STOPPED)] = int(value.value)

    def arm(self) -> None:
        """Arms the gate, if it agrees."""
        for service in ("reset", "arm"):
            self.call_service(Trigger, f"command_gate/{service}", PATIENCE_S)

    def go_on(self) -> None:
        """Handles what has come."""
        for _ in range(20):
            self.spin(0.0)


class Episodes:
    """Short episodes of an env over lock-step topics, one after the other."""

    def __init__(self, domain_id: int, leaks: bool) -> None:
        register_envs()
        options = {"domain_id": domain_id, "timeout_s": PATIENCE_S}
        about = {"backend": "dds", "model": ROBOT, "world": "arena"}
        self.env = gymnasium.make(NAVIGATION, **about, backend_options=options)
        self.resets = 0
        self.steps = 0
        self.driven_m = 0.0  # by the robot's own estimate
        self._leaks = leaks
        self._opened: list[Any] = []
        self._place = np.zeros(2)
        self._left = 0
        self._rng = np.random.default_rng(0)

    def go_on(self) -> None:
        """Resets or steps the env."""
        if self._left == 0:
            self._place = self.env.reset(seed=self.resets)[1]["pose"][:2]
            self.resets += 1
            if self._leaks:
                self._opened.append(open("/dev/null"))  # noqa: SIM115  (it is to leak)
            self._left = STEPS_PER_EPISODE
            return
        space = self.env.action_space
        action = self._rng.uniform(-1.0, 1.0, space.shape).astype(np.float32)
        _, _, ended, cut, info = self.env.step(action)
        self.steps += 1
        before = self._place
        self._place = info["pose"][:2]
        self.driven_m += float(np.hypot(*(self._place - before)))
        self._left = 0 if ended or cut else self._left - 1


class Soak:
    """All that runs, until the end of a stack."""

    def __init__(self, stack: ExitStack, control: str | None) -> None:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        field = choose_domain_id()
        track = choose_domain_id()
        model = {"model": ROBOT}
        gate = model | {"limits": ROBOT, "black_box": str(folder / "black_box")}
        gate |= {"use_sim_time": True, "e_stop_required": False}
        lockstep = model | {"world": "arena", "mode": "lockstep"}
        parts: tuple[tuple[str, dict[str, Any], int], ...] = (
            ("simulator_node", model | {"world": "empty"}, field),
            ("middleware_node", model, field),
            ("policy_node", model, field),
            ("command_gate", gate, field),
            ("simulator_node", lockstep, track),
        )
        self._processes = {}
        for node, parameters, domain_id in parts:
            name = f"{node}_{domain_id}"
            process = NodeProcess(node, folder / name, parameters, domain_id)
            self._processes[name] = stack.enter_context(process)
        self.drive = Drive(field)
        stack.callback(self.drive.close)
        self.episodes = Episodes(track, leaks=control == "leak")
        stack.callback(self.episodes.env.close)
        deadline_s = time.monotonic() + PATIENCE_S
        while control != "standing" and time.monotonic() < deadline_s:
            self.drive.arm()
            self.run(FIRST_GOAL_MINUTES)
            if self.drive.goals:
                break

    def measure_uses(self) -> dict[str, Use]:
        """Returns what each process uses now."""
        for process in self._processes.values():
            process.check()
        pids = {name: process.pid for name, process in self._processes.items()}
        return {name: measure_use(pid) for name, pid in {**pids, "env": None}.items()}

    def run(self, minutes: float) -> list[dict[str, Use]]:
        """Lets everything go on for a time; returns what was used every few seconds."""
        samples = [self.measure_uses()]
        end_s = time.monotonic() + 60.0 * minutes
        due_s = time.monotonic()
        while (now := time.monotonic()) < end_s:
            self.drive.go_on()
            self.episodes.go_on()
            if now > due_s:
                samples.append(self.measure_uses())
                due_s = now + SAMPLE_S
        return samples

    def count(self) -> dict[str, float]:
        """Returns what was done until now."""
        return {
            "goals_reached": self.drive.goals,
            "driven_m": self.drive.driven_m,
            "resets": self.episodes.resets,
            "steps": self.episodes.steps,
            "driven_in_episodes_m": self.episodes.driven_m,
        }


def compute_growth(samples: list[dict[str, Use]], what: str) -> dict[str, float]:
    """Returns by process: the least of the last tenth of the samples minus that of the first.

    The least, since a garbage collector lets memory swing.
    """
    tenth = max(1, len(samples) // 10)
    least = [
        {name: min(getattr(one[name], what) for one in part) for name in samples[0]}
        for part in (samples[:tenth], samples[-tenth:])
    ]
    return {name: round(last - least[0][name], 2) for name, last in least[1].items()}


def measure(given: Given) -> Result:
    """Runs everything and tells what grew."""
    with ExitStack() as stack:
        soak = Soak(stack, given.control)
        soak.run(given.warm_up)
        known = soak.count()
        stopped = dict(soak.drive.stops)
        samples = soak.run(given.minutes)
        stops = {
            rule: count - stopped.get(rule, 0)
            for rule, count in soak.drive.stops.items()
        }
        growth = {what: compute_growth(samples, what) for what in Use._fields}
        done = soak.count()
        return {
            "unexplained_stops": sum(stops.values()),
            "stops": stops,
            "growth": growth,
            **{name: round(value - known[name], 3) for name, value in done.items()},
            "minutes": given.minutes,
        }


def set_bars(result: Result) -> Bars:
    minutes = result["minutes"]
    return BARS | {
        "driven_m": at_least(DRIVEN_M * minutes),
        "goals_reached": at_least(int(GOALS_REACHED * minutes)),  # of whole minutes
    }


OPTIONS = {"minutes": 10.0, "warm-up": (1.0, "minutes before it counts")}

if __name__ == "__main__":
    run_campaign(measure, set_bars, OPTIONS)
