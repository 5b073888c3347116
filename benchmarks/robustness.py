"""How much success does a shipped policy lose to each perturbation alone?

Each shipped policy drives the same episodes of several worlds without any perturbation, and with
one of them at parts and multiples of its declared range: with the greatest value that the
randomisation of its training draws. The footprint is no part of that, and time constants need not
be; they are declared here. Lidar, gate, shield and estimator are those of a deployment, and know
nothing of the perturbation; success is by the truth, and told beside what the robots believed.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import cycle, product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from bench import answer, parser_of
from measuring.standing import Standing

from nics_drl_bridge import style
from nics_drl_bridge.commands.episodes import NAVIGATION
from nics_drl_bridge.env.sim_backend import SimBackend
from nics_drl_bridge.files import write_bytes
from nics_drl_bridge.gate.gated_backend import GatedBackend
from nics_drl_bridge.generator import SimulatorModel, open_model
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.policy.evaluation import drive_all, successes
from nics_drl_bridge.policy.policies import open_policy, shipped_policies
from nics_drl_bridge.policy.train.settings import load_training
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim.randomisation import Randomisation, load_randomisation
from nics_drl_bridge.sim.simulator import EpisodeSampler
from nics_drl_bridge.sim.world import load_world

CONTROLS = {
    "tenfold": "the declared range: perturbations are ten times as large as told",
    "standing": "a policy that stands still",
}
PERTURBATIONS = ("noise", "drop-out", "latency", "response", "drift", "footprint")
MULTIPLES = (0.5, 1.0, 2.0)
DECLARED = 1.0
LIDAR, SETTINGS = "rplidar_a2", "shipped_{}"
"""Of a robot that has no lidar of its own; and the settings by which its policy was trained."""
FOOTPRINT, RESPONSE = 0.05, 1.25
"""How much larger the outline is than the policy and the gate believe, as a share of it; and how
many times as long the time constants are at least."""
FLOOR, MOST_LOSS = 0.95, 5.0
"""Least mean success without a perturbation; most points lost to one at its declared range."""
WORLDS = ("circles", "doorway", "clutter", "corridor", "crowd", "room")
FIRST_SEED = 3_000_000
AT_ONCE = 2
TENFOLD = 10.0


@dataclass(frozen=True)
class Job:
    """The episodes of one policy in one world, with each perturbation at each of the multiples."""

    robot: str
    world: str
    episodes: int
    perturbations: tuple[str, ...]
    multiples: tuple[float, ...]
    control: str | None


def of_training(robot: str) -> Randomisation:
    """The randomisation by which the shipped policy of a robot was trained."""
    name = load_training(SETTINGS.format(robot)).randomisation
    return Randomisation(name="none") if name is None else load_randomisation(name)


def ranges(
    whole: Randomisation, perturbation: str, times: float, lidar_noise: float = 0.0
) -> Randomisation:
    """One perturbation alone, with the greatest declared value `times` as large in each episode.

    Args:
        whole: the declared ranges.
        perturbation: one of `PERTURBATIONS`.
        times: multiple of the declared range.
        lidar_noise: that the lidar has anyway [m], below which its noise does not fall.
    """
    given: dict[str, Any] = {"name": f"{perturbation} x {times:g}"}

    def most(group: Any, names: Sequence[str]) -> dict[str, tuple[float, float]]:
        spans = {name: getattr(group, name) for name in names}
        return {name: (times * span[1],) * 2 for name, span in spans.items() if span}

    if perturbation == "noise":
        given["lidar"] = most(whole.lidar, ["noise_std", "noise_proportional"])
        std = given["lidar"].get("noise_std", (0.0, 0.0))
        given["lidar"]["noise_std"] = tuple(max(end, lidar_noise) for end in std)
    elif perturbation == "drop-out":
        lost = most(whole.lidar, ["dropout", "dropout_far"])
        given["lidar"] = {
            name: (min(span[0], 1.0 / len(lost)),) * 2 for name, span in lost.items()
        }
    elif perturbation == "latency":
        given |= most(whole, ["action_latency", "observation_latency"])
    elif perturbation == "response":
        kinematics = whole.kinematics
        low, high = (1.0 + times * (end - 1.0) for end in kinematics.scale)
        slow = 1.0 + times * (max(kinematics.response[1], RESPONSE) - 1.0)
        given["kinematics"] = {
            "scale": (max(low, 0.05), high),
            "response": (slow, slow),
        }
    elif perturbation == "drift":
        levels = ["odom_linear", "odom_angular", "position_drift", "heading_drift"]
        given["odometry"] = most(whole.odometry, levels)
    return Randomisation.model_validate(given)


def grown(model: SimulatorModel, factor: float) -> SimulatorModel:
    """The model of a robot with a footprint that is larger by a factor."""
    robot = model.robot
    data = robot.model_dump(exclude={"footprint", "footprint_radius"})
    if robot.footprint is None:
        data["footprint_radius"] = factor * robot.footprint_radius
    else:
        data["footprint"] = (factor * np.array(robot.footprint)).tolist()
    return replace(model, robot=RobotSpec.model_validate(data))


def declared(whole: Randomisation) -> dict[str, str]:
    """The greatest value of each perturbation, in words."""
    late = whole.action_latency[1]
    seen = whole.observation_latency[1]
    kinematics = whole.kinematics
    odometry = whole.odometry
    lidar = whole.lidar
    drift = odometry.position_drift or (0.0, 0.0), odometry.heading_drift or (0.0, 0.0)
    return {
        "noise": f"{1000 * (lidar.noise_std or (0.0, 0.0))[1]:g} mm on each range",
        "drop-out": f"{100 * (lidar.dropout or (0.0, 0.0))[1]:g} % of the beams",
        "latency": f"{late:g} + {seen:g} control periods",
        "response": f"time constants x {max(kinematics.response[1], RESPONSE):g}, coefficients "
        f"x {kinematics.scale[0]:g} to {kinematics.scale[1]:g}",
        "drift": f"{100 * drift[0][1]:g} cm and {drift[1][1]:g} rad per root second",
        "footprint": f"{100 * FOOTPRINT:g} % larger than believed",
    }


def real_model(robot: str) -> SimulatorModel:
    """The model of a shipped robot with a real lidar: its own, or `LIDAR`."""
    model = open_model(robot)
    if model.robot.lidar is not None:
        return model
    lidar = load_lidar(LIDAR)
    return replace(model, lidar=lidar, table=bake(lidar, model.table.shapes))


def reached(job: Job, perturbation: str | None, times: float) -> tuple[int, int]:
    """How many episodes of a job succeed under a perturbation, or none, truly and to the robot."""
    model = real_model(job.robot)
    world = load_world(job.world)
    policy, task = open_policy(job.robot, model)
    driver = Standing(task) if job.control == "standing" else policy
    times *= TENFOLD if job.control == "tenfold" else 1.0
    simulated = model
    drawn = None
    if perturbation == "footprint":
        simulated = grown(model, 1.0 + times * FOOTPRINT)
    elif perturbation is not None:
        drawn = ranges(
            of_training(job.robot), perturbation, times, model.lidar.noise_std
        )
    backend = SimBackend(simulated, world, estimator=True, randomisation=drawn)
    if (
        perturbation == "footprint"
    ):  # in the scenes of the robot that it is believed to be
        backend.simulator.episodes = EpisodeSampler(model, world)
    gated = GatedBackend(backend, model, job.robot)
    env = gymnasium.make(NAVIGATION, backend=gated, model=model, world=world, task=task)
    with closing(env):
        driven = drive_all(env, driver, range(FIRST_SEED, FIRST_SEED + job.episodes))
    return successes(driven), sum(one.believed_success for one in driven)


def curves(job: Job) -> tuple[Job, dict[str, list[tuple[int, int]]]]:
    """Successes of a job under each perturbation: without any, and at each of the multiples."""
    nothing = reached(job, None, 0.0)
    return job, {
        each: [nothing, *(reached(job, each, times) for times in job.multiples)]
        for each in job.perturbations
    }


def measure(jobs: Sequence[Job]) -> list[dict[str, dict[str, list[float]]]]:
    """Mean success over the worlds, true and believed.

    Each is robot -> perturbation -> at 0 and at each of the multiples.
    """
    counts: dict[str, dict[str, Any]] = {}
    with ProcessPoolExecutor(AT_ONCE, mp_context=get_context("spawn")) as pool:
        for job, found in pool.map(curves, jobs):
            sys.stderr.write(f"{job.robot} in {job.world}: {found} of {job.episodes}\n")
            own = counts.setdefault(job.robot, dict.fromkeys(job.perturbations, 0))
            for each, some in found.items():
                own[each] = own[each] + np.array(some)
    driven: dict[str, int] = {}
    for job in jobs:
        driven[job.robot] = driven.get(job.robot, 0) + job.episodes
    return [
        {
            robot: {
                each: (some[:, k] / driven[robot]).tolist()
                for each, some in own.items()
            }
            for robot, own in counts.items()
        }
        for k in range(2)
    ]


def losses(
    success: Mapping[str, Mapping[str, Sequence[float]]],
    multiples: Sequence[float] = MULTIPLES,
) -> dict[str, dict[str, float]]:
    """Points of success lost at the declared range: robot -> perturbation -> value."""
    at = 1 + multiples.index(DECLARED)
    return {
        robot: {
            each: round(100.0 * (some[0] - some[at]), 3) for each, some in own.items()
        }
        for robot, own in success.items()
    }


def missed(
    success: Mapping[str, Mapping[str, Sequence[float]]],
    multiples: Sequence[float] = MULTIPLES,
) -> list[str]:
    """A sentence for each bar that was missed."""
    said = []
    for robot, own in success.items():
        if not (share := next(iter(own.values()))[0]) >= FLOOR - 1e-9:
            without = f"{share:.1%} success without a perturbation"
            said.append(f"{robot}: {without}, less than {FLOOR:.0%}")
    for robot, own in losses(success, multiples).items():
        for each, lost in own.items():
            if not lost <= MOST_LOSS + 1e-9:
                said.append(
                    f"{robot}: {each} takes {lost:.1f} points, more than {MOST_LOSS:g}"
                )
    return said if any(success.values()) else ["no policy was driven"]


def worst(lost: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """The greatest loss of all, and to what."""
    points, robot, each = max(
        (value, robot, each)
        for robot, own in lost.items()
        for each, value in own.items()
    )
    return {"points": points, "robot": robot, "perturbation": each}


def draw(
    success: Mapping[str, Mapping[str, Sequence[float]]],
    file: Path,
    multiples: Sequence[float] = MULTIPLES,
) -> None:
    """One panel for each perturbation: success over multiples of the declared range, by robot."""
    amounts = [declared(of_training(robot)) for robot in success]
    perturbations = list(
        dict.fromkeys(each for own in success.values() for each in own)
    )
    rows = -(-len(perturbations) // 3)
    where = np.array([0.0, *multiples])
    figure, grid = style.make_panels(
        rows, 3, (10.0, 2.8 * rows), sharex=True, sharey=True
    )
    for axes, each in zip(grid, perturbations, strict=False):
        for (robot, own), marker in zip(success.items(), cycle(style.MARKERS)):
            share = 100.0 * np.array(
                own[each], np.float64
            )  # None where it was not driven
            driven = ~np.isnan(share)
            axes.plot(
                where[driven], share[driven], marker=marker, markersize=4, label=robot
            )
        axes.axvline(DECLARED, color=style.OTHER, linestyle="--", linewidth=1.0)
        told = " / ".join(dict.fromkeys(some[each] for some in amounts))
        axes.set_title(f"{each}\n{told}")
    for axes in grid[-3:]:
        axes.set_xlabel("multiple of the declared range")
        axes.set_xticks(where)
    for axes in grid[::3]:
        axes.set_ylabel("success [%]")
    shares = [
        share for own in success.values() for some in own.values() for share in some
    ]
    least = 100.0 * np.nanmin(np.array(shares, np.float64))
    grid[0].set_ylim(max(0.0, 5.0 * np.floor(least / 5.0) - 5.0), 102.0)
    write_bytes(file, style.render_png(figure, grid[0]))


def measured_in(results: Path) -> dict[str, dict[str, list[float]]]:
    """The success of all robots in the results of runs: robot -> perturbation -> by multiple."""
    runs = json.loads(results.read_text(encoding="utf-8"))["runs"]
    return {
        robot: {each: list(some.values()) for each, some in own.items()}
        for name, run in sorted(runs.items())
        if name.startswith("robustness_") and run["result"]
        for robot, own in run["result"]["success"].items()
    }


def main() -> None:
    """Prints a table, or one JSON object."""
    parser = parser_of(__doc__, CONTROLS)
    robots = shipped_policies()
    parser.add_argument(
        "--episodes", type=int, default=40, help="in each world, of each point"
    )
    parser.add_argument("--robots", nargs="+", choices=robots, default=robots)
    parser.add_argument("--worlds", nargs="+", choices=WORLDS, default=list(WORLDS))
    parser.add_argument(
        "--only", nargs="+", choices=PERTURBATIONS, default=list(PERTURBATIONS)
    )
    parser.add_argument(
        "--multiples",
        nargs="+",
        type=float,
        default=MULTIPLES,
        metavar="M",
        help="of the declared range, which is measured in any case",
    )
    parser.add_argument("--picture", type=Path, help="draw the curves into this file")
    parser.add_argument(
        "--of",
        type=Path,
        metavar="RESULTS",
        help="draw the picture of these runs, and drive nothing",
    )
    given = parser.parse_args()
    if given.of:
        draw(
            measured_in(given.of), given.picture or parser.error("--of needs --picture")
        )
        return
    multiples = tuple(sorted({DECLARED, *given.multiples}))
    job = partial(
        Job,
        episodes=given.episodes,
        perturbations=tuple(given.only),
        multiples=multiples,
        control=given.control,
    )
    success, believed = measure(
        [job(*each) for each in product(given.robots, given.worlds)]
    )
    if given.picture:
        draw(success, given.picture, multiples)
    lost = losses(success, multiples)
    result = {
        "declared": {robot: declared(of_training(robot)) for robot in success},
        "multiples": [0.0, *multiples],
        "success": success,
        "believed": believed,
        "lost_points": lost,
        "worst": worst(lost),
        "episodes": given.episodes * len(given.worlds),
    }
    answer(result, missed(success, multiples), given.json)


if __name__ == "__main__":
    main()
