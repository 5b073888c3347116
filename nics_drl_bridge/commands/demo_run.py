"""Runs the parts of the demo in sequence, and writes its report."""

import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from nics_drl_bridge import extensions
from nics_drl_bridge.commands.demo_report import (
    AS_IT_IS,
    PERTURBED,
    DemoPlan,
    DemoResults,
    Learned,
    make_sections,
)
from nics_drl_bridge.commands.episodes import DDS, FAST, LABELS, START_S, Say, drive_in
from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import BackendError, PolicyError
from nics_drl_bridge.files import write_bytes, write_text
from nics_drl_bridge.generator import SimulatorModel, generate, mount_lidar, save_model
from nics_drl_bridge.identify.identify import Identified
from nics_drl_bridge.identify.report import format_opening
from nics_drl_bridge.policy import evaluation
from nics_drl_bridge.policy.evaluation import FIRST_SEED, Episode, Summary, successes
from nics_drl_bridge.policy.policies import (
    check_policy_file,
    is_policy_file,
    list_shipped_policies,
    open_policy,
)
from nics_drl_bridge.policy.train.settings import (
    Fitted,
    Opened,
    find_pace,
    fit_settings,
    load_training,
)
from nics_drl_bridge.recording import textbook
from nics_drl_bridge.recording.readers import open_drive, read_recording
from nics_drl_bridge.recording.recording import save_recording
from nics_drl_bridge.report import html, pictures
from nics_drl_bridge.robot import DEFAULT_ROBOT
from nics_drl_bridge.robot.spec import RobotSpec, load_robot
from nics_drl_bridge.sim.randomisation import load_randomisation
from nics_drl_bridge.sim.scenes import sample_scene
from nics_drl_bridge.sim.world import load_world

RECORDING_SEED = 1
TRAINING_SEED = 0
MANY = 500  # number of evaluation episodes in the fast simulator
BASELINE = "dynamic_window"
LINES = 10  # number of progress reports of a training
ARRIVE_S = 90.0  # time for the robot to arrive [s]; includes compiling
# ramp times of the demo's gate [s]: from zero to the maximum command and to the maximum
# rate
FULL_COMMAND_S = 0.3
FULL_RATE_S = 0.05
R = TypeVar("R")


