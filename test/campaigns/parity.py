"""The same seed and commands in process and over DDS: how much do the observations differ?

A simulator node runs in lock-step as a process of its own. Both envs are reset to the same
seeds and get the same random actions. Observations, rewards, ends and what `info` holds in both are
compared; NaN, another shape and another end differ by infinity. A late observation is one that
holds a scan or an odometry older than the step that it answers. By default each robot drives
alone, and then a team of four cars drives with each in its own namespace.

Bars: no difference, no late observation, and every run drove. The controls spoil one observation of
the env over DDS, or let the robots stand.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from campaign import Given, Result, at_least, at_most, run_campaign
from measuring.evaluations import standing_action

from nics_drl_bridge.env.registry import COOPERATIVE_REACHING, NAVIGATION, register_envs
from nics_drl_bridge.nodes.processes import NodeProcess, free_domain_id

SPOILT_STEP = 3
DRIVEN_M = 0.2
"""Less is no drive."""
OF_SIMULATOR = {"true_pose", "true_collision", "randomisation"}
"""What only the simulator in process tells."""
OF_CLOCKS = {"stamp_ns"}
"""What counts from another beginning in each."""
DIFFERENCE = "max_abs_observation_difference"
LATE = "late_observations"
DRIVEN = "driven_m"
BARS = {DIFFERENCE: at_most(0), LATE: at_most(0), DRIVEN: at_least(DRIVEN_M)}
ROBOTS = ("ackermann", "differential", "mecanum")
FLEET = 4


class Spoilt(gymnasium.Wrapper):
    """An env one of whose observations a control spoils."""

    def __init__(self, env: gymnasium.Env, control: str) -> None:
        super().__init__(env)
        self._control = control
        self._steps = 0
        self._last = None

    def step(self, action: Any) -> Any:
        """That of the env, but for one."""
        observation, reward, ended, cut, info = self.env.step(action)
        self._steps += 1
        seen = observation.copy()
        if self._steps == SPOILT_STEP:
            if self._control == "noise":
                seen[-1] = np.nextafter(seen[-1], np.float32(np.inf))
            if self._control == "late" and self._last is not None:
                seen = self._last
                info = {**info, "scan_age_s": 0.1}
        self._last = observation
        return seen, reward, ended, cut, info


def measure(
    robot: str,
    world: str,
    steps: int,
    seed: int,
    robots: int = 1,
    control: str | None = None,
) -> dict[str, float]:
    """Drives both envs for `steps` steps and compares every observation."""
    register_envs()
    domain_id = free_domain_id()
    parameters = {"model": robot, "world": world, "mode": "lockstep", "robots": robots}
    task: dict[str, Any] = {"id": NAVIGATION}
    if robots > 1:
        task = {"id": COOPERATIVE_REACHING, "task_options": {"robots": robots}}
    with (
        tempfile.TemporaryDirectory() as folder,
        NodeProcess("simulator_node", Path(folder), parameters, domain_id),
    ):
        here = gymnasium.make(
            **task, backend="sim", model=robot, world=world, estimator=True
        )
        there = gymnasium.make(
            **task,
            backend="dds",
            model=robot,
            world=world,
            backend_options={"domain_id": domain_id, "timeout_s": 300.0},
        )
        if control is not None:
            there = Spoilt(there, control)
        try:
            return compare(here, there, steps, seed, stands=control == "standing")
        finally:
            here.close()
            there.close()


def difference(one: Any, other: Any) -> float:
    """Greatest difference of two arrays, or numbers; inf of another shape, and where NaN is."""
    a = np.asarray(one, np.float64)
    b = np.asarray(other, np.float64)
    if a.shape != b.shape or not (np.isfinite(a).all() and np.isfinite(b).all()):
        return float("inf")
    return float(np.abs(a - b).max(initial=0.0))


def told_differently(one: dict[str, Any], other: dict[str, Any]) -> float:
    """Greatest difference of what both `info` hold; inf where one lacks what the task tells."""
    worst = 0.0 if set(one) - set(other) <= OF_SIMULATOR else float("inf")
    for name in set(one) & set(other):
        a = one[name]
        b = other[name]
        pairs = (
            [(a[term], b.get(term, np.nan)) for term in a]
            if isinstance(a, dict)
            else [(a, b)]
        )
        if name not in OF_CLOCKS:
            worst = max([worst, *(difference(*pair) for pair in pairs)])
    return worst


def compare(
    here: gymnasium.Env,
    there: gymnasium.Env,
    steps: int,
    seed: int,
    stands: bool = False,
) -> dict[str, float]:
    """Steps two envs side by side, beginning a new episode in both whenever one ends.

    Args:
        here: in process.
        there: over DDS.
        steps: how many.
        seed: of actions and first episode.
        stands: whether the robots are told to stand.
    """
    rng = np.random.default_rng(seed)
    worst = 0.0
    late = 0
    spent = 0.0
    episodes = 0
    driven = 0.0
    ended = True
    for _ in range(steps):
        if ended:
            (a, info_a), (b, info_b) = (
                env.reset(seed=seed + episodes) for env in (here, there)
            )
            episodes += 1
            worst = max(worst, difference(a, b), told_differently(info_a, info_b))
        before = info_b["pose"]
        action = rng.uniform(-1.0, 1.0, here.action_space.shape).astype(np.float32)
        if stands:
            action = standing_action(here)
        a, reward_a, end_a, cut_a, info_a = here.step(action)
        begin = time.perf_counter()
        b, reward_b, end_b, cut_b, info_b = there.step(action)
        spent += time.perf_counter() - begin
        ends = difference((end_a, cut_a), (end_b, cut_b)) and float("inf")
        told = told_differently(info_a, info_b)
        worst = max(worst, difference(a, b), difference(reward_a, reward_b), ends, told)
        late += not (info_b["scan_age_s"] <= 0.0 and info_b["odom_age_s"] <= 0.0)
        # Of a team, the one that moved least.
        moved = np.atleast_2d(info_b["pose"] - before)[:, :2]
        driven += float(np.hypot(*moved.T).min())
        ended = end_a or cut_a or end_b or cut_b
    return {
        "steps": steps,
        DIFFERENCE: worst,
        LATE: int(late),
        "episodes": episodes,
        DRIVEN: round(driven, 3),
        "dds_steps_per_s": round(steps / spent, 1) if spent else 0.0,
    }


def measure_all(given: Given) -> Result:
    """Each robot alone, then the fleet, with the worst of all on top; or one of these."""
    about = given.world, given.steps, given.seed
    if given.robot is not None or given.robots is not None:
        robot = given.robot or ROBOTS[0]
        return measure(robot, *about, given.robots or 1, given.control)
    runs = {robot: measure(robot, *about, control=given.control) for robot in ROBOTS}
    fleet = measure(ROBOTS[0], *about, FLEET, given.control)
    runs[f"{FLEET} robots in namespaces"] = fleet
    return {
        "steps": sum(int(run["steps"]) for run in runs.values()),
        DIFFERENCE: max(run[DIFFERENCE] for run in runs.values()),
        LATE: sum(int(run[LATE]) for run in runs.values()),
        DRIVEN: min(run[DRIVEN] for run in runs.values()),
        "runs": runs,
    }


OPTIONS = {
    "steps": 500,
    "seed": 0,
    "robot": {"help": "one kind of robot alone, as ackermann"},
    "robots": {"type": int, "help": "so many of them, in namespaces"},
    "world": "arena",
}

if __name__ == "__main__":
    run_campaign(measure_all, BARS, OPTIONS)
