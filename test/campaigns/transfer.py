"""Whether one policy drives as well in physics engines that nobody here wrote.

The shipped policy of each robot drives the same episodes, seed by seed, in the fast simulator and
in MuJoCo, DART and PyBullet: the same worlds, starts, goals, lidar, mild randomisation, gate and
shield, all in process. What counts is where the robot truly ended and whether it truly touched
something. Of two simulators, McNemar's test tells by the episodes that ended well in one of them
alone whether they differ by more than chance. PyBullet has a wheel for Python 3.11 alone:
`pip install pybullet==3.2.7`; without it, the other engines are compared.

`--out FILE` keeps the episodes of each engine ten at a time. A run that was interrupted or killed
goes on from there by the same command, and ends with the same figures.
"""

from __future__ import annotations

import signal
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from campaign import (
    Bar,
    Bars,
    Given,
    Result,
    at_least,
    at_most,
    run_campaign,
    some_of,
    tell,
)
from measuring.evaluations import Standing
from measuring.perturbations import open_real_model
from parts.book import Book, Row
from scipy import stats

from nics_drl_bridge.commands.episodes import Conditions, make_env
from nics_drl_bridge.confidence import estimate_rate
from nics_drl_bridge.env.sim_backend import SimBackend
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.gate.assurance.results import cluster_seeds
from nics_drl_bridge.gate.gated_backend import GatedBackend
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.policy.evaluation import drive
from nics_drl_bridge.policy.policies import list_shipped_policies, open_policy
from nics_drl_bridge.sim.randomisation import Randomisation, load_randomisation
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world_set import AnyWorld, load_worlds

FAST = "fast"
SIMULATORS = {
    "mujoco": "nics_drl_bridge.extras.mujoco.simulator",
    "dart": "nics_drl_bridge.extras.dart.simulator",
    "pybullet": "parts.pybullet_simulator",
}
ENGINES = (FAST, *SIMULATORS)
WORLDS = (
    "arena",
    "circles",
    "clutter",
    "corridor",
    "crowd",
    "doorway",
    "empty",
    "room",
)
RANDOMISATION = "mild"
FIRST_SEED = 4_000_000
BLOCK = 10  # episodes that one process drives before it tells
AT_ONCE = 2
ICE = 0.02  # friction of tyres on ice
FAST_SUCCESS = at_least(0.95, "success in the fast simulator")
APART = Bar(-3.0, 3.0, "points of success apart from the fast simulator")
COLLISIONS = at_most(0.01, "collisions")


@dataclass(frozen=True)
class Job:
    """Some episodes of a robot in an engine, and how they are driven."""

    robot: str
    engine: str
    seeds: list[int]
    worlds: list[str]
    randomisation: str
    control: str | None


def make_simulator(
    engine: str,
    model: SimulatorModel,
    world: AnyWorld,
    drawn: Randomisation | None = None,
    **physics: float,
) -> FastSimulator:
    """Returns an engine's world with one robot, of which some parameters of `Physics` differ.

    Raises ConfigError if the engine is not installed.
    """
    module = import_module(SIMULATORS[engine])
    changed = replace(module.PHYSICS, **physics)
    kind = getattr(module, f"{engine.capitalize()}Simulator")
    simulator: FastSimulator = kind(model, world, physics=changed, randomisation=drawn)
    return simulator


def find_missing(engine: str) -> str:
    """Returns why an engine can't be driven here; nothing if it can."""
    try:
        if engine in SIMULATORS:
            import_module(SIMULATORS[engine])
    except ConfigError as error:
        return str(error)
    return ""


def drive_job(job: Job) -> list[Row]:
    """Drives the episodes of a job; returns a row for each."""
    model = open_real_model(job.robot)
    world = load_worlds(job.worlds)
    drawn = load_randomisation(job.randomisation)
    backend = SimBackend(model, world, estimator=True, randomisation=drawn)
    if job.engine != FAST:
        floor = {"friction": ICE} if job.control == "ice" else {}
        backend.simulator = make_simulator(job.engine, model, world, drawn, **floor)
    gated = GatedBackend(backend, model, job.robot)
    env, policy = make_env(gated, job.robot, model, world, Conditions())
    if job.control == "standing":
        policy = Standing(open_policy(job.robot, model)[1])
    rows = []
    with closing(env):
        for seed in job.seeds:
            episode = drive(env, policy, seed)
            member = int(backend.simulator.data.member[0])
            row = {
                "robot": job.robot,
                "engine": job.engine,
                "seed": seed,
                "world": world.members[member].name,
                "result": episode.result,
                "believed": episode.believed,
            }
            rows.append(row)
    return rows


def key_of(row: Row) -> tuple[str, str, int]:
    """Returns what an episode is known by."""
    return row["robot"], row["engine"], row["seed"]


def plan_jobs(given: Given, engines: Sequence[str], book: Book) -> list[Job]:
    """Returns what is still to be driven, all engines of a block of seeds before the next."""
    end = FIRST_SEED + given.episodes
    driven = set(map(key_of, book.rows))
    jobs = []
    for first in range(FIRST_SEED, end, BLOCK):
        block = range(first, min(first + BLOCK, end))
        for robot, engine in product(given.robots, engines):
            seeds = [seed for seed in block if (robot, engine, seed) not in driven]
            if seeds:
                jobs.append(Job(robot, engine, seeds, **book.asked))
    return jobs


