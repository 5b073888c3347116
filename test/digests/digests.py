"""Figures of what the package computes, taken down once: a change of the house must keep them.

Each digest runs a part of the package on fixed seeds and keeps a few projections of all that came
out on fixed random signs, so that one number that changes shows. In `test`,
`PYTHONPATH=../benchmarks:campaigns python -m digests.digests NAME...` records them again, for a
change that is meant to change them.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from .behaviours import dynamic_window, estimates, training
from .projection import Found, projected
from .simulations import barn, scans, team

TEST = Path(__file__).resolve().parents[1]
FILE = Path(__file__).with_name("digests.json")
ROBOTS = ("ackermann", "differential", "mecanum")
WORLDS = {
    "ackermann": ("arena", "crowd"),
    "differential": ("clutter", "crowd"),
    "mecanum": ("arena", "room"),
}


def worlds() -> Found:
    """Bits of N worlds: the vector env of each robot, with and without randomisation."""
    from nics_drl_bridge.env.vector_env import BridgeVectorEnv

    found = {}
    for robot, names in WORLDS.items():
        for world in names:
            random = "strong" if world == "clutter" else None
            env = BridgeVectorEnv(
                6, robot, world, randomisation=random, max_episode_steps=40
            )
            seen, _ = env.reset(seed=5)
            rng = np.random.default_rng(1)
            rows = [seen.copy()]
            for _ in range(80):
                action = rng.uniform(-1.0, 1.0, env.action_space.shape).astype(
                    np.float32
                )
                seen, reward, ended, cut, _ = env.step(action)
                rows += [
                    seen.copy(),
                    reward,
                    ended,
                    cut,
                    env.simulator.data.pose.copy(),
                ]
            env.close()
            found[f"{robot} {world}"] = projected(
                np.concatenate([np.ravel(row) for row in rows])
            )
    return found


def single() -> Found:
    """The single env with the estimator of the nodes."""
    from nics_drl_bridge.env.bridge_env import BridgeEnv

    found = {}
    for robot in ROBOTS:
        env = BridgeEnv(backend="sim", model=robot, world="arena", estimator=True)
        seen, info = env.reset(seed=3)
        rng = np.random.default_rng(2)
        rows = [seen]
        for _ in range(60):
            action = rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)
            seen, reward, ended, cut, info = env.step(action)
            rows += [seen, reward, info["pose"]]
            if ended or cut:
                seen, info = env.reset()
        env.close()
        found[robot] = projected(np.concatenate([np.ravel(row) for row in rows]))
    return found


def table_1() -> Found:
    """What Table I fits: coefficients, terms kept and errors of the textbook robots."""
    import paper

    from nics_drl_bridge.identify.fit import fit

    found = {}
    for name in ROBOTS:
        robot = paper.make_subject(name)
        model = fit(paper.drive(robot, 0), robot.spec).model
        x = paper.drive(robot, 1).x
        apart = model.rates(x) * paper.DT - robot.twist(x) * paper.DT
        of_twist = np.sqrt((apart**2).mean(axis=0))
        of_pose = paper.find_errors(model, robot, 1)
        numbers = [model.coefficients.ravel(), of_pose, of_twist]
        found[name] = projected(np.concatenate(numbers))
    return found


def table_2() -> Found:
    """Errors of the baked scans of Table II, and the scans themselves."""
    import paper

    found = {}
    for name, shapes in paper.SCENES.items():
        baked = paper.bake(paper.SPEC, shapes, paper.DENSITY)
        drawn = paper.batches(shapes, 64)
        exact = [paper.scan(baked, "exact", batch) for batch in drawn]
        fast = [paper.scan(baked, "baked", batch) for batch in drawn]
        found[name] = projected(
            np.concatenate([np.ravel(each) for each in (*exact, *fast)])
        )
        found[f"{name} errors"] = [float(each) for each in paper.errors(fast, exact)]
    return found


def identified() -> Found:
    """Models identified from exact recordings, on trial and from all data."""
    from identify.drives import drive

    from nics_drl_bridge.identify.identify import identify
    from nics_drl_bridge.robot.spec import load_robot

    found = {}
    for robot in ROBOTS:
        spec = load_robot(robot)
        result = identify(drive(spec), spec, alpha=0.99)
        for each, of in ((result.trial, ""), (result, ", all data")):
            calibration = numbers_of(asdict(each.calibration))
            numbers = [*each.model.coefficients.ravel(), *calibration]
            found[f"{robot} clean{of}"] = projected(numbers)
    return found


def motion_state_terms() -> Found:
    """The terms that a model keeps whose state is the robot's own motion, by rate."""
    from measuring.foreign_robots import ROBOTS as FOREIGN
    from measuring.foreign_robots import foreign_drive

    from nics_drl_bridge.identify.identify import identify
    from nics_drl_bridge.recording.readers import open_drive

    drive = foreign_drive(FOREIGN["skid_steer"], 11, 8.0)
    with TemporaryDirectory() as folder:
        source = Path(folder) / "drive"
        spec, recording = open_drive(source, None, drive.write(source))
    terms = identify(recording, spec, alpha=0.99).model.named.terms
    return {rate: sorted(row) for rate, row in terms.items()}


