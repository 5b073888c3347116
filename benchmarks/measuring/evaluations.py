"""Runs of `nics evaluate`, each in a process of its own, and policies and robots that deceive.

`python -m measuring.evaluations lying|standing evaluate ...` is `nics`, with a robot that believes
to be at its goal, or a policy that stands still, with which every benchmark of driving must fail.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from bench import SCRIPTS
from numpy.typing import NDArray

from nics_drl_bridge.commands import episodes
from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.task import Task, still
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import RobotView
from nics_drl_bridge.middleware.middleware import Middleware
from nics_drl_bridge.policy.file.stateful import Policy
from nics_drl_bridge.policy.policies import open_policy

AT_ONCE = 2


def evaluate_all(
    runs: Mapping[str, str],
    folder: Path,
    control: str | None = None,
    tell: Callable[[str, dict[str, Any]], None] = lambda *_: None,
) -> dict[str, dict[str, Any]]:
    """What `evaluation.json` says of the one policy of each run: place -> figures.

    Args:
        runs: a name -> what comes behind `nics evaluate`.
        folder: gets a folder for each run.
        control: `lying`, `standing`, or None.
        tell: hears the figures of each run at once.

    Raises:
        RuntimeError: one failed; its own words are in it.
    """
    program = "nics_drl_bridge.commands.cli"
    if control:
        program = f"measuring.evaluations {control}"
    known = filter(None, [str(SCRIPTS), os.environ.get("PYTHONPATH")])
    around = os.environ | {"PYTHONPATH": os.pathsep.join(known)}
    # Without a domain, the command takes one that nobody uses when it needs it.
    around.pop("ROS_DOMAIN_ID", None)

    def evaluate(name: str) -> dict[str, Any]:
        out = folder / name
        words = f"-m {program} evaluate {runs[name]} --out {out}".split()
        done = subprocess.run(
            [sys.executable, *words], env=around, capture_output=True, text=True
        )
        if done.returncode:
            raise RuntimeError(f"{' '.join(words)}: {done.stderr.strip()}")
        told = json.loads((out / "evaluation.json").read_text(encoding="utf-8"))
        (figures,) = told["policies"].values()
        tell(name, figures)
        return dict(figures)

    with ThreadPoolExecutor(AT_ONCE) as pool:
        return dict(zip(runs, pool.map(evaluate, runs), strict=True))


class Standing:
    """Stands still, whatever it sees.

    Args:
        task: of the robot.
    """

    def __init__(self, task: Task) -> None:
        low, high = task.command_limits
        share = (still(task.robot) - low) / (high - low)
        self._action = (2.0 * share - 1.0).astype(np.float32)

    def act(self, observation: NDArray[np.float32]) -> NDArray[Any]:
        """The same action for every observation (..., O)."""
        lead = observation.shape[:-1]
        return np.broadcast_to(self._action, (*lead, *self._action.shape)).copy()


def open_driver(
    name: str, model: SimulatorModel, control: str | None
) -> tuple[Policy, Task]:
    """Returns a policy by name and its task; under the control `standing` it stands still."""
    policy, task = open_policy(name, model)
    return (Standing(task) if control == "standing" else policy), task


def standing_action(env: gymnasium.Env[Any, Any]) -> NDArray[Any]:
    """The action of an env by which all its robots stand."""
    still_env: Any = env.unwrapped
    return np.tile(Standing(still_env.task).act(np.empty(0)), still_env.robots)


def lie() -> None:
    """From now on every robot tells that it is at the goal of the episode."""
    goals: list[NDArray[np.float64]] = []
    reset = BridgeEnv.reset
    view = Middleware.view

    def remembering(self: BridgeEnv, **given: Any) -> Any:
        goals.clear()
        began = reset(self, **given)
        assert self.scene is not None
        goals.append(self.scene.goals[0])
        return began

    def lying(self: Middleware, now_ns: int) -> RobotView:
        seen = view(self, now_ns)
        return (
            replace(seen, pose=np.array([*goals[0], seen.pose[2]])) if goals else seen
        )

    BridgeEnv.reset = remembering  # type: ignore[method-assign]
    Middleware.view = lying  # type: ignore[method-assign]


def stand() -> None:
    """From now on every policy stands still."""
    opened = episodes.open_policy

    def standing(*given: Any) -> Any:
        _, task = opened(*given)
        return Standing(task), task

    episodes.open_policy = standing  # type: ignore[assignment]


if __name__ == "__main__":
    from nics_drl_bridge.commands.cli import main

    {"lying": lie, "standing": stand}[sys.argv.pop(1)]()
    main()
