"""Policies: how long they take to learn, where they still drive, and how well beside planners.

python benchmarks/policies.py training | baselines | barn
python benchmarks/policies.py transfer | robustness
"""

import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from bench import (
    Bar,
    Bars,
    Benchmark,
    Control,
    Given,
    Result,
    at_least,
    at_most,
    run_benchmark,
    some_of,
)
from measuring import perturbations
from measuring.evaluations import evaluate_all, open_driver
from measuring.perturbations import PERTURBATIONS
from numpy.typing import NDArray

from nics_drl_bridge.commands.episodes import (
    BY_DEFAULT,
    DART,
    DDS,
    FAST,
    LABELS,
    MUJOCO,
    NAVIGATION,
    PLACES,
    Conditions,
    drive_in,
)
from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.env.sim_backend import SimBackend
from nics_drl_bridge.env.teaching import Teaching
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import BridgeError, ConfigError
from nics_drl_bridge.gate.gated_backend import GatedBackend
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.policy.evaluation import (
    DRIFT_M,
    FIRST_SEED,
    Summary,
    drive_all,
    drive_worlds,
    successes,
    summarise,
)
from nics_drl_bridge.policy.policies import POLICIES, list_shipped_policies
from nics_drl_bridge.policy.train.settings import (
    TrainingSettings,
    load_training,
    open_training,
)
from nics_drl_bridge.robot.spec import load_robot
from nics_drl_bridge.sim import barn
from nics_drl_bridge.sim.scenes import member_of
from nics_drl_bridge.sim.simulator import EpisodeSampler
from nics_drl_bridge.sim.world import World, load_world
from nics_drl_bridge.sim.world_set import BARN, AnyWorld, WorldSet, load_worlds

ROBOTS = ("differential", "ackermann", "mecanum")
STANDS = Control("the driving: the policy stands still", "success")

# Learning

LEARNING_WORLD = "circles"
LONGEST_S = {"differential": 15.0, "ackermann": 45.0, "mecanum": 25.0}
LEARNING_BARS = {
    "success_rate": at_least(0.95, "success after training"),
    # The share of the time that goes to the simulator has no bar: it steps on one core while the
    # other learns.
    "steps_per_s": at_least(100_000.0, "environment steps per second of training"),
}


def shorten(settings: TrainingSettings) -> TrainingSettings:
    """Returns the same settings, but for one rollout only."""
    short = settings.ppo.rollout * settings.num_envs
    return settings.model_copy(update={"steps": short})


def learn(settings: TrainingSettings, seed: int, episodes: int) -> Result:
    """Trains with one seed and drives unseen episodes; returns the figures."""
    from nics_drl_bridge.policy.train.run import train

    model, worlds = open_training(settings)
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        trained = train(model, worlds, settings, seed, Path(folder))
    env = BridgeVectorEnv(
        episodes,
        model,
        LEARNING_WORLD,
        settings.task,
        settings.task_options,
        settings.max_episode_steps,
    )
    outcomes = drive_worlds(env, trained.act, range(FIRST_SEED, FIRST_SEED + episodes))
    wall_s = time.perf_counter() - begin
    told = summarise(outcomes, model.control_period)
    return {
        "success_rate": told.success.value,
        "success_95ci": [told.success.low, told.success.high],
        "believed_rate": told.believed.value,
        "collision_rate": told.collision.value,
        "wall_s": wall_s,
        "env_steps": trained.steps,
        "steps_per_s": trained.steps / trained.wall_s,
    }


def measure_training(given: Given) -> Result:
    """How long does it take to learn to navigate, from nothing?

    Trains a shipped robot among ten random obstacles with the shipped settings, then drives unseen
    episodes there. Wall time counts from the first random weight to the last evaluated episode;
    the kernels are compiled before. Of several seeds, the figures are of the one with the least
    success, with the longest time and the lowest speed of all. `--lidar` learns and drives with
    another than the robot's, as `rplidar_a2`, by the same bars.
    """
    settings = load_training(f"navigation_{given.robot}")
    settings = settings.model_copy(update={"lidar": given.lidar or settings.lidar})
    if given.control == "untrained":
        settings = shorten(settings)
    else:
        learn(shorten(settings), 0, min(given.episodes, 20))  # compiles, fills caches
    runs = [learn(settings, seed, given.episodes) for seed in given.seeds]
    worst = min(runs, key=lambda one: one["success_rate"])
    longest = {name: max(one[name] for one in runs) for name in ("wall_s", "env_steps")}
    slowest = min(one["steps_per_s"] for one in runs)
    return {**worst, **longest, "steps_per_s": slowest, "robot": given.robot}


