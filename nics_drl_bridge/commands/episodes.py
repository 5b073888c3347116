"""A trial: the same episodes in process, over DDS, and in MuJoCo over DDS.

Evaluates policies in several worlds: Fig. 7 of the paper, with a table.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium

from nics_drl_bridge import extensions
from nics_drl_bridge.env.registry import NAVIGATION, register_envs
from nics_drl_bridge.errors import MISSING_ROS, BackendError, ConfigError, nearest
from nics_drl_bridge.files import write_bytes, write_text
from nics_drl_bridge.generator import SimulatorModel, open_model
from nics_drl_bridge.policy.evaluation import Episode, drive_all
from nics_drl_bridge.policy.policies import SUFFIX, check_name, open_policy, shipped_policies
from nics_drl_bridge.policy.statistics import ConfidenceInterval, Tally, record_of, tallies
from nics_drl_bridge.report.pictures import trajectories
from nics_drl_bridge.seeds import checked_seeds
from nics_drl_bridge.sim.world import load_world

FAST, DDS, MUJOCO, VEHICLE = "fast", "dds", "mujoco_dds", "vehicle"
NODES = {DDS: "simulator_node", MUJOCO: "mujoco_node"}
PLACES = (FAST, *NODES)
LABELS = {
    FAST: "in process",
    DDS: "over DDS",
    MUJOCO: "MuJoCo over DDS",
    VEHICLE: "on the vehicle",
}
DEFAULT_ROBOT = "ackermann"
START_S = 180.0
"""Time that a node may take to start [s]; its kernels may have to be compiled."""
Told = Callable[[Episode], None]
Say = Callable[[str], None]


@dataclass(frozen=True)
class Trial:
    """Episodes to drive.

    Attributes:
        policy: a policy file, or the name of a shipped policy or of a baseline.
        model: folder of a model, or a shipped robot.
        world: YAML file or name of the world.
        seeds: of the episodes; each fixes obstacles, start, goal and noise.
        logs: folder for the logs of the nodes.
    """

    policy: str
    model: str
    world: str
    seeds: Sequence[int]
    logs: Path


def drive_in(place: str, trial: Trial, told: Told, say: Say = lambda _: None) -> list[Episode]:
    """Drives the episodes of a trial in one of `PLACES`.

    The node that a place needs runs in its own process, in lock-step, and has ended when this
    returns or raises.

    Args:
        place: one of `PLACES`.
        trial: the episodes.
        told: called with each episode as it ends.
        say: called with each line of progress.

    Raises:
        BridgeError: a bad name or file, or a node that does not start.
    """
    check_place(place)
    if place == FAST:
        return drive(trial, "sim", {"estimator": True}, told)
    from nics_drl_bridge.nodes.processes import Witness

    with _node(NODES[place], trial, say) as options, Witness(options["domain_id"]) as witness:

        def touched() -> bool:
            return witness.touched(NODES[place], START_S)

        return drive(trial, "dds", {"backend_options": options}, told, touched)


def drive(
    trial: Trial,
    backend: str,
    arguments: dict[str, Any],
    told: Told,
    touched: Callable[[], bool] | None = None,
) -> list[Episode]:
    """Drives the episodes of a trial in an env with this backend and further arguments."""
    register_envs()
    model = open_model(trial.model)
    policy, task = open_policy(trial.policy, model)
    env = gymnasium.make(
        NAVIGATION, backend=backend, model=model, world=trial.world, task=task, **arguments
    )
    try:
        return drive_all(env, policy, trial.seeds, told, touched)
    finally:
        env.close()


@contextmanager
def _node(name: str, trial: Trial, say: Say) -> Iterator[dict[str, Any]]:
    """Starts a simulator node; yields the options of the backend that drives it."""
    from nics_drl_bridge.nodes.processes import NodeProcess, free_domain_id

    domain_id = free_domain_id()
    parameters = {"model": trial.model, "world": trial.world, "mode": "lockstep"}
    with NodeProcess(name, trial.logs, parameters, domain_id) as process:
        say(f"started {name} as process {process.pid} in ROS domain {domain_id}")
        try:
            yield {
                "truth": True, "domain_id": domain_id, "simulator": name, "timeout_s": START_S,
            }  # fmt: skip
        except BackendError:
            process.check()  # if the node has ended, its own error is more useful
            raise


def check_place(place: str) -> None:
    """Raises ConfigError if there is no such place, or what it needs is not installed."""
    if place not in PLACES:
        raise ConfigError(f"--in {place!r}: there is no such world; {nearest(place, PLACES)}")
    if place != FAST and find_spec("rclpy") is None:
        raise ConfigError(f"the world {place!r} {MISSING_ROS.format(module='rclpy')}")
    if place == MUJOCO:
        extensions.load("nodes", NODES[MUJOCO])


def robot_of(policy: str) -> str:
    """The robot that a policy file was trained for; for a baseline the default robot."""
    if not policy.endswith(SUFFIX) and policy not in shipped_policies():
        return DEFAULT_ROBOT
    from nics_drl_bridge.policy.policy_file import load_policy  # needs onnx, baselines do not

    return str(load_policy(policy).contract.robot.name)


FIRST_SEED = 1_000_000
"""Far from the seeds of any training."""
PANELS = 6
HEADS = (
    "policy", "world", "success", "95 %", "believed", "collision", "time-out", "path [m]",
    "time [s]", "as in the first", "deviation [m]", "greatest [m]",
)  # fmt: skip
Tell = Callable[[str, int, int], None]


@dataclass(frozen=True)
class EvaluationOrder:
    """An order to evaluate policies.

    Attributes:
        policies: files, or names of shipped policies or of baselines.
        out: output folder.
        model: folder of a model or a shipped robot; None uses the policies' own robot.
        world: YAML file or name of the world.
        episodes: number of episodes.
        seed: of the first episode.
        places: some of `trial.PLACES`; the others are compared with the first.
    """

    policies: Sequence[str]
    out: Path
    model: str | None = None
    world: str = "circles"
    episodes: int = 20
    seed: int = FIRST_SEED
    places: Sequence[str] = PLACES


@dataclass(frozen=True)
class Evaluated:
    """Results of one policy: its episodes and figures in each place."""

    policy: str
    runs: Mapping[str, Sequence[Episode]]
    tallies: Mapping[str, Tally]


def evaluate(order: EvaluationOrder, say: Say, tell: Tell) -> list[Evaluated]:
    """Drives every policy through the same episodes in every place, and writes the results.

    Args:
        order: what to evaluate.
        say: called with each line of progress.
        tell: called with what is being driven, the number of episodes done, and the total.

    Returns:
        The results of each policy; `evaluation.json` and a picture per policy are in `order.out`.

    Raises:
        BridgeError: a bad name or file, or a node that does not start.
    """
    name = model_name(order)
    seeds_of(order)  # before anything is driven
    for policy in order.policies:
        check_name(policy)
    model, world = open_model(name), load_world(order.world)
    for place in order.places:
        check_place(place)
    evaluated = []
    for policy in order.policies:
        runs = {place: _drive(order, policy, name, place, say, tell) for place in order.places}
        made = Evaluated(policy, runs, tallies(runs, model.control_period))
        evaluated.append(made)
        picture = trajectories(
            {LABELS[place]: some[:PANELS] for place, some in runs.items()},
            world, model.robot.footprint_radius,
        )  # fmt: skip
        write_bytes(picture_of(order.out, policy), picture)
    told = json.dumps(told_of(order, name, model, evaluated))
    write_text(order.out / "evaluation.json", told + "\n")
    return evaluated


def model_name(order: EvaluationOrder) -> str:
    """The model that the episodes are driven with."""
    if order.model is not None:
        return order.model
    robots = {policy: robot_of(policy) for policy in order.policies}
    if len(set(robots.values())) > 1:
        of_each = ", ".join(f"{policy!r} is of {robot!r}" for policy, robot in robots.items())
        raise ConfigError(f"{of_each}: evaluate them one by one, or say which with --model.")
    return next(iter(robots.values()))


def _drive(
    order: EvaluationOrder, policy: str, model: str, place: str, say: Say, tell: Tell
) -> list[Episode]:
    seeds = seeds_of(order)
    trial = Trial(policy, model, order.world, seeds, order.out / "logs")
    done = []

    def told(episode: Episode) -> None:
        done.append(episode)
        tell(f"{Path(policy).stem} {LABELS[place]}", len(done), order.episodes)

    say(f"driving {order.episodes} episodes of {policy} {LABELS[place]}")
    return drive_in(place, trial, told, say)


def seeds_of(order: EvaluationOrder) -> range:
    """Seeds of the episodes. Raises ConfigError if one is not a valid seed."""
    seeds = range(order.seed, order.seed + order.episodes)
    checked_seeds([seeds.start, seeds.stop - 1])
    return seeds


def picture_of(out: Path, policy: str) -> Path:
    """Path of the picture of a policy."""
    return out / f"trajectories_{Path(policy).stem}.png"


def told_of(
    order: EvaluationOrder, name: str, model: SimulatorModel, evaluated: Sequence[Evaluated]
) -> dict[str, Any]:
    """The evaluation as plain data, for JSON."""
    return {
        "model": name,
        "model_fingerprint": model.fingerprint,
        "robot": model.robot.name,
        "world": order.world,
        "seed": order.seed,
        "policies": {
            one.policy: {
                place: {
                    **one.tallies[place].figures(),
                    "each": [record_of(episode) for episode in one.runs[place]],
                }
                for place in one.runs
            }
            for one in evaluated
        },
    }


def rows_of(evaluated: Sequence[Evaluated]) -> list[tuple[str, ...]]:
    """Rows of the table with the columns `HEADS`, as text."""
    return [
        (one.policy, LABELS[place], *_cells(tally))
        for one in evaluated
        for place, tally in one.tallies.items()
    ]


def _cells(tally: Tally) -> tuple[str, ...]:
    success = tally.success
    return (
        percent(success.value),
        f"{100 * success.low:.0f} to {100 * success.high:.0f} %",
        percent(tally.believed.value),
        percent(tally.collision.value),
        percent(tally.time_out.value),
        _figure(tally.length),
        _figure(tally.time),
        percent(tally.same),
        f"{tally.deviation.value:.2g}",
        f"{tally.greatest_deviation:.2g}",
    )


def percent(share: float) -> str:
    """Formats a share as a percentage."""
    return f"{100 * share:.4g} %"


def _figure(estimate: ConfidenceInterval) -> str:
    return "-" if estimate.value != estimate.value else f"{estimate.value:.2f}"


def line_of(one: Evaluated) -> str:
    """Summarises a policy in one line."""
    each = ", ".join(f"{LABELS[p]} {percent(t.success.value)}" for p, t in one.tallies.items())
    return f"{one.policy}: success {each}"
