"""The demo's policy: trained in the generated simulator, or an existing one.

The demo's last part: the nodes of a robot in real time, each in its own process.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from nics_drl_bridge.commands.demo_plan import DemoPlan, Say
from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.errors import BackendError, PolicyError
from nics_drl_bridge.files import write_text
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.policy.evaluation import Episode
from nics_drl_bridge.policy.policies import open_policy, shipped_policies
from nics_drl_bridge.policy.training_settings import TrainingSettings, load_training
from nics_drl_bridge.report.pictures import Point
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim.scenes import sample_scene
from nics_drl_bridge.sim.world import load_world

SETTINGS, SEED = "demo", 0
NEEDED = ("torch", "stable_baselines3", "tensorboard", "onnx", "onnxruntime")
BASELINE = "dynamic_window"
LINES = 10
"""Number of progress reports of a training."""


@dataclass(frozen=True)
class Learned:
    """The policy of the demo.

    Attributes:
        policy: a policy file or a name, see `policies.open_policy`.
        how: origin of the policy, in a sentence.
        curve: of the training; empty without one.
    """

    policy: str
    how: str
    curve: Sequence[Point] = ()


def learn(plan: DemoPlan, model: SimulatorModel, say: Say) -> Learned:
    """Trains a policy, unless the plan names one or a module for training is not installed.

    Args:
        plan: the plan; the training writes into its folder.
        model: the generated simulator, also saved in `plan.model`.
        say: called with each line of progress.

    Raises:
        BridgeError: the named policy can't be used, or the settings do not fit.
    """
    if plan.policy is not None:
        open_policy(plan.policy, model)
        return Learned(plan.policy, f"The policy {plan.policy!r} was given; none was trained.")
    missing = next((module for module in NEEDED if find_spec(module) is None), None)
    if missing is None:
        return _trained(plan, say)
    policy = _ready_made(model)
    say(
        f"not training, which needs the module {missing!r} (pip install "
        f"'nics_drl_bridge[train,deploy]'); driving with the policy {policy!r} instead"
    )
    return Learned(policy, f"None was trained, as {missing!r} is not installed: {policy!r} drives.")


def settings_of(plan: DemoPlan) -> TrainingSettings:
    """Settings of the demo's training, in the plan's simulator and world."""
    chosen = load_training(SETTINGS)
    changes = {
        "robot": str(plan.model),
        "worlds": {plan.world: chosen.num_envs},
        "steps": plan.train_steps or chosen.steps,
    }
    return chosen.model_copy(update=changes)


def _trained(plan: DemoPlan, say: Say) -> Learned:
    from nics_drl_bridge.policy.train import (
        SeedResult,
        export,
        train,  # needs torch
    )
    from nics_drl_bridge.policy.train_checkpoint import Progress

    settings, curve = settings_of(plan), list[Point]()
    say(f"training a policy for {settings.steps:,} steps in {settings.num_envs} worlds at once")

    def tell(progress: Progress) -> None:
        before = curve[-1].steps if curve else 0
        curve.append(Point(progress.steps, progress.success, progress.collision))
        if progress.steps * LINES // settings.steps > before * LINES // settings.steps:
            say(
                f"  {progress.steps:,} steps: success {100 * progress.success:.1f} %, "
                f"{progress.steps_per_s:,.0f} steps/s"
            )

    trained = train(settings, SEED, plan.out / "training", tell)
    result = SeedResult(SEED, trained, {})
    export(settings, result, f"nics demo --robot {plan.robot}", plan.policy_file)
    steps = f"{trained.steps:,} steps, {trained.stepping_s:.0f} s of {trained.wall_s:.0f} s"
    how = f"PPO learned it from nothing in the generated simulator: {steps} in the simulator."
    return Learned(str(plan.policy_file), how, curve)


def _ready_made(model: SimulatorModel) -> str:
    """The shipped policy of the robot if it fits, else a baseline."""
    name = model.robot.name
    if name in shipped_policies() and find_spec("onnxruntime") and find_spec("onnx"):
        try:
            open_policy(name, model)
        except PolicyError:
            return BASELINE
        return name
    return BASELINE


START_S, ARRIVE_S = 60.0, 40.0
"""Time that a node may take to start, and the robot to arrive."""
FULL_COMMAND_S, FULL_RATE_S = 0.3, 0.05
"""Limits of the demo's gate: time from zero to the maximum command, and to its maximum rate."""