def set_training_bars(result: Result) -> Bars:
    return LEARNING_BARS | {"wall_s": at_most(LONGEST_S[result["robot"]])}


# Planners and shipped policies

FLOORS = {"dynamic_window": 0.7, "mppi": 0.7, "straight": 0.05}
FLOORS |= dict.fromkeys(ROBOTS, 0.8)  # shipped policies go by the names of their robots
DRIVING = (*ROBOTS, "dynamic_window", "mppi")
LEAST_PATH_M = 1.0


def drive_episodes(
    robot: str, name: str, world: str, episodes: int, control: str | None
) -> Summary:
    """Drives by a policy of that name, in a world."""
    model = open_model(robot)
    policy, task = open_driver(name, model, control)
    env = BridgeVectorEnv(episodes, model, world, task)
    seeds = range(FIRST_SEED, FIRST_SEED + episodes)
    return summarise(drive_worlds(env, policy.act, seeds), model.control_period)


def measure_baselines(given: Given) -> Result:
    """How well do policies that need no training navigate, beside those that come trained?

    Every policy by name, and the shipped policy file of each robot if there is one, drives the
    same unseen episodes: the evaluation protocol of `nics train`.
    """
    figures = {}
    for world, robot in product(given.world, given.robot):
        own = [robot] if robot in list_shipped_policies() else []
        for name in [*own, *given.policy]:
            summary = drive_episodes(robot, name, world, given.episodes, given.control)
            figures[f"{world}/{robot}/{name}"] = asdict(summary)
    return figures


def set_baseline_bars(result: Result) -> Bars:
    bars = {}
    for place in result:
        world, _, name = place.split("/")
        floor = FLOORS.get(name, 0.0) if world == LEARNING_WORLD else 0.0
        bars[place] = {"success": {"value": at_least(floor)}}
        if name in DRIVING:
            bars[place]["length"] = {"value": at_least(LEAST_PATH_M, "path [m]")}
    return bars


# BARN

BARN_ROBOT = "jackal"
BARN_BARS = {
    FAST: {
        "success": at_least(0.95),
        "collision": at_most(0.02),
        "score": at_least(0.45),
    },
    MUJOCO: {"score": at_least(0.40)},
}
TRAINING_S = at_most(600.0, "a training, on two cores, took [s]")
SPEED = 2.0  # of the challenge [m/s]
GOAL_RADIUS = 1.0  # of the challenge [m]
TIME_OUT_S = 100.0  # of the challenge
# An episode ends where the truth, too, is near enough to the goal, and at true contacts alone.
OPTIONS = {"goal_radius": GOAL_RADIUS - DRIFT_M, "contact_margin": -1.0}
FOLDS = 5
EVERY = 10  # in MuJoCo every tenth world is driven, in real time or slower


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
class BarnRuns:
    """Runs of one policy (R,), each in one of the courses."""

    success: NDArray[np.bool_]
    believed: NDArray[np.bool_]
    collision: NDArray[np.bool_]
    time_s: Array
    score: Array

    def describe(self) -> dict[str, float | None]:
        """Returns shares, and the mean time of the successful runs."""
        times = self.time_s[self.success]
        return {
            "success": float(self.success.mean()),
            "believed": float(self.believed.mean()),
            "collision": float(self.collision.mean()),
            "time_out": float((~self.success & ~self.collision).mean()),
            "time_s": float(times.mean()) if len(times) else None,
            "score": float(self.score.mean()),
        }


Courses = Mapping[int, Course]


def list_courses(every: int = 1) -> dict[int, Course]:
    """Returns one in so many courses, by number."""
    courses = {}
    for number in barn.barn_numbers()[::every]:
        path = [barn.START[:2], *barn.barn_path(number), barn.GOAL]
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        courses[number] = Course(barn.barn_world(number), float(length))
    return courses


def find_seeds(world: AnyWorld, runs: int) -> NDArray[np.int64]:
    """Finds seeds (P * runs,) of episodes, of which `runs` are in each world, one after another."""
    found: dict[int, list[int]] = defaultdict(list)
    seed = FIRST_SEED
    while sum(map(len, found.values())) < runs * len(world.members):
        member = member_of(world, seed)
        if len(found[member]) < runs:
            found[member].append(seed)
        seed += 1
    return np.array([found[p] for p in range(len(world.members))]).ravel()


