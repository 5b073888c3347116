"""Runs of `nics evaluate`, each in a process of its own, two at a time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nics_drl_bridge.commands.episodes import NO_CONDITIONS, Conditions

BENCHMARKS = Path(__file__).resolve().parents[1]
AT_ONCE = 2


@dataclass(frozen=True)
class Run:
    """One evaluation: a policy, the robot, the world, how many episodes, the first seed.

    And a control, if it is to fail, see `deceived`; the conditions; and where, all by default.
    """

    policy: str
    robot: str
    world: str
    episodes: int
    seed: int
    out: Path
    control: str | None = None
    conditions: Conditions = NO_CONDITIONS
    places: Sequence[str] = ()


def evaluate_all(
    runs: Mapping[str, Run],
    tell: Callable[[str, dict[str, Any]], None] = lambda *_: None,
) -> dict[str, dict[str, Any]]:
    """What `evaluation.json` says of each run's policy: place -> figures; `tell` hears it at once.

    Raises:
        RuntimeError: one failed; its own words are in it.
    """
    with ThreadPoolExecutor(AT_ONCE) as pool:
        waiting = {name: pool.submit(_evaluate, run) for name, run in runs.items()}
        found = {}
        for name, future in waiting.items():
            found[name] = future.result()
            tell(name, found[name])
        return found


def _evaluate(run: Run) -> dict[str, Any]:
    words: Sequence[object] = (
        "evaluate",
        run.policy,
        "--model",
        run.robot,
        "--world",
        run.world,
        "--episodes",
        run.episodes,
        "--seed",
        run.seed,
        "--out",
        run.out,
        *(word for place in run.places for word in ("--in", place)),
        *(
            word
            for name in ("lidar", "randomisation", "gate")
            for word in (f"--{name}", getattr(run.conditions, name))
            if getattr(run.conditions, name) is not None
        ),
    )
    program = (
        ["measuring.deceived", run.control]
        if run.control
        else ["nics_drl_bridge.commands.cli"]
    )
    paths = os.pathsep.join(
        [str(BENCHMARKS), *filter(None, [os.environ.get("PYTHONPATH")])]
    )
    # Without a domain, the command takes one that nobody uses when it needs it.
    kept = {
        name: value for name, value in os.environ.items() if name != "ROS_DOMAIN_ID"
    }
    command = [sys.executable, "-m", *program, *map(str, words)]
    env = kept | {"PYTHONPATH": paths}
    done = subprocess.run(command, env=env, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"nics {' '.join(map(str, words))}: {done.stderr.strip()}")
    told = json.loads((run.out / "evaluation.json").read_text(encoding="utf-8"))
    figures: dict[str, Any] = told["policies"][run.policy]
    return figures
