"""`nics warmup`: compiles the kernels ahead, on two cores."""

from __future__ import annotations

import json
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
    """Compiles what generating, training and driving need, on two cores, once on a machine."""
    with one_sentence():
        begin, done = time.monotonic(), list[tuple[int, float]]()
        typer.echo("compiling the kernels, once on this machine: about a minute", err=True)
        # Fresh processes: what a fork shares with its parent's threads may be locked for ever.
        with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
            for stage in STAGES:
                done += pool.map(_compiled_by, stage)
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
    count, cpu_s = COMPILING.count, COMPILING.cpu_s
    PARTS[part]()
    return COMPILING.count - count, COMPILING.cpu_s - cpu_s


def _model() -> None:
    """Fits the kinematics of a drive and bakes a lidar table."""
    from nics_drl_bridge.generator import builtin_model

    builtin_model(ROBOT)


def _reset() -> None:
    """Draws scenes and scans them."""
    from nics_drl_bridge.generator import builtin_model
    from nics_drl_bridge.sim.simulator import FastSimulator
    from nics_drl_bridge.sim.world import load_world

    FastSimulator(builtin_model(ROBOT), load_world(WORLD), 2, 1).reset(range(2))


def _step() -> None:
    """Moves everything for a period."""
    import numpy as np

    from nics_drl_bridge.generator import builtin_model
    from nics_drl_bridge.sim.simulator import FastSimulator
    from nics_drl_bridge.sim.world import load_world

    FastSimulator(builtin_model(ROBOT), load_world(WORLD), 2, 1).step(np.zeros((2, 1, 2)))


def _train() -> None:
    """Observes and rewards many worlds at once."""
    from nics_drl_bridge.env.vector_env import BridgeVectorEnv
    from nics_drl_bridge.generator import builtin_model

    env = BridgeVectorEnv(2, builtin_model(ROBOT), WORLD)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()


def _drive() -> None:
    """Estimates, plans and shields."""
    from nics_drl_bridge.env.bridge_env import BridgeEnv
    from nics_drl_bridge.gate import shield
    from nics_drl_bridge.policy.policies import open_policy

    env = BridgeEnv(model=ROBOT, world=WORLD, estimator=True)
    policy, _ = open_policy("dynamic_window", env.model)
    observation, _ = env.reset(seed=0)
    env.step(policy.act(observation))
    env.close()
    shield.rehearse()


PARTS = {each.__name__[1:]: each for each in (_model, _reset, _step, _train, _drive)}
STAGES = ("model",), ("step", "reset"), ("train", "drive")
"""Parts that are compiled side by side; each stage needs what those before it compiled."""