def find_engines(asked: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """Returns the engines that can be driven here, and why the others can't."""
    missing = {engine: find_missing(engine) for engine in asked}
    left_out = {engine: reason for engine, reason in missing.items() if reason}
    for engine, reason in left_out.items():
        tell(f"{engine} is left out: {reason}")
    return [engine for engine in asked if engine not in left_out], left_out


def drive_jobs(jobs: Sequence[Job], book: Book) -> None:
    """Drives jobs in processes of their own, and keeps their rows."""
    # Ctrl-C reaches the workers, too: by default, each would go on with the next job.
    stops = {"initializer": signal.signal, "initargs": (signal.SIGINT, signal.SIG_DFL)}
    spawn = get_context("spawn")
    with ProcessPoolExecutor(AT_ONCE, mp_context=spawn, **stops) as pool:
        pending = {pool.submit(drive_job, job): job for job in jobs}
        for count, done in enumerate(as_completed(pending), 1):
            job = pending[done]
            rows = done.result()
            book.add(rows)
            well = sum(row["result"] == "success" for row in rows)
            told = f"{job.robot} in {job.engine}: {well} of {len(rows)}"
            tell(f"{count} of {len(jobs)}: {told}")


def measure(given: Given) -> Result:
    """Drives all episodes that are not in the file yet, and compares the engines."""
    engines, left_out = find_engines(given.engines)
    asked = ("worlds", "randomisation", "control")
    book = Book(given.out, {name: getattr(given, name) for name in asked})
    try:
        drive_jobs(plan_jobs(given, engines, book), book)
    except KeyboardInterrupt:
        raise SystemExit("interrupted; with --out, the same command goes on") from None
    rows = sorted(book.rows, key=key_of)  # whichever was driven first
    return {
        "clusters": find_clusters(rows),
        "left_out": left_out,
        "engines": compare_engines(rows, given.robots, engines),
    }


def find_clusters(rows: Sequence[Row]) -> list[Row]:
    """Returns the failures by robot, engine, world and end, the largest cluster first."""
    ended = {key_of(row): row["result"] for row in rows}
    failed = [
        ((row["robot"], row["engine"], row["world"], row["result"]), row["seed"])
        for row in rows
        if row["result"] != "success"
    ]
    return [
        {
            "robot": robot,
            "engine": engine,
            "world": world,
            "result": result,
            "failures": len(seeds),
            "not_in_fast": sum(ended.get((robot, FAST, s)) == "success" for s in seeds),
            "seeds": seeds,
        }
        for (robot, engine, world, result), seeds in cluster_seeds(failed)
    ]


def compare_engines(
    rows: Sequence[Row], robots: Sequence[str], engines: Sequence[str]
) -> dict[str, dict[str, Row]]:
    """Returns robot -> engine -> figures of the episodes that all engines have driven."""
    ended: dict[tuple[str, str], dict[int, Row]] = defaultdict(dict)
    for row in rows:
        ended[row["robot"], row["engine"]][row["seed"]] = row
    compared: dict[str, dict[str, Row]] = {robot: {} for robot in robots}
    for robot, engine in product(robots, engines):
        driven = [set(ended[robot, each]) for each in engines]
        seeds = sorted(set.intersection(*driven))
        own = [ended[robot, engine][seed] for seed in seeds]
        success = [row["result"] == "success" for row in own]
        hits = sum(row["result"] == "collision" for row in own)
        figures = {
            "episodes": len(own),
            "success": asdict(estimate_rate(sum(success), len(own))),
            "collision": asdict(estimate_rate(hits, len(own))),
            "believed": sum(row["believed"] == "success" for row in own),
        }
        if FAST in engines and engine != FAST:
            fast = [ended[robot, FAST][seed]["result"] == "success" for seed in seeds]
            figures |= compare_pairs(fast, success)
        compared[robot][engine] = figures
    return compared


def compare_pairs(first: Sequence[bool], second: Sequence[bool]) -> dict[str, float]:
    """Compares the successes of the same episodes by McNemar's exact test (1947)."""
    pairs = list(zip(first, second, strict=True))
    lost = sum(before and not after for before, after in pairs)
    gained = sum(after and not before for before, after in pairs)
    # If chance alone decides, each of the unequal pairs is lost or gained like a coin toss.
    p = stats.binomtest(lost, lost + gained).pvalue if lost + gained else 1.0
    points = 100.0 * (gained - lost) / max(len(pairs), 1)
    return {"points": points, "lost": lost, "gained": gained, "p": float(p)}


def set_bars(result: Result) -> Bars:
    bars: dict[str, Any] = {robot: {} for robot in result["engines"]}
    for robot, engines in result["engines"].items():
        for engine, told in engines.items():
            own = bars[robot][engine] = {"collision": {"value": COLLISIONS}}
            if engine == FAST:
                own["success"] = {"value": FAST_SUCCESS}
            elif "points" in told:
                own["points"] = APART
    return {"engines": bars}


def split_engines(words: str) -> list[str]:
    """Returns engines that are named with commas between them."""
    names = words.split(",")
    unknown = [name for name in names if name not in ENGINES]
    if unknown:
        raise ValueError(f"no engine {unknown[0]!r}; there are {', '.join(ENGINES)}")
    return names


OPTIONS = {
    "engines": {
        "type": split_engines,
        "default": list(ENGINES),
        "help": "with commas between them; those that are not installed are left out",
    },
    "episodes": (200, "of each robot in each engine"),
    "robots": some_of(list_shipped_policies()),
    "worlds": some_of(WORLDS),
    "randomisation": (RANDOMISATION, "of each episode"),
    "out": {"type": Path, "help": "keep the episodes there, and go on with it"},
}

if __name__ == "__main__":
    run_campaign(measure, set_bars, OPTIONS)
