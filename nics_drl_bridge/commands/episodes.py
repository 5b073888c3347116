"""Drives policies through the same episodes in process, over DDS, and in MuJoCo over DDS.

Compares the worlds as Fig. 7 of the paper does, with a table.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from math import isnan
from pathlib import Path
from typing import Any

import gymnasium

from nics_drl_bridge import extensions
from nics_drl_bridge.env.registry import NAVIGATION, register_envs
from nics_drl_bridge.errors import MISSING_ROS, BackendError, ConfigError, nearest
from nics_drl_bridge.files import write_bytes, write_text
from nics_drl_bridge.generator import SimulatorModel, open_model
from nics_drl_bridge.policy.evaluation import FIRST_SEED, Episode, Tally, drive_all, tallies
from nics_drl_bridge.policy.policies import Policy, is_policy_file, open_policy
from nics_drl_bridge.report.pictures import trajectories
from nics_drl_bridge.seeds import checked_seeds
from nics_drl_bridge.sim.world import World, load_world

FAST, DDS, MUJOCO, VEHICLE = "fast", "dds", "mujoco_dds", "vehicle"
NODES = {DDS: "simulator_node", MUJOCO: "mujoco_node"}
PLACES = (FAST, *NODES)
LABELS = {FAST: "in process", DDS: "over DDS", MUJOCO: "MuJoCo over DDS", VEHICLE: "on the vehicle"}
DEFAULT_ROBOT = "ackermann"
START_S = 180.0  # time that a node may take to start [s]; its kernels may have to be compiled
PANELS = 6
HEADS = (
    "policy", "world", "success", "95 %", "believed", "collision", "time-out", "path [m]",
    "time [s]", "as in the first", "deviation [m]", "greatest [m]",
)  # fmt: skip
Say = Callable[[str], None]
Tell = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Trial:
    """Episodes to drive."""

    policy: str  # a policy file, or the name of a shipped policy or of a baseline
    model: str  # folder of a model, or a shipped robot
    world: str  # YAML file or name of the world
    seeds: Sequence[int]  # of the episodes; each fixes obstacles, start, goal and noise
    logs: Path  # folder for the logs of the nodes


def drive_in(
    place: str, trial: Trial, on_episode: Callable[[Episode], None], say: Say = lambda _: None
) -> list[Episode]:
    """Drives the episodes of a trial in one of `PLACES`; calls `on_episode` as each ends.

    The node that a place needs runs in its own process, in lock-step, and has ended when this
    returns or raises. Raises BridgeError for a bad name or file, or a node that does not start.
    """
    check_place(place)
    model = open_model(trial.model)
    if place == FAST:
        env, policy = env_of(trial.policy, model, trial.world, "sim", estimator=True)
        with closing(env):
            return drive_all(env, policy, trial.seeds, on_episode)
    from nics_drl_bridge.nodes.processes import Witness

    name = NODES[place]
    with _node(name, trial, say) as options, Witness(options["domain_id"]) as witness:
        env, policy = env_of(trial.policy, model, trial.world, "dds", backend_options=options)
        with closing(env):
            touched = partial(witness.touched, name, START_S)
            return drive_all(env, policy, trial.seeds, on_episode, touched)


def env_of(
    policy: str, model: SimulatorModel, world: str, backend: str, **arguments: Any
) -> tuple[gymnasium.Env[Any, Any], Policy]:
    """Makes the env of a policy's task with a backend, and opens the policy."""
    register_envs()
    opened, task = open_policy(policy, model)
    env = gymnasium.make(
        NAVIGATION, backend=backend, model=model, world=world, task=task, **arguments
    )
    return env, opened


@contextmanager
def _node(name: str, trial: Trial, say: Say) -> Iterator[dict[str, Any]]:
    """Starts a simulator node; yields the options of the backend that drives it."""
    from nics_drl_bridge.nodes.processes import NodeProcess, free_domain_id

    domain_id = free_domain_id()
    parameters = {"model": trial.model, "world": trial.world, "mode": "lockstep"}
    with NodeProcess(name, trial.logs, parameters, domain_id) as process:
        say(f"started {name} as process {process.pid} in ROS domain {domain_id}")
        options = {"domain_id": domain_id, "simulator": name, "timeout_s": START_S}
        try:
            yield {"truth": True, **options}
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
    if not is_policy_file(policy):
        return DEFAULT_ROBOT
    from nics_drl_bridge.policy.policy_file import load_policy  # needs onnx, baselines do not

    return str(load_policy(policy).contract.robot.name)