def numbers_of(data: Any) -> list[float]:
    """Every number in nested data, by the order of the keys."""
    if isinstance(data, dict):
        return [number for key in sorted(data) for number in numbers_of(data[key])]
    if isinstance(data, list | tuple):
        return [number for each in data for number in numbers_of(each)]
    return [float(data)] if isinstance(data, int | float) else []


def gate() -> Found:
    """What the gate decides about adversaries, moment by moment, with its shipped shield.

    Each adversary drives one of the robots.
    """
    from nics_drl_bridge.gate.assurance import episodes
    from nics_drl_bridge.gate.assurance.adversaries import ADVERSARIES
    from nics_drl_bridge.gate.assurance.place import Job, Place
    from nics_drl_bridge.generator import builtin_model

    found = {}
    for index, robot in enumerate(ROBOTS):
        world = ("crowd", "clutter", "arena")[index]
        place = Place(builtin_model(robot), world)
        config = episodes.configure_gate(place.model, robot)
        decisions: list[float] = []
        for seed, kind in enumerate(ADVERSARIES):
            if seed % len(ROBOTS) == index:
                job = Job(kind, seed)
                episodes.drive(place, config, job, decisions_into(decisions))
        found[robot] = projected(decisions)
    return found


def decisions_into(kept: list[float]) -> Callable[[Any, float], None]:
    """Keeps what each decision says: the twist, the rule that stopped it, and the latch."""

    def keep(decision: Any, now: float) -> None:
        cause = decision.cause
        rule = "" if cause is None else cause.rule
        kept.extend([*decision.twist, float(sum(rule.encode()))])

    return keep


DIGESTS: dict[str, Callable[[], Found]] = {
    each.__name__: each
    for each in (
        worlds,
        single,
        table_1,
        table_2,
        identified,
        gate,
        motion_state_terms,
        barn,
        team,
        scans,
        dynamic_window,
        training,
        estimates,
    )
}
TOLERANCES = {"training": 1e-5}
"""Of digests whose bits differ between processors: of matrix products in single precision."""


def main() -> None:
    """Records digests again: those that are named, or all."""
    sys.path[:0] = [
        str(TEST),
        str(TEST / "campaigns"),
        str(TEST.parent / "benchmarks"),
    ]
    kept = json.loads(FILE.read_text()) if FILE.exists() else {}
    for name in sys.argv[1:] or DIGESTS:
        kept[name] = DIGESTS[name]()
    FILE.write_text(json.dumps(kept, indent=1) + "\n")


if __name__ == "__main__":
    main()
