"""A trial: the same episodes in process, over DDS, and in MuJoCo over DDS."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium

from nics_drl_bridge.env.registration import NAVIGATION, register_envs
from nics_drl_bridge.errors import MISSING_ROS, BackendError, ConfigError, nearest
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.highfidelity.library import load_mujoco
from nics_drl_bridge.policy.evaluation import Episode, drive_all
from nics_drl_bridge.policy.policies import SUFFIX, open_policy, shipped_policies

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
"""How long a node may take to come up; its kernels may have to be compiled."""
Told = Callable[[Episode], None]
Say = Callable[[str], None]


@dataclass(frozen=True)
class Trial:
    """Which episodes to drive.

    Attributes:
        policy: a policy file, or the name of a shipped one or of a baseline.
        model: folder of a model, or a shipped robot.
        world: YAML file or name of the world.
        seeds: of the episodes: each fixes obstacles, start, goal and noise.
        logs: folder for those of the nodes.
    """

    policy: str
    model: str
    world: str
    seeds: Sequence[int]
    logs: Path


def drive_in(place: str, trial: Trial, told: Told, say: Say = lambda _: None) -> list[Episode]:
    """Drives the episodes of a trial in one of `PLACES`.

    The node that a place needs runs in a process of its own, in lock-step, and has ended when this
    returns or raises.

    Args:
        place: where.
        trial: what.
        told: of each episode as it ends.
        say: takes a line of progress.

    Raises:
        BridgeError: a bad name or file, or a node that does not come up.
    """
    check_place(place)
    if place == FAST:
        return drive(trial, "sim", {"estimator": True}, told)
    from nics_drl_bridge.nodes.witness import Witness

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
    """Drives the episodes of a trial in an env of a backend, with further arguments of the env."""
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
    """Starts a simulator's node; gives the options of the backend that drives it."""
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
            process.check()  # a node that has ended says why better
            raise


def check_place(place: str) -> None:
    """Raises ConfigError where there is no such place, or what it needs is not installed."""
    if place not in PLACES:
        raise ConfigError(f"--in {place!r}: there is no such world; {nearest(place, PLACES)}")
    if place != FAST and find_spec("rclpy") is None:
        raise ConfigError(f"the world {place!r} {MISSING_ROS.format(module='rclpy')}")
    if place == MUJOCO:
        load_mujoco()


def robot_of(policy: str) -> str:
    """The robot that a policy file was trained for; of a baseline the first shipped one."""
    if not policy.endswith(SUFFIX) and policy not in shipped_policies():
        return DEFAULT_ROBOT
    from nics_drl_bridge.policy.policy_file import load_policy  # needs onnx, baselines do not

    return str(load_policy(policy).contract.robot.name)