@dataclass(frozen=True)
class EvaluationOrder:
    """An order to evaluate policies; the seed is that of the first episode."""

    policies: Sequence[str]  # files, or names of shipped policies or of baselines
    out: Path  # output folder
    model: str | None = None  # folder of a model or a shipped robot; None: the policies' own robot
    world: str = "circles"  # YAML file or name of the world
    episodes: int = 20
    seed: int = FIRST_SEED
    places: Sequence[str] = PLACES  # some of `PLACES`; the others are compared with the first

    @property
    def seeds(self) -> range:
        """Seeds of the episodes. Raises ConfigError if one is not a valid seed."""
        seeds = range(self.seed, self.seed + self.episodes)
        checked_seeds([seeds.start, seeds.stop - 1])
        return seeds


@dataclass(frozen=True)
class Evaluated:
    """Results of one policy: its episodes and figures in each place."""

    policy: str
    runs: Mapping[str, Sequence[Episode]]
    tallies: Mapping[str, Tally]


def evaluate(order: EvaluationOrder, say: Say, tell: Tell) -> list[Evaluated]:
    """Drives every policy through the same episodes in every place.

    `tell` is called with what is being driven, the number of episodes done, and the total. Returns
    the results of each policy; `evaluation.json` and a picture per policy are in `order.out`.
    Raises BridgeError for a bad name or file, or a node that does not start.
    """
    name, seeds = _model_name(order), order.seeds
    model, world = open_model(name), load_world(order.world)
    for place in order.places:
        check_place(place)
    evaluated = []
    for policy in order.policies:
        runs = {}
        for place in order.places:
            what = f"{Path(policy).stem} {LABELS[place]}"
            say(f"driving {order.episodes} episodes of {policy} {LABELS[place]}")

            def on_episode(episode: Episode, what: str = what) -> None:
                tell(what, episode.seed - order.seed + 1, order.episodes)

            trial = Trial(policy, name, order.world, seeds, order.out / "logs")
            runs[place] = drive_in(place, trial, on_episode, say)
        evaluated.append(judged(policy, runs, model, world, order.out, PANELS))
    write_evaluation(order.out, name, model, order.world, order.seed, evaluated)
    return evaluated


def judged(
    policy: str,
    runs: Mapping[str, Sequence[Episode]],
    model: SimulatorModel,
    world: World,
    out: Path,
    panels: int | None = None,
) -> Evaluated:
    """Judges the runs of a policy by place, and draws their first episodes into a folder."""
    shown = {LABELS[place]: some[:panels] for place, some in runs.items()}
    picture = trajectories(shown, world, model.robot.footprint_radius)
    write_bytes(out / f"trajectories_{Path(policy).stem}.png", picture)
    return Evaluated(policy, runs, tallies(runs, model.control_period))


def _model_name(order: EvaluationOrder) -> str:
    """The model that the episodes are driven with. Raises ConfigError for unknown policies."""
    if order.model is not None:
        for policy in order.policies:
            is_policy_file(policy)
        return order.model
    robots = {policy: robot_of(policy) for policy in order.policies}
    if len(set(robots.values())) > 1:
        of_each = ", ".join(f"{policy!r} is of {robot!r}" for policy, robot in robots.items())
        raise ConfigError(f"{of_each}: evaluate them one by one, or say which with --model.")
    return next(iter(robots.values()))


def write_evaluation(
    out: Path, name: str, model: SimulatorModel, world: str, seed: int, evaluated: list[Evaluated]
) -> None:
    """Writes `evaluation.json`; the name is that of the model, the seed of the first episode."""
    policies = {
        one.policy: {
            place: {**one.tallies[place].figures(), "each": [episode.plain() for episode in some]}
            for place, some in one.runs.items()
        }
        for one in evaluated
    }
    data = {
        "model": name, "model_fingerprint": model.fingerprint, "robot": model.robot.name,
        "world": world, "seed": seed, "policies": policies,
    }  # fmt: skip
    write_text(out / "evaluation.json", json.dumps(data) + "\n")


def rows_of(evaluated: Sequence[Evaluated]) -> list[tuple[str, ...]]:
    """Rows of the table with the columns `HEADS`, as text."""
    return [
        (
            one.policy, LABELS[place], _percent(tally.success.value),
            f"{100 * tally.success.low:.0f} to {100 * tally.success.high:.0f} %",
            *(_percent(rate.value) for rate in (tally.believed, tally.collision, tally.time_out)),
            *("-" if isnan(of.value) else f"{of.value:.2f}" for of in (tally.length, tally.time)),
            _percent(tally.same), f"{tally.deviation.value:.2g}", f"{tally.greatest_deviation:.2g}",
        )
        for one in evaluated
        for place, tally in one.tallies.items()
    ]  # fmt: skip


def _percent(share: float) -> str:
    return f"{100 * share:.4g} %"


def line_of(one: Evaluated) -> str:
    """Summarises a policy in one line."""
    each = ", ".join(f"{LABELS[p]} {_percent(t.success.value)}" for p, t in one.tallies.items())
    return f"{one.policy}: success {each}"
