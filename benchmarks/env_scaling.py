"""What an env step costs with more worlds, robots, obstacles, beams, and worlds in a set.

Navigation on one thread: differential robots, 10 kinematic substeps, observation, reward and
autoreset, random actions. Unless it is what grows: 256 worlds of one robot, 10 circles on
8 x 8 m, 720 beams.
Robots and obstacles get a field that grows with them, so that as many as before are in range;
what then grows faster than their number is the search for them. `members` are the worlds of a set,
each with its own ten circles at fixed places, among which the 256 episodes are.
"""

from __future__ import annotations

import math
import time
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from bench import answer, parser_of
from measuring.fields import field, side_of
from measuring.rates import interleaved, medians

from nics_drl_bridge import style
from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.files import write_bytes
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.sim.scenes import sample_scene
from nics_drl_bridge.sim.world import World
from nics_drl_bridge.sim.world_set import AnyWorld, WorldSet

CONTROLS = {
    "quadratic": "the search for what is near: each robot looks at each other, in Python",
    "slow": "the batch: worlds are stepped one after the other, each by a call of its own",
    "apart": "the set: each of its worlds is a vector env of its own, with one copy at least",
}
BARS = {"worlds": 0.5, "robots": 4.0, "obstacles": 12.0, "beams": 12.0, "members": 1.15}
"""How many times the first point of a curve the last one costs at most, `robots` for each robot."""
MEMORY_BAR = 1.5
"""Of the last set's memory, with all its copies, to that of the first one."""
MODEL = open_model("differential")
WORLDS = 256
OBSTACLES = 10
SIDE = 8.0
BEAMS = 720
SWEEPS: dict[str, tuple[int, ...]] = {
    "worlds": (1, 4, 16, 64, 256, 1024, 4096, 16384),
    "robots": (1, 2, 4, 8, 16, 32, 64),
    "obstacles": (1, 4, 16, 64, 256),
    "beams": (36, 90, 180, 360, 720, 1440, 2048),
    "members": (1, 5, 25, 250),
}
AREA_PER_ROBOT, AREA_PER_OBSTACLE = 12.0, 4.0
"""[m^2]"""
FEWEST = 40
"""Steps of which the median is taken, at least, unless fewer are asked for."""
ALONE = 1024
"""Steps of a call, at most, where each world is stepped by a call of its own."""
ROBOT_STEPS = 256
"""Robots of all worlds together while their number in each grows."""


@dataclass(frozen=True)
class Crowd(Navigation):
    """The navigation task for each of several robots, which see each other by lidar alone.

    So the observation of a robot is as long in a world of 64 as in a world of its own.
    """

    team: int = 1

    @property
    def robots(self) -> int:
        """M."""
        return self.team


def members(count: int) -> list[World]:
    """Worlds whose circles stand where a seed each puts them in the usual field."""
    usual = field(OBSTACLES, SIDE)
    (group,) = usual.obstacles
    found = []
    for seed in range(count):
        bodies = sample_scene(usual, MODEL.robot.footprint_radius, seed).bodies
        at = tuple((x, y, 0.0) for x, y in bodies[:, :2].tolist())
        stands = group.model_copy(update={"count": None, "at": at})
        found.append(
            usual.model_copy(update={"name": f"field_{seed}", "obstacles": (stands,)})
        )
    return found


def environment(
    worlds: int, robots: int, world: AnyWorld, beams: int
) -> BridgeVectorEnv:
    """Worlds of robots that have to reach goals."""
    model = MODEL
    if beams != model.lidar.beams:
        lidar = model.lidar.model_copy(update={"beams": beams})
        lidar = type(lidar).model_validate(lidar.model_dump())
        model = replace(model, lidar=lidar, table=bake(lidar, model.table.shapes))
    options = {"team": robots}
    return BridgeVectorEnv(
        worlds,
        model,
        world,
        task=Crowd,
        task_options=options,
        copy=False,
        max_episode_steps=300,
    )


def sweep(name: str, value: int) -> BridgeVectorEnv:
    """The environment of one point of a curve."""
    world = field(OBSTACLES, SIDE)
    if name == "worlds":
        return environment(value, 1, world, BEAMS)
    if name == "robots":
        side = max(SIDE, side_of(value, AREA_PER_ROBOT))
        return environment(
            max(1, ROBOT_STEPS // value), value, field(OBSTACLES, side), BEAMS
        )
    if name == "obstacles":
        return environment(
            WORLDS, 1, field(value, max(SIDE, side_of(value, AREA_PER_OBSTACLE))), BEAMS
        )
    if name == "members":
        return environment(WORLDS, 1, WorldSet("fields", tuple(members(value))), BEAMS)
    return environment(WORLDS, 1, world, value)


def stepper(env: BridgeVectorEnv, times: int, in_pairs: bool) -> Callable[[], None]:
    """A call that steps an environment, by the same random actions again and again.

    Args:
        env: which.
        times: steps of a call.
        in_pairs: whether each robot of a world looks at each other in each substep, one by one.
    """
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(16)]
    count = [0]
    looks = env.model.timing[1] if in_pairs and env.robots > 1 else 0

    def step() -> None:
        for _ in range(times):
            env.step(actions[count[0] % len(actions)])
            count[0] += 1
            for _ in range(looks):
                for world in env.simulator.data.pose[:, :, :2].tolist():
                    min(math.dist(one, other) for one in world for other in world)

    return step