@dataclass(frozen=True)
class Live:
    """A drive of the deployed nodes, with its path; `arrived` is True if it reached the goal."""

    arrived: bool
    path: Episode


def deploy(plan: DemoPlan, model: SimulatorModel, policy: str, seed: int, say: Say) -> Live:
    """Runs simulator, middleware, policy and gate in one scene in real time.

    Args:
        plan: gives the world and the folder for logs.
        model: of the robot, also saved in `plan.model`.
        policy: the policy of `policy_node`.
        seed: of the scene.
        say: called with each line of progress.

    Raises:
        BackendError: a node does not start, or ends.
    """
    scene = sample_scene(load_world(plan.world), model.robot.footprint_radius, seed)
    goal = [float(value) for value in scene.goals[0]]
    nodes = _nodes(plan, model.robot, policy, seed, goal)
    say(f"deploying {', '.join(nodes)} in real time")
    # The policy stops where it believes the goal is; its odometry drifts.
    near = Navigation(model.robot, model.lidar).goal_radius + 0.1
    arrived, path = _watched(nodes, plan.out / "logs" / "realtime", goal, near, say)
    say(f"  the deployed nodes {'reached' if arrived else 'did not reach'} the goal of seed {seed}")
    result = "success" if arrived else "time-out"
    return Live(arrived, Episode(seed, result, path, path, scene.goals[0], scene.bodies, 0.0))


def _nodes(
    plan: DemoPlan, robot: RobotSpec, policy: str, seed: int, goal: list[float]
) -> dict[str, dict[str, Any]]:
    """Parameters of each node, by name."""
    folder = str(plan.model)
    return {
        "simulator_node": {"model": folder, "world": plan.world, "episode_seed": seed},
        "middleware_node": {"model": folder},
        "command_gate": {
            "model": folder,
            "use_sim_time": True,
            "e_stop_required": False,
            "limits": str(_write_limits(robot, plan.out / "limits.yaml")),
            "black_box": str(plan.out / "black_box"),
        },
        "policy_node": {"model": folder, "policy": policy, "goal": goal},
    }


def _watched(
    nodes: dict[str, dict[str, Any]], logs: Path, goal: list[float], near: float, say: Say
) -> tuple[bool, Any]:
    """Starts the nodes, arms the gate, waits; returns arrival and the robot's path (T, 3)."""
    from nics_drl_bridge.nodes.processes import NodeProcess, Witness, free_domain_id

    domain_id = free_domain_id()
    with ExitStack() as stack:
        witness = stack.enter_context(Witness(domain_id))
        processes = []
        for node, parameters in nodes.items():
            processes.append(stack.enter_context(NodeProcess(node, logs, parameters, domain_id)))
            if node == "simulator_node" and not witness.sees(START_S):
                processes[0].check()
                raise BackendError(
                    f"{node} publishes nothing after {START_S:g} s; look at its log, "
                    f"{processes[0].log}."
                )
        refused = witness.arms("command_gate", START_S)
        for process in processes:
            process.check()
        if refused:
            raise BackendError(f"command_gate can't be armed: {refused}")
        say("  command_gate is armed; no emergency stop is required of a simulation")
        arrived = witness.arrives(goal, near, ARRIVE_S)
        for process in processes:
            process.check()
        return arrived, witness.path


def _write_limits(robot: RobotSpec, path: Path) -> Path:
    """Writes limits that allow a simulated robot all its commands, with limited rate and jerk."""
    commands = {}
    for variable in robot.command:
        low, high = min(variable.min, 0.0), max(variable.max, 0.0)
        rate = max(-low, high) / FULL_COMMAND_S
        jerk = rate / FULL_RATE_S
        commands[variable.name] = {"min": low, "max": high, "rate": rate, "jerk": jerk}
    write_text(path, dump_yaml({"robot": robot.name, "commands": commands}))
    return path
