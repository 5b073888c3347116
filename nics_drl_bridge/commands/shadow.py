"""Shadow mode as the command line runs it: a table, a picture and JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from nics_drl_bridge.commands.episodes import robot_of
from nics_drl_bridge.files import write_bytes, write_text
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.policy.shadow import PERCENTILES, Shadow, shadow
from nics_drl_bridge.report.pictures import shadow_picture

HEADS = (
    "policy", "command", "unit", "mean", "mean size", *(f"{q} %" for q in PERCENTILES),
    "greatest", "opposite sign",
)  # fmt: skip


def evaluate_shadow(
    bag: str | Path,
    policy: str,
    model: str | None,
    topics: Mapping[str, str],
    goal: tuple[float, float] | None,
    ahead_s: float,
    out: str | Path,
) -> Shadow:
    """Compares a policy with a recorded drive, and writes `shadow_POLICY.png` and `.json`.

    Args:
        bag: the drive.
        policy: a file, or the name of a shipped policy or of a baseline.
        model: folder of a model or a shipped robot; None uses the policy's own robot.
        topics: role -> topic.
        goal: in `map` [m]; None uses the robot's position `ahead_s` later.
        ahead_s: see `goal` [s].
        out: output folder.

    Raises:
        BridgeError: see `policy.shadow.shadow`.
    """
    name = model or robot_of(policy)
    made = shadow(bag, open_model(name), policy, topics, goal, ahead_s)
    place = Path(out) / f"shadow_{Path(policy).stem}"
    write_bytes(place.with_suffix(".png"), shadow_picture(made))
    told = {
        "bag": str(bag),
        "policy": policy,
        "model": name,
        "goal": goal,
        "ahead_s": None if goal else ahead_s,
        "compared": len(made.time),
        "skipped": dict(made.skipped),
        "commands": made.differences(),
    }
    write_text(place.with_suffix(".json"), json.dumps(told) + "\n")
    return made


def rows_of(made: Mapping[str, Shadow]) -> list[tuple[str, ...]]:
    """Rows of the table with the columns `HEADS`, as text."""
    return [
        (policy, name, unit, *(f"{figures[key]:.3g}" for key in figures if key != "opposite"),
         f"{100 * figures['opposite']:.1f} %")
        for policy, one in made.items()
        for (name, figures), unit in zip(one.differences().items(), one.units, strict=True)
    ]  # fmt: skip