def apart(count: int) -> list[BridgeVectorEnv]:
    """A vector env for each world of a set, in which together as many copies are."""
    copies = max(1, WORLDS // count)
    return [environment(copies, 1, world, BEAMS) for world in members(count)]


def measure(
    name: str, values: Sequence[int], repeats: int, control: str | None
) -> list[float]:
    """The cost of an env step at each point of a curve [us]."""
    costs = []
    for value in values:
        alone = control == "slow" and name == "worlds"
        split = (name, control) == ("members", "apart")
        times = min(value, ALONE) if alone else 1
        envs = apart(value) if split else [sweep(name, 1 if alone else value)]
        stepped = sum(env.num_envs for env in envs) * times
        often = max(min(repeats, FEWEST), repeats // stepped)
        steps = [stepper(env, times, control == "quadratic") for env in envs]
        calls = {value: lambda steps=steps: [step() for step in steps]}
        seconds = medians(interleaved(calls, often, clock=time.process_time))
        costs.append(1e6 * seconds[value] / stepped)
        for env in envs:
            env.close()
    return costs


def memory(control: str | None) -> float:
    """How many times the memory of a set of one the set of most takes, with all its copies."""
    taken = []
    for value in (SWEEPS["members"][0], SWEEPS["members"][-1]):
        tracemalloc.start()
        envs = apart(value) if control == "apart" else [sweep("members", value)]
        for env in envs:
            env.reset(seed=0)
        taken.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
    return taken[1] / taken[0]


def run(repeats: int, ends_only: bool, control: str | None) -> dict[str, Any]:
    """All curves: `NAME` and `NAME_us`; of robots also the cost per robot."""
    result: dict[str, Any] = {}
    for name, sizes in SWEEPS.items():
        result[name] = [sizes[0], sizes[-1]] if ends_only else list(sizes)
        result[f"{name}_us"] = measure(name, result[name], repeats, control)
    per_robot = np.array(result["robots_us"]) / np.array(result["robots"])
    result["robots_us_per_robot"] = per_robot.tolist()
    result["members_memory"] = memory(control)
    result["end_to_end"] = {name: end_to_end(result, name) for name in SWEEPS}
    return result


def end_to_end(result: dict[str, Any], name: str) -> float:
    """How many times the first point of a curve the last one costs."""
    costs = result["robots_us_per_robot" if name == "robots" else f"{name}_us"]
    return float(costs[-1] / costs[0])


def judge(result: dict[str, Any]) -> list[str]:
    """The bars that were missed."""
    missed = [
        f"{name}: {result[name][-1]} cost {result['end_to_end'][name]:.2f} times "
        f"{result[name][0]}, bar {bar}"
        for name, bar in BARS.items()
        if not result["end_to_end"][name] <= bar
    ]
    if not result["members_memory"] <= MEMORY_BAR:
        taken = (
            f"{result['members_memory']:.2f} times the memory of one, bar {MEMORY_BAR}"
        )
        missed.append(f"members: {result['members'][-1]} take {taken}")
    return missed


def draw(result: dict[str, Any], file: Path) -> None:
    """The curves side by side, on logarithmic axes."""
    figure, grid = style.make_panels(1, len(SWEEPS), (12.0, 3.2), sharey=True)
    for axes, name in zip(grid, SWEEPS, strict=True):
        costs = result["robots_us_per_robot" if name == "robots" else f"{name}_us"]
        axes.loglog(result[name], costs, "o-")
        axes.set_xlabel(name)
        axes.set_ylabel(
            "us per robot and step" if name == "robots" else "us per env step"
        )
        axes.grid(visible=True, which="both")
    write_bytes(file, style.render_png(figure))


def main() -> None:
    """Prints a table, or one JSON object; ends with 1 when a bar is missed."""
    parser = parser_of(__doc__, CONTROLS)
    parser.add_argument(
        "--repeats", type=int, default=20_000, help="env steps of each point"
    )
    parser.add_argument("--picture", type=Path, help="draw the curves into this file")
    parser.add_argument(
        "--ends-only", action="store_true", help="two points of each curve"
    )
    given = parser.parse_args()
    result = run(given.repeats, given.ends_only, given.control)
    if given.picture:
        draw(result, given.picture)
    answer(result, judge(result), given.json)


if __name__ == "__main__":
    main()
