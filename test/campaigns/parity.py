"""The same seed and commands in process and over DDS: how much do the observations differ?

A simulator node runs in lock-step as a process of its own. Both envs are reset to the same
seeds and get the same random actions. Observations, rewards, ends and what `info` holds in both are
compared; NaN, another shape and another end differ by infinity. A late observation is one that
holds a scan or an odometry older than the step that it answers. By default each robot drives
alone, and then a team of four cars drives with each in its own namespace.
"""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from campaign import Given, Result, at_least, at_most, run_campaign
from measuring.evaluations import standing_action

from nics_drl_bridge.env.registry import NAVIGATION, register_envs
from nics_drl_bridge.nodes.processes import NodeProcess, choose_domain_id

SPOILT_STEP = 3
DRIVEN_M = 0.2  # less is no drive
# what only the simulator in process tells
OF_SIMULATOR = {"true_pose", "true_collision", "randomisation"}
OF_CLOCKS = {"stamp_ns"}  # what counts from another beginning in each
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
        """Steps the env, and spoils one observation."""
        observation, *outcome, info = self.env.step(action)
        self._steps += 1
        seen = observation.copy()
        if self._steps == SPOILT_STEP:
            if self._control == "noise":
                seen[-1] = np.nextafter(seen[-1], np.float32(np.inf))
            if self._control == "late":
                seen = self._last
                info = {**info, "scan_age_s": 0.1}
        self._last = observation
        return seen, *outcome, info


def measure_robot(robot: str, robots: int, given: Given) -> dict[str, float]:
    """Drives robots of a kind in both envs and compares every observation."""
    register_envs()
    domain_id = choose_domain_id()
    world = {"model": robot, "world": given.world}
    about: dict[str, Any] = {"id": NAVIGATION} | world
    if robots > 1:
        about |= {
            "id": "NicsBridge/CooperativeReaching-v0",
            "task_options": {"robots": robots},
        }
    parameters = world | {"mode": "lockstep", "robots": robots}
    options = {"domain_id": domain_id, "timeout_s": 300.0}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        process = NodeProcess("simulator_node", folder, parameters, domain_id)
        stack.enter_context(process)
        here = gymnasium.make(**about, backend="sim", estimator=True)
        stack.callback(here.close)
        there = gymnasium.make(**about, backend="dds", backend_options=options)
        stack.callback(there.close)
        if given.control is not None:
            there = Spoilt(there, given.control)
        return compare(here, there, given)


def compute_difference(one: Any, other: Any) -> float:
    """Returns the greatest difference of arrays or numbers; inf for another shape or NaN."""
    a = np.asarray(one, np.float64)
    b = np.asarray(other, np.float64)
    if a.shape != b.shape or not (np.isfinite(a).all() and np.isfinite(b).all()):
        return float("inf")
    return float(np.abs(a - b).max(initial=0.0))


def compare_infos(one: dict[str, Any], other: dict[str, Any]) -> float:
    """Returns the greatest difference of what both hold; inf if one lacks what the task tells."""
    differences = [0.0 if set(one) - set(other) <= OF_SIMULATOR else float("inf")]
    for name in set(one) & set(other) - OF_CLOCKS:
        a = one[name]
        b = other[name]
        if not isinstance(a, dict):
            a, b = {"": a}, {"": b}
        differences += [compute_difference(a[key], b.get(key, np.nan)) for key in a]
    return max(differences)


def compare(here: gymnasium.Env, there: gymnasium.Env, given: Given) -> dict[str, Any]:
    """Steps an env in process and one over DDS, and resets both whenever one ends."""
    rng = np.random.default_rng(given.seed)
    worst = 0.0
    late = 0
    episodes = 0
    driven = 0.0
    ended = True
    for _ in range(given.steps):
        if ended:
            seed = given.seed + episodes
            first = [env.reset(seed=seed) for env in (here, there)]
            episodes += 1
            info = first[1][1]
            worst = max(worst, compare_answers(*first))
        before = info["pose"]
        action = rng.uniform(-1.0, 1.0, here.action_space.shape).astype(np.float32)
        if given.control == "standing":
            action = standing_action(here)
        ours = here.step(action)
        theirs = there.step(action)
        info = theirs[-1]
        worst = max(worst, compare_answers(ours, theirs))
        late += not (info["scan_age_s"] <= 0.0 and info["odom_age_s"] <= 0.0)
        # Of a team, the one that moved least.
        moved = np.atleast_2d(info["pose"] - before)[:, :2]
        driven += float(np.hypot(*moved.T).min())
        ended = any((*ours[2:4], *theirs[2:4]))
    return {
        "steps": given.steps,
        DIFFERENCE: worst,
        LATE: late,
        "episodes": episodes,
        DRIVEN: round(driven, 3),
    }


def compare_answers(ours: Any, theirs: Any) -> float:
    """Returns the greatest difference of two answers to a step or a reset."""
    *numbers, info = zip(ours, theirs, strict=True)
    ends = numbers[2:]
    if any(one != other for one, other in ends):
        return float("inf")
    differences = [compute_difference(*pair) for pair in numbers[:2]]
    return max(compare_infos(*info), *differences)


def measure(given: Given) -> Result:
    """Drives each robot alone, then the fleet, with the worst of all on top; or one of these."""
    if given.robot is not None or given.robots is not None:
        return measure_robot(given.robot or ROBOTS[0], given.robots or 1, given)
    runs = {robot: measure_robot(robot, 1, given) for robot in ROBOTS}
    fleet = measure_robot(ROBOTS[0], FLEET, given)
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
    run_campaign(measure, BARS, OPTIONS)