def score_runs(
    courses: Courses,
    runs: int,
    flags: Sequence[Sequence[bool]],
    time_s: Sequence[float],
) -> BarnRuns:
    """Scores the runs in each of the courses, one course after another.

    Flags are those of `BarnRuns`: success, what the robot believed, and collision.
    """
    best = np.repeat([course.best_s for course in courses.values()], runs)
    score = np.asarray(flags[0]) * best / np.clip(time_s, 2.0 * best, 8.0 * best)
    return BarnRuns(*np.asarray(flags, np.bool_), np.asarray(time_s, np.float64), score)


def drive_fast(
    name: str, courses: Courses, runs: int, control: str | None = None
) -> BarnRuns:
    """Drives in the fast simulator, all worlds side by side."""
    model = open_model(BARN_ROBOT)
    policy, task = open_driver(name, model, control)
    task = replace(task, **OPTIONS)
    world = WorldSet("courses", tuple(course.world for course in courses.values()))
    seeds = find_seeds(world, runs)
    steps = round(TIME_OUT_S / model.control_period)
    env = BridgeVectorEnv(len(seeds), model, world, task, max_episode_steps=steps)
    env.teach(Teaching(contact=0.0))  # which ends an episode at a true contact
    out = drive_worlds(env, policy.act, seeds.tolist())
    flags = out.success, out.believed, out.collision
    return score_runs(courses, runs, flags, out.steps * model.control_period)


def drive_folds(
    settings: str, courses: Courses, runs: int, folds: int = FOLDS
) -> tuple[BarnRuns, float]:
    """Learns policies, each from the other worlds than those that it then drives in.

    Returns the runs, and the time of the longest training [s].
    """
    chosen = load_training(settings)
    if BARN not in chosen.worlds:
        raise ConfigError(
            f"{settings}: --five-fold replaces the world {BARN!r}, which it lacks."
        )
    if len(courses) < FOLDS:
        raise ConfigError(
            f"--five-fold needs {FOLDS} worlds, not {len(courses)}; name more."
        )
    from nics_drl_bridge.policy.train.run import POLICY, TrainOrder, run

    driven = []
    longest_s = 0.0
    for fold in range(folds):
        held = {number: courses[number] for number in list(courses)[fold::FOLDS]}
        with tempfile.TemporaryDirectory() as folder:
            rest = {n: course for n, course in courses.items() if n not in held}
            others = save_worlds(rest, Path(folder, "worlds"))
            worlds = {
                others if world == BARN else world: copies
                for world, copies in chosen.worlds.items()
            }
            learned = chosen.model_copy(update={"worlds": worlds})
            order = TrainOrder(learned, (fold,), Path(folder, "run"), 1)
            longest_s = max(longest_s, *(one.trained.wall_s for one in run(order)))
            policy = str(order.out / f"seed_{fold}" / POLICY)
            driven.append(drive_fast(policy, held, runs))
    parts = zip(*(vars(one).values() for one in driven), strict=True)
    return BarnRuns(*(np.concatenate(part) for part in parts)), longest_s


def save_worlds(courses: Courses, folder: Path) -> str:
    """Writes the worlds into a folder; returns its name."""
    folder.mkdir()
    for number, course in courses.items():
        text = dump_yaml(course.world.model_dump(mode="json", exclude_none=True))
        Path(folder, f"{number:04d}.yaml").write_text(text)
    return str(folder)


def drive_mujoco(name: str, courses: Courses) -> BarnRuns:
    """Drives in MuJoCo over DDS, one world after the other."""
    period = open_model(BARN_ROBOT).control_period
    conditions = Conditions(steps=round(TIME_OUT_S / period), task=OPTIONS)
    with tempfile.TemporaryDirectory() as folder:
        worlds = save_worlds(courses, Path(folder, "worlds"))
        seeds = find_seeds(load_worlds(worlds), 1).tolist()
        told = (Path(folder), lambda _: None)
        episodes = drive_in(
            MUJOCO, name, BARN_ROBOT, worlds, seeds, *told, conditions=conditions
        )
    results = np.array([one.result for one in episodes])
    believed = [one.believed_success for one in episodes]
    flags = results == "success", believed, results == "collision"
    return score_runs(courses, 1, flags, [period * one.steps for one in episodes])


