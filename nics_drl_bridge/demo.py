"""The demo: the whole road once, from a recording to a policy that drives over ROS 2."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from nics_drl_bridge.calibration.identify import Identified
from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.errors import MISSING_ROS, BackendError, ConfigError
from nics_drl_bridge.files import write_text
from nics_drl_bridge.generator import SimulatorModel, generate, save_model
from nics_drl_bridge.kinematics import textbook
from nics_drl_bridge.kinematics.readers import read_recording
from nics_drl_bridge.kinematics.recording import save_recording
from nics_drl_bridge.kinematics.spec import RobotSpec, load_robot
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.policy.evaluation import Episode, deviation, successes
from nics_drl_bridge.report.calibration_pictures import CAPTIONS, calibration_pictures
from nics_drl_bridge.report.fit_pictures import accuracy
from nics_drl_bridge.report.page import Block, Code, Picture, Table, page
from nics_drl_bridge.report.pictures import trajectories
from nics_drl_bridge.sim.scenes import sample_scene
from nics_drl_bridge.sim.world import load_world
from nics_drl_bridge.trial import DDS, FAST, LABELS, Trial, drive_in

RECORDING_SEED = 1
POLICY = "go_to_goal"
LIVE_RATE = 2.0
LIVE_TIMEOUT_S = 40.0
FULL_COMMAND_S, FULL_RATE_S = 0.3, 0.05
"""The gate's limits in the demo: from zero to the greatest command, and to its greatest change."""
IN_PROCESS, OVER_DDS = LABELS[FAST], LABELS[DDS]
Say = Callable[[str], None]


@dataclass(frozen=True)
class Plan:
    """What to demonstrate.

    Attributes:
        out: folder of everything that the demo writes.
        robot: name or YAML file of the robot.
        world: name or YAML file of the world.
        recording: of a drive; None makes one with the robot's textbook kinematics.
        episodes: how many.
    """

    out: Path
    robot: str = "ackermann"
    world: str = "arena"
    recording: Path | None = None
    episodes: int = 5


@dataclass(frozen=True)
class Outcome:
    """What the demo showed: successes in process and over DDS, and where the report is."""

    in_process: int
    over_dds: int
    episodes: int
    report: Path

    def line(self) -> str:
        """The last line of the demo."""
        return (
            f"demo: in process {self.in_process}/{self.episodes}, "
            f"over DDS {self.over_dds}/{self.episodes}, report {self.report}"
        )


def run(plan: Plan, say: Say) -> Outcome:
    """Generates a simulator, drives in it, drives the same over DDS, and writes a report.

    Every process that it starts has ended when it returns or raises.

    Args:
        plan: what to do.
        say: takes each line of progress.

    Raises:
        BridgeError: a bad recording or name, or a node that does not come up.
    """
    if find_spec("rclpy") is None:
        raise ConfigError(f"the demo {MISSING_ROS.format(module='rclpy')}")
    model, identified = _generate(plan, say)
    say(f"driving {plan.episodes} episodes in process")
    here = _drive(FAST, plan, say)
    say(f"driving the same {plan.episodes} episodes over DDS in lock-step")
    there = _drive(DDS, plan, say)
    live = _drive_live(plan, model, say)
    report = plan.out / "report.html"
    write_text(report, _report(plan, model, identified, here, there, live))
    return Outcome(successes(here), successes(there), plan.episodes, report)


def _generate(plan: Plan, say: Say) -> tuple[SimulatorModel, Identified]:
    robot, world = load_robot(plan.robot), load_world(plan.world)
    source = plan.recording or _record(robot, plan.out / "recording.npz", say)
    say(f"generating a simulator of the robot {robot.name!r} from {source}")
    recording = read_recording(source, robot)
    # A demo has to steer, even if the drive never did; the report names what is assumed.
    model, identified = generate(recording, robot, load_lidar("paper"), world.shapes, assume=True)
    save_model(model, plan.out / "model")
    say(model.report.rstrip())
    return model, identified


def _record(robot: RobotSpec, path: Path, say: Say) -> Path:
    say(f"recording a drive of the textbook {robot.name!r} robot")
    save_recording(textbook.record(robot, np.random.default_rng(RECORDING_SEED)), path)
    return path


def _drive(place: str, plan: Plan, say: Say) -> list[Episode]:
    """The plan's episodes in one of `trial.PLACES`, told of one by one."""
    seeds, logs = range(plan.episodes), plan.out / "logs" / "lockstep"
    return drive_in(
        place,
        Trial(POLICY, str(plan.out / "model"), plan.world, seeds, logs),
        lambda e: say(f"  seed {e.seed}: {e.result}, {e.steps} steps, {e.length:.2f} m"),
        say,
    )


@dataclass(frozen=True)
class Live:
    """A drive of the deployed nodes in real time, nobody stepping them."""

    arrived: bool
    path: Episode


