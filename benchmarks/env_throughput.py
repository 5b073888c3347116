"""How many steps per second does an environment give, alone and thousands at once?

The navigation task of the differential robot: 10 kinematic substeps per step, a lidar of 720
beams among ten circles, observation, reward, autoreset, random actions. Beside the vector env on
one thread and on all, and the single env of `gymnasium.make` without and with the estimator, two
other simulators do the same task in the same scenes in the same run, autoreset included.

What they offer to users moves and scans in one step, so that ten kinematic substeps are ten of
their steps: `peers`. `peers_with_one_scan` moves nine times past that, by their inner functions,
and scans at the end only, as ours does. (irsim-x can also step many robots at once, but all in
one scene, without a new one as each episode ends.)
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from lidar_peers import PEERS
from measuring.environments import NotInstalledError, python_with, run

from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.env.registration import MAX_EPISODE_STEPS, NAVIGATION, register_envs
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.sim.scenes import sample_scene
from nics_drl_bridge.sim.world import World

SCRIPT = Path(__file__).resolve().parent / "measuring" / "irsim_steps.py"
MODEL = open_model("differential")
RADIUS, CIRCLES = 0.15, 10
WORLD = World.model_validate(
    {
        "name": "ten circles",
        "size": [6.0, 6.0],
        "obstacles": [
            {"shapes": [{"kind": "circle", "radius": RADIUS}], "count": CIRCLES, "gap": 0.3}
        ],
        "clearance": 0.3,
        "goal_distance": [2.0, 4.0],
    }
)
GOAL_RADIUS = Navigation(MODEL.robot, MODEL.lidar).goal_radius
VECTOR_BAR, SINGLE_BAR, ESTIMATOR_BAR = 3e5, 2e4, 4e3
SCENES = 50
"""That the peers go through, one for each episode."""
ACTIONS, CHUNK, SINGLE_CHUNK = 64, 50, 500


def vector(worlds: int, threads: int) -> Callable[[], int]:
    """Makes a vector env; the function takes a chunk of steps and says how many env-steps."""
    further: dict[str, Any] = {} if threads == 1 else {"threads": threads}
    env = BridgeVectorEnv(worlds, MODEL, WORLD, **further)
    env.reset(seed=0)
    size = (ACTIONS, *env.action_space.shape)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, size).astype(np.float32)

    def chunk() -> int:
        for k in range(CHUNK):
            env.step(actions[k % ACTIONS])
        return CHUNK * worlds

    return chunk


def single(estimator: bool) -> Callable[[], int]:
    """Likewise the env of `gymnasium.make`, with the wrappers that it adds, reset when it ends."""
    env = gymnasium.make(NAVIGATION, model=MODEL, world=WORLD, estimator=estimator)
    env.reset(seed=0)
    size = (ACTIONS, *env.action_space.shape)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, size).astype(np.float32)

    def chunk() -> int:
        for k in range(SINGLE_CHUNK):
            _, _, terminated, truncated, _ = env.step(actions[k % ACTIONS])
            if terminated or truncated:
                env.reset()
        return SINGLE_CHUNK

    return chunk


def rates(calls: dict[str, Callable[[], int]], repeats: int) -> dict[str, float]:
    """Env-steps per second of each: the median of chunks that are timed in turn."""
    found: dict[str, list[float]] = {name: [] for name in calls}
    for k in range(repeats + 1):
        for name, call in calls.items():
            begin = time.perf_counter()
            steps = call()
            if k:  # the first compiles, and fills caches
                found[name].append(steps / (time.perf_counter() - begin))
    return {name: float(np.median(each)) for name, each in found.items()}


def memory_per_env(worlds: int) -> float:
    """Bytes that one more world takes, of the vector env at work."""
    taken = []
    for count in (worlds, 2 * worlds):
        tracemalloc.start()
        chunk = vector(count, 1)
        chunk()
        taken.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
        del chunk
    return (taken[1] - taken[0]) / worlds


def theirs(name: str, scenes: int, repeats: int) -> dict[str, float]:
    """Steps per second of a peer, by how it scans. Raises NotInstalledError."""
    footprint = MODEL.robot.footprint_radius
    drawn = [sample_scene(WORLD, footprint, seed) for seed in range(scenes)]
    fields = [
        {
            "circles": one.bodies[:, :2].tolist(),
            "start": one.starts[0].tolist(),
            "goal": one.goals[0].tolist(),
        }
        for one in drawn
    ]
    about = {
        "beams": MODEL.lidar.beams,
        "angle_range": float(MODEL.lidar.angles[-1] - MODEL.lidar.angles[0]),
        "range_min": MODEL.lidar.range_min,
        "range_max": MODEL.lidar.range_max,
        "radius": RADIUS,
        "half": (np.array(WORLD.size) / 2.0).tolist(),
        "footprint": footprint,
        "period": MODEL.control_period,
        "substeps": MODEL.timing[1],
        "goal_radius": GOAL_RADIUS,
        "limit": MAX_EPISODE_STEPS,
    }
    python = python_with(name, PEERS[name])
    with tempfile.TemporaryDirectory() as folder:
        asked = Path(folder) / "task.json"
        asked.write_text(json.dumps({"about": about, "scenes": fields, "repeats": repeats}))
        printed = run(python, SCRIPT, str(asked))
    return dict(json.loads(printed.strip().splitlines()[-1]))


def run_all(worlds: int, threads: int, repeats: int, peers: tuple[str, ...]) -> dict[str, Any]:
    """All figures; `None` for a peer that can't be installed or was not asked for."""
    register_envs()
    calls = {"one": vector(worlds, 1), "all": vector(worlds, threads)}
    found = rates(calls, repeats)
    alone = rates({"plain": single(False), "estimator": single(True)}, repeats)
    result: dict[str, Any] = {
        "single_thread_env_steps_per_s": found["one"],
        "all_threads_env_steps_per_s": found["all"],
        "threads": threads,
        "single_env_gym_steps_per_s": alone["plain"],
        "single_env_with_estimator_steps_per_s": alone["estimator"],
        "peers": dict.fromkeys(PEERS),
        "peers_with_one_scan": dict.fromkeys(PEERS),
        "memory_bytes_per_env": memory_per_env(worlds),
    }
    for name in peers:
        try:
            rates_of = theirs(name, SCENES, repeats)
            result["peers"][name] = rates_of["whole_steps"]
            result["peers_with_one_scan"][name] = rates_of["one_scan"]
        except NotInstalledError as error:
            sys.stderr.write(f"{error}\n")
    return result