def drive_courses(given: Given) -> tuple[dict[str, BarnRuns], float | None]:
    """Returns the runs of each policy, and how long one was learnt for it, if any was [s]."""
    fast = given.place == FAST
    if not fast and (given.control or given.five_fold):
        raise ConfigError(
            "a control stands, and --five-fold learns, in fast alone; leave out --in."
        )
    courses = list_courses(given.every or (1 if fast else EVERY))
    if given.five_fold:
        runs, training_s = drive_folds(
            given.five_fold, courses, given.runs, given.folds
        )
        return {given.five_fold: runs}, training_s
    names = given.policy or [BARN_ROBOT, *(one for one in POLICIES if one != "random")]
    if fast:
        return {
            name: drive_fast(name, courses, given.runs, given.control) for name in names
        }, None
    return {name: drive_mujoco(name, courses) for name in names}, None


def measure_barn(given: Given) -> Result:
    """How well is a robot driven through worlds that others made, among which teams are compared?

    A Jackal drives 10 m between cylinders, without a map, in the 250 public worlds of the
    challenge BARN (`nics_drl_bridge.sim.barn`). A run's score is the challenge's: success by
    T* / clip(T, 2 T*, 8 T*), where T* is the time that the shortest path takes at 2 m/s; 0.5 is
    the most. Success, collision and time are those of the simulator's true pose and contacts.
    """
    try:
        runs, training_s = drive_courses(given)
    except BridgeError as error:
        sys.stderr.write(f"{error}\n")
        raise SystemExit(2) from None
    figures = {name: one.describe() for name, one in runs.items()}
    policy, first = next(iter(figures.items()))
    about = {"policy": policy, "place": given.place, "training_s": training_s}
    return {**first, **about, "policies": figures}


def set_barn_bars(result: Result) -> Bars:
    bars = dict(BARN_BARS[result["place"]])
    if result["training_s"] is not None:
        bars["training_s"] = TRAINING_S
    return bars


# Transfer

TRANSFER_FLOORS = {
    **dict.fromkeys(("circles", "doorway", "arena", "empty"), 0.97),
    **dict.fromkeys(("clutter", "corridor", "crowd", "room"), 0.95),
}
"""Least success in process, by world: what fails everywhere alike has not been transferred."""
ROUNDING = 1e-9
BELIEVED = at_most(0.05 + ROUNDING, "successes to the robot alone")
APART = {
    place: Bar(-points - ROUNDING, points + ROUNDING, f"{LABELS[place]}: points off")
    for place, points in ((DDS, 2.0), (MUJOCO, 4.0), (DART, 4.0))
}
TRANSFER_LIDAR = "rplidar_a2"
TRANSFER_SEED = 2_000_000
Found = dict[str, dict[str, dict[str, Any]]]


def get_conditions(robot: str) -> str:
    """Returns those of a deployment: a real lidar, mild randomisation, the robot's limits."""
    lidar = "" if load_robot(robot).lidar else f"--lidar {TRANSFER_LIDAR} "
    return f"{lidar}--randomisation mild --gate {robot}"


def measure_transfer(given: Given) -> Result:
    """Does a policy drive as well where it was not trained, in every shipped world?

    The shipped policy of each robot, one file, drives the same episodes in three places: the fast
    simulator in process, the fast simulator over DDS, and the robot's machine in MuJoCo over DDS.
    The conditions are those of a deployment: a real lidar, mild randomisation, the gate and its
    shield. What counts is where the robot truly ended and whether it truly touched something; what
    the robot itself took for a success is told beside it. Two worlds are driven at a time, each in
    processes of its own. `--out` keeps the pictures of the trajectories, as the paper's Fig. 7.
    """

    def tell(name: str, figures: dict[str, Any]) -> None:
        shares = (
            f"{place} {100 * each['success'][0]:.1f} %"
            for place, each in figures.items()
        )
        sys.stderr.write(f"{name}: {', '.join(shares)}\n")

    places = " ".join(f"--in {place}" for place in given.places)
    about = f"--episodes {given.episodes} --seed {TRANSFER_SEED} {places}"
    runs = {
        f"{robot}/{world}": f"{robot} --model {robot} --world {world} {about} "
        + get_conditions(robot)
        for robot, world in product(given.robots, given.worlds)
    }
    found: Found = {robot: {} for robot in given.robots}
    with tempfile.TemporaryDirectory() as folder:
        out = given.out or Path(folder)
        evaluated = evaluate_all(runs, out, given.control, tell)
    for name, figures in evaluated.items():
        robot, world = name.split("/")
        found[robot][world] = figures
    return tabulate_transfer(found)


