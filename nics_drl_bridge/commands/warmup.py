"""`nics warmup`: compiles the kernels ahead, on all cores."""

from __future__ import annotations

import json
import os
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Annotated

import typer

from nics_drl_bridge.commands.console import one_sentence

ROBOT, WORLD = "differential", "arena"


def warmup(
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Compiles what training, driving and generating need, on all cores, once on a machine."""
    with one_sentence():
        begin = time.monotonic()
        typer.echo("compiling the kernels, once on this machine: about a minute", err=True)
        # Fresh processes: what a fork shares with its parent's threads may be locked for ever.
        with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
            done = list(pool.map(_compiled_by, PARTS))
        count, cpu_s = sum(each[0] for each in done), sum(each[1] for each in done)
        took = time.monotonic() - begin
        if as_json:
            typer.echo(json.dumps({"kernels": count, "cpu_s": cpu_s, "seconds": took}))
        else:
            typer.echo(f"compiled {count} kernels in {took:.0f} s ({cpu_s:.0f} s of CPU)", err=True)


def _compiled_by(part: str) -> tuple[int, float]:
    """Runs a part of `PARTS`; returns how many kernels that compiled, and its CPU time [s]."""
    from nics_drl_bridge.kernels import COMPILING

    COMPILING.quiet = True
    PARTS[part]()
    return COMPILING.count, COMPILING.cpu_s


def _train() -> None:
    """A few steps of a vector env, which are the kernels of a simulator, too."""
    from nics_drl_bridge.env.vector_env import BridgeVectorEnv
    from nics_drl_bridge.generator import builtin_model

    env = BridgeVectorEnv(2, builtin_model(ROBOT), WORLD)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()


def _drive() -> None:
    """A few steps by the estimator, the planner and the shield."""
    from nics_drl_bridge.env.bridge_env import BridgeEnv
    from nics_drl_bridge.policy.policies import open_policy

    env = BridgeEnv(model=ROBOT, world=WORLD)
    policy, _ = open_policy("dynamic_window", env.model)
    observation, _ = env.reset(seed=0)
    env.step(policy.act(observation))
    env.close()


def _generate() -> None:
    """A model from a short drive of the textbook robot, with its lidar table."""
    import numpy as np

    from nics_drl_bridge.generator import generate
    from nics_drl_bridge.lidar.spec import load_lidar
    from nics_drl_bridge.recording.textbook import record
    from nics_drl_bridge.robot.spec import load_robot
    from nics_drl_bridge.sim.world import load_world

    robot = load_robot(ROBOT)
    recording = record(robot, np.random.default_rng(0))
    generate(recording, robot, load_lidar("paper"), load_world(WORLD).shapes, assume=True)


PARTS = {"train": _train, "generate": _generate, "drive": _drive}
"""Longest first; they share few kernels."""
