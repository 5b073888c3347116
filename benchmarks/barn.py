"""How well is a robot driven through worlds that others made, among which teams are compared?

A Jackal drives 10 m between cylinders, without a map, in the 250 public worlds of the challenge
BARN (`nics_drl_bridge.sim.barn`). A run's score is the challenge's: success by
T* / clip(T, 2 T*, 8 T*), where T* is the time that the shortest path takes at 2 m/s; 0.5 is the
most. Success, collision and time are those of the simulator's true pose and contacts.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from bench import answer, parser_of
from measuring.standing import Standing
from numpy.typing import NDArray

from nics_drl_bridge.commands.conditions import Conditions
from nics_drl_bridge.commands.episodes import FAST, MUJOCO, drive_in
from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.env.teaching import Teaching
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import BridgeError, ConfigError
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.policy.evaluation import DRIFT_M, drive_worlds
from nics_drl_bridge.policy.file.stateful import Policy
from nics_drl_bridge.policy.policies import POLICIES, open_policy
from nics_drl_bridge.policy.train.run import POLICY, TrainOrder, run
from nics_drl_bridge.policy.train.settings import load_training
from nics_drl_bridge.sim import barn
from nics_drl_bridge.sim.scenes import member_of
from nics_drl_bridge.sim.world import World
from nics_drl_bridge.sim.world_set import BARN, AnyWorld, WorldSet, load_worlds

CONTROLS = {"standing": "the driving: the robot stands still"}
ROBOT = "jackal"
BARS = {
    "fast": {"success": 0.95, "collision": 0.02, "score": 0.45},
    "mujoco_dds": {"score": 0.40},
}
TRAINING_BAR_S = 600.0  # of one policy, on two cores
SPEED, GOAL_RADIUS, TIME_OUT_S = 2.0, 1.0, 100.0
"""[m/s], [m], [s]: of the challenge."""
OPTIONS = {"goal_radius": GOAL_RADIUS - DRIFT_M, "contact_margin": -1.0}
"""An episode ends where the truth, too, is near enough to the goal, and at true contacts alone."""
FIRST_SEED = 1_000_000
FOLDS = 5
EVERY = 10
"""In MuJoCo every tenth world is driven, in real time or slower."""
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Course:
    """A world and the length of its shortest path, from start to goal [m]."""

    world: World
    length: float

    @property
    def best_s(self) -> float:
        """T*, the time that the shortest path takes at full speed [s]."""
        return self.length / SPEED


@dataclass(frozen=True)
class Runs:
    """Runs of one policy (R,), each in one of the courses, by its number."""

    numbers: NDArray[np.int64]
    success: NDArray[np.bool_]
    believed: NDArray[np.bool_]
    collision: NDArray[np.bool_]
    time_s: Array
    score: Array

    def figures(self) -> dict[str, float | None]:
        """Shares, and the mean time of the successful runs."""
        time = self.time_s[self.success]
        return {
            "success": float(self.success.mean()),
            "believed": float(self.believed.mean()),
            "collision": float(self.collision.mean()),
            "time_out": float((~self.success & ~self.collision).mean()),
            "time_s": float(time.mean()) if len(time) else None,
            "score": float(self.score.mean()),
        }


def length_of(path: Array) -> float:
    """Length of a path (P, 2) from the start to the goal [m]."""
    whole = np.concatenate([[barn.START[:2]], path, [barn.GOAL]])
    return float(np.linalg.norm(np.diff(whole, axis=0), axis=1).sum())


def courses(every: int = 1) -> dict[int, Course]:
    """One in so many courses, by number."""
    return {
        number: Course(barn.barn_world(number), length_of(barn.barn_path(number)))
        for number in barn.barn_numbers()[::every]
    }


def seeds_of(world: AnyWorld, runs: int) -> NDArray[np.int64]:
    """Seeds (P * runs,) of episodes, of which `runs` are in each world, one world after another."""
    found: dict[int, list[int]] = defaultdict(list)
    seed = FIRST_SEED
    while sum(map(len, found.values())) < runs * len(world.members):
        member = member_of(world, seed)
        if len(found[member]) < runs:
            found[member].append(seed)
        seed += 1
    return np.array([found[p] for p in range(len(world.members))]).ravel()


def judged(
    given: Mapping[int, Course],
    runs: int,
    flags: Sequence[Sequence[bool]],
    time_s: Sequence[float],
) -> Runs:
    """Scores the runs in each of the courses, one course after another.

    Flags are those of `Runs`: success, what the robot believed, and collision.
    """
    numbers = np.repeat(list(given), runs)
    best = np.repeat([course.best_s for course in given.values()], runs)
    score = np.asarray(flags[0]) * best / np.clip(time_s, 2.0 * best, 8.0 * best)
    return Runs(
        numbers, *np.asarray(flags, np.bool_), np.asarray(time_s, np.float64), score
    )


def drive_fast(
    name: str, given: Mapping[int, Course], runs: int, control: str | None
) -> Runs:
    """Drives in the fast simulator, all worlds side by side."""
    model = open_model(ROBOT)
    policy, task = opened(name, control)
    world = WorldSet("courses", tuple(course.world for course in given.values()))
    seeds = seeds_of(world, runs)
    steps = round(TIME_OUT_S / model.control_period)
    env = BridgeVectorEnv(len(seeds), model, world, task, max_episode_steps=steps)
    env.teach(Teaching(contact=0.0))  # which ends an episode at a true contact
    out = drive_worlds(env, policy.act, seeds.tolist())
    flags = out.success, out.believed, out.collision
    return judged(given, runs, flags, out.steps * model.control_period)


def opened(name: str, control: str | None) -> tuple[Policy, Navigation]:
    """A policy and its task, with `OPTIONS`."""
    policy, task = open_policy(name, open_model(ROBOT))
    if control == "standing":
        policy = Standing(task)
    return policy, replace(task, **OPTIONS)


def drive_folds(
    settings: str,
    given: Mapping[int, Course],
    runs: int,
    control: str | None,
    folds: int = FOLDS,
) -> tuple[Runs, float]:
    """Learns policies, each from the other worlds than those that it then drives in.

    Returns the runs, and the time of the longest training [s].
    """
    chosen = load_training(settings)
    driven = []
    longest_s = 0.0
    if BARN not in chosen.worlds:
        raise ConfigError(
            f"{settings}: --five-fold replaces the world {BARN!r}, which it lacks."
        )
    if len(numbers := list(given)) < FOLDS:
        raise ConfigError(
            f"--five-fold needs {FOLDS} worlds, not {len(numbers)}; name more."
        )
    for fold in range(folds):
        held = {number: given[number] for number in numbers[fold::FOLDS]}
        with tempfile.TemporaryDirectory() as folder:
            rest = {n: course for n, course in given.items() if n not in held}
            worlds = {
                saved(rest, Path(folder, "worlds")) if world == BARN else world: copies
                for world, copies in chosen.worlds.items()
            }
            order = TrainOrder(
                chosen.model_copy(update={"worlds": worlds}),
                (fold,),
                Path(folder, "run"),
                1,
            )
            longest_s = max(longest_s, *(one.trained.wall_s for one in run(order)))
            policy = str(order.out / f"seed_{fold}" / POLICY)
            driven.append(drive_fast(policy, held, runs, control))
    parts = zip(*(vars(one).values() for one in driven), strict=True)
    return Runs(*(np.concatenate(part) for part in parts)), longest_s


def saved(given: Mapping[int, Course], folder: Path) -> str:
    """Writes the worlds into a folder; returns its name."""
    folder.mkdir()
    for number, course in given.items():
        text = dump_yaml(course.world.model_dump(mode="json", exclude_none=True))
        Path(folder, f"{number:04d}.yaml").write_text(text)
    return str(folder)


def drive_mujoco(name: str, given: Mapping[int, Course]) -> Runs:
    """Drives in MuJoCo over DDS, one world after the other."""
    model = open_model(ROBOT)
    with tempfile.TemporaryDirectory() as folder:
        worlds = saved(given, Path(folder, "worlds"))
        seeds = seeds_of(load_worlds(worlds), 1).tolist()
        conditions = Conditions(
            steps=round(TIME_OUT_S / model.control_period), task=OPTIONS
        )
        told = Path(folder), lambda _: None
        episodes = drive_in(
            MUJOCO, name, ROBOT, worlds, seeds, *told, conditions=conditions
        )
    results = np.array([one.result for one in episodes])
    believed = [one.believed_success for one in episodes]
    flags = results == "success", believed, results == "collision"
    return judged(
        given, 1, flags, [model.control_period * one.steps for one in episodes]
    )


def missed(
    place: str, figures: Mapping[str, Any], policy: str, training_s: float | None = None
) -> list[str]:
    """A sentence for each bar that a policy missed, and its training, if there was one."""
    said = []
    for name, bar in BARS[place].items():
        value = figures[name]
        least = name != "collision"
        if not (value >= bar if least else value <= bar):
            said.append(f"{policy}: {name} {value:.3f}, bar {bar}")
    if training_s is not None and not training_s <= TRAINING_BAR_S:
        said.append(
            f"{policy}: a training took {training_s:.0f} s, bar {TRAINING_BAR_S:.0f} s"
        )
    return said


def main() -> None:
    """Prints a table, or one JSON object; ends with 1 when the first policy misses a bar."""
    parser = parser_of(__doc__, CONTROLS)
    parser.add_argument("--in", dest="place", choices=tuple(BARS), default=FAST)
    parser.add_argument(
        "--policy", nargs="+", help="files or names; the shipped one, and planners"
    )
    parser.add_argument(
        "--five-fold",
        metavar="SETTINGS",
        nargs="?",
        const=f"shipped_{ROBOT}",
        help="learn from four fifths of the worlds, judge in the others",
    )
    parser.add_argument("--runs", type=int, default=1, help="in each world")
    parser.add_argument("--every", type=int, help="one in so many worlds")
    parser.add_argument("--folds", type=int, default=FOLDS, choices=range(1, FOLDS + 1))
    given = parser.parse_args()
    if given.place != FAST and (given.control or given.five_fold):
        parser.error(
            "a control stands, and --five-fold learns, in fast alone; leave out --in"
        )
    try:
        runs, training_s = driven(given)
    except BridgeError as error:
        parser.error(str(error))
    figures = {name: one.figures() for name, one in runs.items()}
    policy, first = next(iter(figures.items()))
    result = {**first, "policy": policy, "policies": figures, "training_s": training_s}
    said = missed(given.place, first, policy, training_s)
    answer(result, said, given.json)


def driven(given: argparse.Namespace) -> tuple[dict[str, Runs], float | None]:
    """The runs of each policy, and how long one was learnt for it, if any was [s]."""
    every = given.every or (1 if given.place == FAST else EVERY)
    found = courses(every)
    if given.five_fold:
        runs, training_s = drive_folds(
            given.five_fold, found, given.runs, given.control, given.folds
        )
        return {given.five_fold: runs}, training_s
    policies = given.policy or [ROBOT, *(name for name in POLICIES if name != "random")]
    if given.place == FAST:
        return {
            n: drive_fast(n, found, given.runs, given.control) for n in policies
        }, None
    return {name: drive_mujoco(name, found) for name in policies}, None


if __name__ == "__main__":
    main()