def tabulate_transfer(found: Found) -> Result:
    """Returns figure -> robot -> world -> place -> its value."""
    result: Result = defaultdict(lambda: defaultdict(dict))
    for robot, worlds in found.items():
        for world, places in worlds.items():
            values = {
                name: {place: each[name][0] for place, each in places.items()}
                for name in ("success", "collision", "believed", "length")
            }
            success = values["success"]
            values["alone"] = {
                place: each - success[place]
                for place, each in values["believed"].items()
            }
            values["points_from_fast"] = {
                place: round(100.0 * (each - success[FAST]), 3)
                for place, each in success.items()
                if place != FAST and FAST in success
            }
            for name, each in values.items():
                result[name][robot][world] = each
    return result


def set_transfer_bars(result: Result) -> Bars:
    bars: dict[str, Any] = {
        "alone": {"*": {"*": {"*": BELIEVED}}},
        "length": {"*": {"*": {"*": at_least(LEAST_PATH_M, "path [m]")}}},
        "success": {},
        "points_from_fast": {},
    }
    for robot, worlds in result["points_from_fast"].items():
        bars["points_from_fast"][robot] = {
            world: {place: APART[place] for place in places}
            for world, places in worlds.items()
        }
        bars["success"][robot] = {
            world: {FAST: at_least(TRANSFER_FLOORS[world] - ROUNDING)}
            for world, places in result["success"][robot].items()
            if FAST in places
        }
    return bars


# Robustness

MULTIPLES = (0.5, 1.0, 2.0)
DECLARED = 1.0
ROBUST_WORLDS = ("circles", "doorway", "clutter", "corridor", "crowd", "room")
ROBUST_SEED = 3_000_000
AT_ONCE = 2
TENFOLD = 10.0
ROBUST_BARS = {
    "unperturbed": {"*": at_least(0.95 - ROUNDING, "success without a perturbation")},
    # To one perturbation at its declared range.
    "lost_points": {"*": {"*": at_most(5.0 + ROUNDING)}},
}


@dataclass(frozen=True)
class Job:
    """The episodes of one policy in one world, with each perturbation at each of the multiples."""

    robot: str
    world: str
    episodes: int
    perturbations: tuple[str, ...]
    control: str | None


def count_reached(job: Job, perturbation: str | None, times: float) -> int:
    """Counts episodes that truly succeed under a perturbation, or none."""
    model = perturbations.open_real_model(job.robot)
    world = load_world(job.world)
    driver, task = open_driver(job.robot, model, job.control)
    times *= TENFOLD if job.control == "tenfold" else 1.0
    larger = perturbation == "footprint"
    drawn = None
    simulated = model
    if larger:
        simulated = perturbations.grow_footprint(
            model, 1.0 + times * perturbations.FOOTPRINT
        )
    elif perturbation is not None:
        whole = perturbations.load_declared(job.robot)
        noise = model.lidar.noise_std
        drawn = perturbations.single_out(whole, perturbation, times, noise)
    backend = SimBackend(simulated, world, estimator=True, randomisation=drawn)
    if larger:  # in the scenes of the robot that it is believed to be
        backend.simulator.episodes = EpisodeSampler(model, world)
    gated = GatedBackend(backend, model, job.robot)
    env = gymnasium.make(NAVIGATION, backend=gated, model=model, world=world, task=task)
    with closing(env):
        driven = drive_all(env, driver, range(ROBUST_SEED, ROBUST_SEED + job.episodes))
    return successes(driven)


def count_curves(job: Job) -> dict[str, NDArray[np.int64]]:
    """Counts under each perturbation (1 + multiples,), the first without any."""
    nothing = count_reached(job, None, 0.0)
    return {
        each: np.array([nothing, *(count_reached(job, each, k) for k in MULTIPLES)])
        for each in job.perturbations
    }