def _drive_live(plan: Plan, model: SimulatorModel, say: Say) -> Live:
    """Simulator in real time, middleware, policy and gate, each a process."""
    from nics_drl_bridge.nodes.processes import NodeProcess, free_domain_id
    from nics_drl_bridge.nodes.witness import Witness

    world = load_world(plan.world)
    scene = sample_scene(world, model.robot.footprint_radius, 0)
    goal = [float(value) for value in scene.goals[0]]
    folder = str(plan.out / "model")
    nodes: dict[str, dict[str, Any]] = {
        "simulator_node": {
            "model": folder,
            "world": plan.world,
            "rate": LIVE_RATE,
            "episode_seed": 0,
        },
        "middleware_node": {"model": folder},
        "command_gate": {
            "model": folder,
            "limits": str(_write_limits(model.robot, plan.out / "limits.yaml")),
            "black_box": str(plan.out / "black_box"),
        },
        "policy_node": {"model": folder, "policy": POLICY, "goal": goal},
    }
    domain_id, logs = free_domain_id(), plan.out / "logs" / "realtime"
    say(f"deploying {', '.join(nodes)} in real time")
    with ExitStack() as stack:
        witness = stack.enter_context(Witness(domain_id))
        processes = []
        for node, parameters in nodes.items():
            processes.append(stack.enter_context(NodeProcess(node, logs, parameters, domain_id)))
            if node == "simulator_node" and not witness.sees(LIVE_TIMEOUT_S):
                processes[0].check()
                raise BackendError(
                    f"{node} publishes nothing after {LIVE_TIMEOUT_S:g} s; look at its log, "
                    f"{processes[0].log}."
                )
        refused = witness.arms("command_gate", LIVE_TIMEOUT_S)
        for process in processes:
            process.check()
        if refused:
            raise BackendError(f"command_gate can't be armed: {refused}")
        say("  command_gate is armed; no emergency stop is required of a simulation")
        task = Navigation(model.robot, model.lidar)
        # The policy stops where it believes to be there; its odometry drifts.
        arrived = witness.arrives(goal, task.goal_radius + 0.1, LIVE_TIMEOUT_S)
        for process in processes:
            process.check()
        path = witness.path
    say(f"  the deployed nodes {'reached' if arrived else 'did not reach'} the goal of seed 0")
    result = "success" if arrived else "time-out"
    return Live(arrived, Episode(0, result, path, path, scene.goals[0], scene.bodies, 0.0))


def _write_limits(robot: RobotSpec, path: Path) -> Path:
    """Limits that let a simulated robot do all it can, within a time to get there."""
    commands = {}
    for variable in robot.command:
        low, high = min(variable.min, 0.0), max(variable.max, 0.0)
        rate = max(-low, high) / FULL_COMMAND_S
        jerk = rate / FULL_RATE_S
        commands[variable.name] = {"min": low, "max": high, "rate": rate, "jerk": jerk}
    write_text(path, dump_yaml({"robot": robot.name, "commands": commands}))
    return path


def _report(
    plan: Plan,
    model: SimulatorModel,
    identified: Identified,
    here: list[Episode],
    there: list[Episode],
    live: Live,
) -> str:
    world = load_world(plan.world)
    footprint = model.robot.footprint_radius
    rows = [
        (
            str(a.seed), a.result, f"{a.steps}", f"{a.length:.2f}", b.result, f"{b.steps}",
            f"{b.length:.2f}", f"{deviation(a, b):.1g}",
        )
        for a, b in zip(here, there, strict=True)
    ]  # fmt: skip
    head = ("seed", IN_PROCESS, "steps", "path [m]", OVER_DDS, "steps", "path [m]", "deviation [m]")
    both = trajectories({IN_PROCESS: here, OVER_DDS: there}, world, footprint)
    sections: list[tuple[str, Sequence[Block]]] = [
        (
            "The model",
            [
                "Generated from " + str(plan.recording or "a textbook drive") + ".",
                Code(model.report),
                Picture(
                    accuracy(identified),
                    "What each further term is worth; circles mark how many are kept.",
                ),
                *(
                    Picture(picture, CAPTIONS[name])
                    for name, picture in calibration_pictures(model.robot, identified).items()
                ),
            ],
        ),
        (
            "The same episodes, in process and over DDS",
            [
                f"{successes(here)} of {len(here)} episodes reached the goal in process, "
                f"{successes(there)} of {len(there)} over DDS in lock-step. Deviation is the "
                "greatest distance between the two true paths at the same step.",
                Table(head, rows),
                Picture(both, "Blue: in process. Red, dashed: over DDS."),
            ],
        ),
        (
            "Deployed",
            [
                "simulator_node in real time, middleware_node, policy_node and command_gate ran as "
                "processes of their own; nobody stepped them. The robot "
                f"{'reached' if live.arrived else 'did not reach'} its goal.",
                Picture(
                    trajectories(
                        {"in process": here[:1], "deployed": [live.path]}, world, footprint
                    ),
                    "The true path of the deployed robot beside the lock-step one.",
                ),
            ],
        ),
    ]
    lead = f"Robot {model.robot.name!r} in the world {plan.world!r}, policy {POLICY!r}."
    return page("nics_drl_bridge: demo", lead, sections)