def table_of(result: dict[str, Any]) -> str:
    """The figures for people."""
    row, fast = "{:<44}{:>12}{:>12}\n", result["single_thread_env_steps_per_s"]
    many = f"vector env, {result['threads']} threads"
    lines = [
        ("vector env, 1 thread", "single_thread_env_steps_per_s", VECTOR_BAR),
        (many, "all_threads_env_steps_per_s", None),
        ("gymnasium.make, odometry", "single_env_gym_steps_per_s", SINGLE_BAR),
        ("gymnasium.make, estimator", "single_env_with_estimator_steps_per_s", ESTIMATOR_BAR),
    ]
    text = row.format("", "env-steps/s", "bar")
    for title, key, bar in lines:
        text += row.format(title, f"{result[key]:.3g}", "" if bar is None else f"{bar:.0e}")
    for key, how in (("peers", ""), ("peers_with_one_scan", ", one scan")):
        for name, rate in result[key].items():
            shown = "-" if rate is None else f"{rate:.3g}"
            ratio = "" if rate is None else f", {fast / rate:.0f} times slower than ours"
            text += row.format(f"{name}{how}{ratio}", shown, "")
    return text + f"memory: {result['memory_bytes_per_env'] / 1e3:.1f} kB per world\n"


def main() -> None:
    """Prints a table, or one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--worlds", type=int, default=2048, help="of the vector env")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--repeats", type=int, default=10, help="timed chunks of steps")
    parser.add_argument("--without-peers", action="store_true", help="install nothing")
    given = parser.parse_args()
    peers = () if given.without_peers else tuple(PEERS)
    result = run_all(given.worlds, given.threads, given.repeats, peers)
    sys.stdout.write(json.dumps(result) + "\n" if given.json else table_of(result))


if __name__ == "__main__":
    main()