def measure_robustness(given: Given) -> Result:
    """How much success does a shipped policy lose to each perturbation alone?

    Each shipped policy drives the same episodes of several worlds without any perturbation, and
    with one of them at parts and multiples of its declared range: with the greatest value that the
    randomisation of its training draws. The footprint is no part of that, and time constants need
    not be; they are declared in measuring/perturbations.py. Lidar, gate, shield and estimator are
    those of a deployment, and know nothing of the perturbation; success is by the truth.
    """
    jobs = [
        Job(robot, world, given.episodes, tuple(given.only), given.control)
        for robot, world in product(given.robots, given.worlds)
    ]
    counts: dict[str, dict[str, Any]] = {
        robot: dict.fromkeys(given.only, 0) for robot in given.robots
    }
    with ProcessPoolExecutor(AT_ONCE, mp_context=get_context("spawn")) as pool:
        for job, found in zip(jobs, pool.map(count_curves, jobs), strict=True):
            sys.stderr.write(f"{job.robot} in {job.world}: {found}\n")
            for each, some in found.items():
                counts[job.robot][each] = counts[job.robot][each] + some
    episodes = given.episodes * len(given.worlds)
    success = {
        robot: {each: (some / episodes).tolist() for each, some in own.items()}
        for robot, own in counts.items()
    }
    return {
        "declared": {
            robot: perturbations.describe(perturbations.load_declared(robot))
            for robot in success
        },
        "success": success,
        "unperturbed": {
            robot: next(iter(own.values()))[0] for robot, own in success.items()
        },
        "lost_points": find_losses(success),
        "episodes": episodes,
    }


def find_losses(
    success: Mapping[str, Any],
) -> dict[str, dict[str, float]]:
    """Returns points of success lost at the declared range: robot -> perturbation -> value."""
    at = 1 + MULTIPLES.index(DECLARED)
    return {
        robot: {
            each: round(100.0 * (some[0] - some[at]), 3) for each, some in own.items()
        }
        for robot, own in success.items()
    }


SHIPPED = some_of(list_shipped_policies())
BENCHMARKS = {
    "training": Benchmark(
        measure_training,
        set_training_bars,
        {
            "untrained": Control(
                "the learning: a net that has learnt from a single rollout",
                "success after training",
                "--episodes 20",
            )
        },
        {
            "robot": {"choices": sorted(LONGEST_S), "default": "differential"},
            "lidar": {"help": "instead of the robot's own, a shipped one or a file"},
            "seeds": {"type": int, "nargs": "+", "default": [0]},
            "episodes": 500,
        },
        short=None,
        needs=("tensorboard",),
    ),
    "baselines": Benchmark(
        measure_baselines,
        set_baseline_bars,
        {"standing": STANDS},
        {
            "world": {"nargs": "+", "default": [LEARNING_WORLD]},
            "robot": some_of(ROBOTS),
            "policy": {"nargs": "+", "default": list(POLICIES)},
            "episodes": 500,
        },
        short="--robot differential --policy dynamic_window --episodes 20",
    ),
    "barn": Benchmark(
        measure_barn,
        set_barn_bars,
        {"standing": STANDS},
        {
            "in": {"dest": "place", "choices": tuple(BARN_BARS), "default": FAST},
            "policy": {"nargs": "+", "help": "files or names; by default the shipped"},
            "five-fold": {
                "metavar": "SETTINGS",
                "nargs": "?",
                "const": f"shipped_{BARN_ROBOT}",
                "help": "learn from four fifths of the worlds, judge in the others",
            },
            "runs": (1, "in each world"),
            "every": {"type": int, "help": "one in so many worlds"},
            "folds": {"type": int, "default": FOLDS, "choices": range(1, FOLDS + 1)},
        },
        short="--every 25 --policy jackal",
    ),
    "transfer": Benchmark(
        measure_transfer,
        set_transfer_bars,
        {
            "lying": Control("the truth: a robot says it is there", "the robot alone"),
            "standing": STANDS,
        },
        {
            "episodes": (100, "in each place"),
            "robots": SHIPPED,
            "worlds": some_of(tuple(TRANSFER_FLOORS)),
            "in": some_of(PLACES) | {"dest": "places", "default": list(BY_DEFAULT)},
            "out": {"type": Path, "help": "keep all files there, as trajectories"},
        },
        short="--episodes 1 --robots differential --worlds circles",
        unsettled=("",),
        needs=("rclpy", "mujoco"),
    ),
    "robustness": Benchmark(
        measure_robustness,
        ROBUST_BARS,
        {
            "tenfold": Control("the range: perturbations are ten times it", "drift"),
            "standing": STANDS,
        },
        {
            "episodes": (40, "in each world"),
            "robots": SHIPPED,
            "worlds": some_of(ROBUST_WORLDS),
            "only": some_of(PERTURBATIONS),
        },
        short="--episodes 2 --robots differential --worlds circles --only drift",
        unsettled=("",),
    ),
}

if __name__ == "__main__":
    run_benchmark(BENCHMARKS)