class Demo:
    """A demo that runs by a plan and tells what it does."""

    def __init__(self, plan: DemoPlan, say: Say) -> None:
        self._plan = plan
        self._say = say
        self._durations_s: dict[str, float] = {}

    def run(self) -> str:
        """Runs all parts and ends their processes; returns the last line. Raises BridgeError."""
        plan = self._plan
        topics = find_spec("rclpy") is not None
        if not topics:
            why = extensions.explain_missing("rclpy")
            self._say(f"only in process: the world 'dds' {why}")
        if plan.policy is not None and is_policy_file(plan.policy):
            check_policy_file(plan.policy)
        model, identified = self._time("generating", self._generate)
        learned = self._time("learning", self.learn, model)
        policy = learned.policy
        summaries = self._time("evaluating", self._evaluate, model, policy)
        here = self._time("driving in process", self._drive, FAST, policy)
        results = DemoResults(
            plan, model, identified, learned, summaries, here, [], None
        )
        # The report takes a while.
        paths = plan.out / "paths.png"
        write_bytes(paths, results.draw_trajectories({LABELS[FAST]: here}))
        self._say(f"  the paths are drawn in {paths}")
        over = ""
        if topics:
            results = self._drive_nodes(results)
            over = f"over DDS {successes(results.there)}/{plan.episodes}, "
        file = plan.out / "report.html"
        self._write_report(file, results)
        return (
            f"demo: in process {successes(here)}/{plan.episodes}, {over}report {file}"
        )

    def _drive_nodes(self, results: DemoResults) -> DemoResults:
        """Returns the results with the same episodes over DDS, and one by the deployed nodes."""
        policy = results.learned.policy
        there = self._time("driving over DDS", self._drive, DDS, policy)
        reached = [episode.seed for episode in there if episode.result == "success"]
        seed = [*reached, 0][0]
        live = self._time("deploying", self._deploy, results.model, policy, seed)
        return replace(results, there=there, live=live)

    def _time(self, name: str, part: Callable[..., R], *arguments: Any) -> R:
        begin = time.perf_counter()
        result = part(*arguments)
        self._durations_s[name] = time.perf_counter() - begin
        self._say(f"  {name} took {self._durations_s[name]:.0f} s")
        return result

    def _write_report(self, file: Path, results: DemoResults) -> None:
        plan = self._plan
        spent = {**self._durations_s, "all": sum(self._durations_s.values())}
        times = [(part, f"{duration:.0f}") for part, duration in spent.items()]
        table = html.make_table(("part", "wall time [s]"), times)
        sections = make_sections(results)
        sections.append(("Time", [html.make_details("Wall time", [table])]))
        lead = (
            f"Robot {results.model.robot.name!r} in the world {plan.world!r}, policy "
            f"{results.learned.policy!r}, simulator generated from "
            f"{plan.recording or 'a textbook drive'}."
        )
        write_text(file, html.make_page("nics_drl_bridge: demo", lead, sections))

    def _generate(self) -> tuple[SimulatorModel, Identified]:
        plan = self._plan
        world = load_world(plan.world)
        if plan.recording is not None:
            robot, recording = open_drive(plan.recording, plan.robot)
        else:
            robot = load_robot(plan.robot or DEFAULT_ROBOT)
            file = plan.out / "recording.npz"
            self._say(f"recording a drive of the textbook {robot.name!r} robot")
            rng = np.random.default_rng(RECORDING_SEED)
            save_recording(textbook.record(robot, rng), file)
            recording = read_recording(file, robot)
        source = recording.source
        self._say(f"generating a simulator of the robot {robot.name!r} from {source}")
        # The demo must steer even if the drive did not show it; the report lists the
        # assumptions.
        model, identified = generate(
            recording, robot, mount_lidar(robot), world.shapes, assume=True
        )
        save_model(model, plan.model)
        self._say(format_opening(source, identified))
        return model, identified

    def learn(self, model: SimulatorModel) -> Learned:
        """Trains a policy, unless one is given or a module is missing. Raises BridgeError."""
        policy = self._plan.policy
        if policy is not None:
            open_policy(policy, model)
            return Learned(
                policy, f"The policy {policy!r} was given; none was trained."
            )
        missing = extensions.find_lacking(extensions.TRAINING)
        if missing is None:
            return self._train(model)
        policy = BASELINE
        name = model.robot.name
        deploys = find_spec("onnxruntime") and find_spec("onnx")
        if name in list_shipped_policies() and deploys:
            with suppress(PolicyError):  # a shipped policy may not fit
                open_policy(name, model)
                policy = name
        self._say(
            f"not training, which needs the module {missing!r} (pip install "
            f"'nics_drl_bridge[train,deploy]'); driving with the policy {policy!r} instead"
        )
        why = f"No policy was trained because {missing!r} is not installed"
        return Learned(policy, f"{why}; {policy!r} is used.")

    def derive_settings(self, model: SimulatorModel) -> Fitted:
        """Returns the demo's training settings, adapted to the plan's simulator and world."""
        plan = self._plan
        chosen = load_training("demo")
        worlds = {plan.world: chosen.num_envs}
        steps = plan.train_steps or chosen.steps
        changes = {"robot": str(plan.model), "worlds": worlds, "steps": steps}
        opened = Opened(model, {plan.world: load_world(plan.world)})
        return fit_settings(chosen.model_copy(update=changes), opened, inherited=True)

    def _train(self, model: SimulatorModel) -> Learned:
        from nics_drl_bridge.policy.train.run import (
            SeedResult,
            export,
            train,
        )

        plan = self._plan
        settings, notes, opened = self.derive_settings(model)
        curve = list[pictures.Point]()
        for line in notes:
            self._say(line)
        self._say(
            f"training a policy for {settings.steps:,} steps in {settings.num_envs} worlds at once"
        )

        def tell(now: Any) -> None:
            before = curve[-1].steps if curve else 0
            curve.append(pictures.Point(now.steps, now.success, now.collision))
            if now.steps * LINES // settings.steps > before * LINES // settings.steps:
                self._say(f"  {now.steps:,} steps: {now.line}")

        trained = train(*opened, settings, TRAINING_SEED, plan.out / "training", tell)
        file = plan.out / "policy.onnx"
        command = f"nics demo --robot {plan.robot or model.robot.name}"
        result = SeedResult(TRAINING_SEED, trained, {})
        export(model, settings, result, command, file)
        how = (
            f"PPO learned it from scratch in the generated simulator: {trained.steps:,} steps, "
            f"{trained.stepping_s:.0f} s of {trained.wall_s:.0f} s in the simulator."
        )
        return Learned(str(file), how, curve)

    def _evaluate(self, model: SimulatorModel, name: str) -> dict[str, Summary]:
        self._say(
            f"evaluating {name} in {MANY} unseen episodes, all at once, then perturbed"
        )
        policy, task = open_policy(name, model)
        world = self._plan.world
        limit = find_pace(model, [load_world(world)]).steps
        summaries = {}
        conditions = {AS_IT_IS: None, **load_randomisation(PERTURBED).alone()}
        for condition, drawn in conditions.items():
            env = BridgeVectorEnv(
                MANY, model, world, task, max_episode_steps=limit, randomisation=drawn
            )
            seeds = range(FIRST_SEED, FIRST_SEED + MANY)
            outcomes = evaluation.drive_worlds(env, policy.act, seeds)
            summary = evaluation.summarise(outcomes, model.control_period)
            summaries[condition] = summary
            self._say(f"  {condition.replace('_', ' ')}: {_format_shares(summary)}")
        return summaries

    def _drive(self, place: str, policy: str) -> list[Episode]:
        plan = self._plan
        what = f"{plan.episodes} episodes in process"
        if place != FAST:
            what = f"the same {plan.episodes} episodes over DDS in lock-step"
        self._say(f"driving {what}")
        return drive_in(
            place,
            policy,
            str(plan.model),
            plan.world,
            range(plan.episodes),
            plan.out / "logs" / place,
            lambda e: self._say(
                f"  seed {e.seed}: {e.result}, {e.steps} steps, {e.length:.2f} m"
            ),
            self._say,
        )

    def _deploy(self, model: SimulatorModel, policy: str, seed: int) -> Episode:
        plan = self._plan
        world = load_world(plan.world)
        scene = sample_scene(world, model.robot.footprint_radius, seed)
        goal = [float(value) for value in scene.goals[0]]
        gate = {
            "use_sim_time": True,
            "e_stop_required": False,
            "limits": str(_write_limits(model.robot, plan.out / "limits.yaml")),
            "black_box": str(plan.out / "black_box"),
        }
        nodes: dict[str, dict[str, Any]] = {
            "simulator_node": {"world": plan.world, "episode_seed": seed},
            "middleware_node": {},
            "command_gate": gate,
            "policy_node": {"policy": policy, "goal": goal},
        }
        self._say(f"deploying {', '.join(nodes)} in real time")
        # The policy stops where it believes the goal is, but its odometry drifts.
        near = Navigation(model.robot, model.lidar).goal_radius + 0.1
        arrived, path = self._watch_episode(nodes, goal, near)
        end = "reached" if arrived else "did not reach"
        self._say(f"  the deployed nodes {end} the goal of seed {seed}")
        result = "success" if arrived else "time-out"
        return Episode(seed, result, path, path, scene.goals[0], scene.bodies, 0.0)

    def _watch_episode(
        self, nodes: dict[str, dict[str, Any]], goal: list[float], near: float
    ) -> tuple[bool, Any]:
        from nics_drl_bridge.nodes.operator import Witness
        from nics_drl_bridge.nodes.processes import NodeProcess, choose_domain_id

        domain_id = choose_domain_id()
        logs = self._plan.out / "logs" / "realtime"
        model = {"model": str(self._plan.model)}
        with ExitStack() as stack:
            witness = stack.enter_context(Witness(domain_id))
            processes = [
                stack.enter_context(
                    NodeProcess(node, logs, model | parameters, domain_id)
                )
                for node, parameters in nodes.items()
            ]
            simulator = processes[0]
            if not witness.sees(START_S):
                simulator.check()
                raise BackendError(
                    f"{simulator.node} has published nothing for {START_S:g} s; see its log, "
                    f"{simulator.log}."
                )
            try:
                armed = witness.arm("", START_S, False, lambda _: None)
            finally:  # the error of a node that ended explains a missing gate
                for process in processes:
                    process.check()
            if not armed.granted:
                raise BackendError(f"command_gate can't be armed: {armed.told}")
            self._say(
                "  command_gate is armed; no emergency stop is required of a simulation"
            )
            arrived = witness.arrives(goal, near, ARRIVE_S)
            for process in processes:
                process.check()
            return arrived, witness.path


def _format_shares(summary: Summary) -> str:
    return ", ".join(
        f"{result} {100 * share.value:.1f} %"
        for result, share in summary.shares.items()
    )


def _write_limits(robot: RobotSpec, path: Path) -> Path:
    commands = {}
    for variable in robot.command:
        low = min(variable.min, 0.0)
        high = max(variable.max, 0.0)
        rate = max(-low, high) / FULL_COMMAND_S
        jerk = rate / FULL_RATE_S
        commands[variable.name] = {"min": low, "max": high, "rate": rate, "jerk": jerk}
    write_text(path, dump_yaml({"robot": robot.name, "commands": commands}))
    return path
