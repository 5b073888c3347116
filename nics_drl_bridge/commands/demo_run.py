"""Runs the parts of the demo in sequence and writes its report, one page with all results."""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import astuple, dataclass
from importlib.util import find_spec
from math import isfinite
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from nics_drl_bridge import defaults, extensions
from nics_drl_bridge.commands.episodes import DDS, FAST, LABELS, START_S, Say, drive_in
from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import BackendError, PolicyError
from nics_drl_bridge.files import write_bytes, write_text
from nics_drl_bridge.generator import SimulatorModel, generate, mount_lidar, save_model
from nics_drl_bridge.identify.identify import Identified
from nics_drl_bridge.identify.report import conclude, format_opening
from nics_drl_bridge.policy import evaluation
from nics_drl_bridge.policy.evaluation import (
    FIRST_SEED,
    Episode,
    Summary,
    deviation,
    successes,
)
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
from nics_drl_bridge.recording.recording import Recording, save_recording
from nics_drl_bridge.report import html, pictures
from nics_drl_bridge.report.fit_page import (
    fit_tile,
    make_path_blocks,
    make_verdict_blocks,
    model_blocks,
)
from nics_drl_bridge.robot import DEFAULT_ROBOT
from nics_drl_bridge.robot.spec import RobotSpec, load_robot
from nics_drl_bridge.sim.randomisation import load_randomisation
from nics_drl_bridge.sim.scenes import sample_scene
from nics_drl_bridge.sim.world import load_world

RECORDING_SEED = 1
TRAINING_SEED = 0
MANY = 500  # number of evaluation episodes in the fast simulator
BASELINE = "dynamic_window"
AS_IT_IS = "as it is"
PERTURBED = "mild"
LINES = 10  # number of progress reports of a training
ARRIVE_S = 90.0  # time for the robot to arrive [s]; includes compiling
# ramp times of the demo's gate [s]: from zero to the maximum command and to the maximum
# rate
FULL_COMMAND_S = 0.3
FULL_RATE_S = 0.05
GOOD = 0.9  # success rate below which the verdict is doubtful
DEMO_PANELS = 9  # maximum number of drawn episodes
R = TypeVar("R")


@dataclass(frozen=True)
class DemoPlan:
    """What a demo uses, and where it writes."""

    out: Path  # output folder
    # name or YAML file, as for the world; None: taken from the recording
    robot: str | None = None
    world: str = defaults.WORLD
    # file of a drive; None: record one with the robot's textbook kinematics
    recording: Path | None = None
    episodes: int = defaults.DEMO_EPISODES  # in process, and as many over DDS
    # policy file or name to use instead of training one
    policy: str | None = None
    # environment steps of the training; None: from `demo.yaml`
    train_steps: int | None = None

    @property
    def model(self) -> Path:
        """Folder of the generated simulator."""
        return self.out / "model"


@dataclass(frozen=True)
class Learned:
    """The demo's policy (file or name), its origin as a sentence, and its training curve."""

    policy: str
    how: str
    curve: Sequence[pictures.Point] = ()


@dataclass(frozen=True)
class DemoEpisodes:
    """Results of the evaluation, and the same episodes driven in process and over DDS.

    Without ROS 2, `there` is empty and `live` is None.
    """

    summaries: Mapping[str, Summary]  # by condition: `AS_IT_IS` and each perturbation
    here: Sequence[Episode]  # in process
    there: Sequence[Episode]  # over DDS
    live: Episode | None  # the deployed episode

    @property
    def summary(self) -> Summary:
        """Summary of the unperturbed episodes."""
        return self.summaries[AS_IT_IS]


def run(plan: DemoPlan, say: Say) -> str:
    """Runs all parts and ends their processes; returns the last line. Raises BridgeError."""
    topics = find_spec("rclpy") is not None
    if not topics:
        say(f"only in process: the world 'dds' {extensions.explain_missing('rclpy')}")
    durations_s: dict[str, float] = {}

    def timed(name: str, part: Callable[..., R], *arguments: Any) -> R:
        begin = time.perf_counter()
        result = part(plan, *arguments, say)
        durations_s[name] = time.perf_counter() - begin
        say(f"  {name} took {durations_s[name]:.0f} s")
        return result

    if plan.policy is not None and is_policy_file(plan.policy):
        check_policy_file(plan.policy)
    model, identified = timed("generating", _generate)
    learned = timed("learning", learn, model)
    summaries = timed("evaluating", _evaluate, model, learned.policy)
    here = timed("driving in process", _drive, FAST, learned.policy)
    _draw_paths(plan, model, here, say)
    there = timed("driving over DDS", _drive, DDS, learned.policy) if topics else []
    live = None
    if topics:
        succeeded = [episode.seed for episode in there if episode.result == "success"]
        seed = succeeded[0] if succeeded else 0
        live = timed("deploying", _deploy, model, learned.policy, seed)
    durations_s["all"] = sum(durations_s.values())
    episodes = DemoEpisodes(summaries, here, there, live)
    sections = make_sections(plan, model, identified, learned, episodes)
    sections.append(("Time", [_fold_durations(durations_s)]))
    file = plan.out / "report.html"
    lead = (
        f"Robot {model.robot.name!r} in the world {plan.world!r}, policy {learned.policy!r}, "
        f"simulator generated from {plan.recording or 'a textbook drive'}."
    )
    write_text(file, html.make_page("nics_drl_bridge: demo", lead, sections))
    over = f"over DDS {successes(there)}/{plan.episodes}, " if topics else ""
    return f"demo: in process {successes(here)}/{plan.episodes}, {over}report {file}"


def _fold_durations(durations_s: Mapping[str, float]) -> str:
    times = [(part, f"{duration:.0f}") for part, duration in durations_s.items()]
    table = html.make_table(("part", "wall time [s]"), times)
    return html.make_details("Wall time", [table])


def _draw_paths(
    plan: DemoPlan, model: SimulatorModel, episodes: Sequence[Episode], say: Say
) -> None:
    """Draws the paths of the first episodes, because the report takes a while."""
    paths = plan.out / "paths.png"
    radius = model.robot.footprint_radius
    shown = {LABELS[FAST]: episodes}
    world = load_world(plan.world)
    write_bytes(paths, pictures.draw_trajectories(shown, world, radius))
    say(f"  the paths are drawn in {paths}")


def _record_or_read(plan: DemoPlan, say: Say) -> tuple[RobotSpec, Recording]:
    """Reads the plan's drive and its robot, or records a drive of a textbook robot."""
    if plan.recording is not None:
        return open_drive(plan.recording, plan.robot)
    robot = load_robot(plan.robot or DEFAULT_ROBOT)
    file = plan.out / "recording.npz"
    say(f"recording a drive of the textbook {robot.name!r} robot")
    save_recording(textbook.record(robot, np.random.default_rng(RECORDING_SEED)), file)
    return robot, read_recording(file, robot)


def _generate(plan: DemoPlan, say: Say) -> tuple[SimulatorModel, Identified]:
    world = load_world(plan.world)
    robot, recording = _record_or_read(plan, say)
    say(f"generating a simulator of the robot {robot.name!r} from {recording.source}")
    # The demo must steer even if the drive did not show it; the report lists the
    # assumptions.
    model, identified = generate(
        recording, robot, mount_lidar(robot), world.shapes, assume=True
    )
    save_model(model, plan.model)
    say(format_opening(recording.source, identified))
    return model, identified


def learn(plan: DemoPlan, model: SimulatorModel, say: Say) -> Learned:
    """Trains a policy, unless one is given or a module is missing. Raises BridgeError."""
    if plan.policy is not None:
        open_policy(plan.policy, model)
        return Learned(
            plan.policy, f"The policy {plan.policy!r} was given; none was trained."
        )
    missing = extensions.find_lacking(extensions.TRAINING)
    if missing is None:
        return _train_policy(plan, model, say)
    policy = BASELINE
    if (
        model.robot.name in list_shipped_policies()
        and find_spec("onnxruntime")
        and find_spec("onnx")
    ):
        with suppress(PolicyError):  # a shipped policy may not fit
            open_policy(model.robot.name, model)
            policy = model.robot.name
    say(
        f"not training, which needs the module {missing!r} (pip install "
        f"'nics_drl_bridge[train,deploy]'); driving with the policy {policy!r} instead"
    )
    return Learned(
        policy,
        f"No policy was trained because {missing!r} is not installed; {policy!r} is "
        "used.",
    )


def derive_settings(plan: DemoPlan, model: SimulatorModel) -> Fitted:
    """Returns the demo's training settings, adapted to the plan's simulator and world."""
    chosen = load_training("demo")
    worlds = {plan.world: chosen.num_envs}
    steps = plan.train_steps or chosen.steps
    changes = {"robot": str(plan.model), "worlds": worlds, "steps": steps}
    opened = Opened(model, {plan.world: load_world(plan.world)})
    return fit_settings(chosen.model_copy(update=changes), opened, inherited=True)


def _train_policy(plan: DemoPlan, model: SimulatorModel, say: Say) -> Learned:
    from nics_drl_bridge.policy.train.run import (  # needs torch
        SeedResult,
        export,
        train,
    )

    settings, notes, opened = derive_settings(plan, model)
    curve = list[pictures.Point]()
    for line in notes:
        say(line)
    say(
        f"training a policy for {settings.steps:,} steps in {settings.num_envs} worlds at once"
    )

    def tell(progress: Any) -> None:
        before = curve[-1].steps if curve else 0
        curve.append(
            pictures.Point(progress.steps, progress.success, progress.collision)
        )
        if progress.steps * LINES // settings.steps > before * LINES // settings.steps:
            say(f"  {progress.steps:,} steps: {progress.line}")

    trained = train(*opened, settings, TRAINING_SEED, plan.out / "training", tell)
    result = SeedResult(TRAINING_SEED, trained, {})
    file = plan.out / "policy.onnx"
    command = f"nics demo --robot {plan.robot or model.robot.name}"
    export(model, settings, result, command, file)
    steps = (
        f"{trained.steps:,} steps, {trained.stepping_s:.0f} s of {trained.wall_s:.0f} s"
    )
    how = f"PPO learned it from scratch in the generated simulator: {steps} in the simulator."
    return Learned(str(file), how, curve)


def _evaluate(
    plan: DemoPlan, model: SimulatorModel, name: str, say: Say
) -> dict[str, Summary]:
    say(f"evaluating {name} in {MANY} unseen episodes, all at once, then perturbed")
    policy, task = open_policy(name, model)
    limit = find_pace(model, [load_world(plan.world)]).steps
    summaries = {}
    for condition, drawn in {
        AS_IT_IS: None,
        **load_randomisation(PERTURBED).alone(),
    }.items():
        options: dict[str, Any] = {"max_episode_steps": limit, "randomisation": drawn}
        env = BridgeVectorEnv(MANY, model, plan.world, task, **options)
        outcomes = evaluation.drive_worlds(
            env, policy.act, range(FIRST_SEED, FIRST_SEED + MANY)
        )
        summary = evaluation.summarise(outcomes, model.control_period)
        summaries[condition] = summary
        say(f"  {condition.replace('_', ' ')}: {_format_shares(summary)}")
    return summaries


def _format_shares(summary: Summary) -> str:
    return ", ".join(
        f"{result} {100 * share.value:.1f} %"
        for result, share in summary.shares.items()
    )


def _drive(plan: DemoPlan, place: str, policy: str, say: Say) -> list[Episode]:
    where = "in process" if place == FAST else "over DDS in lock-step"
    say(
        f"driving {'' if place == FAST else 'the same '}{plan.episodes} episodes {where}"
    )
    seeds = range(plan.episodes)
    logs = plan.out / "logs" / place
    return drive_in(
        place,
        policy,
        str(plan.model),
        plan.world,
        seeds,
        logs,
        lambda e: say(
            f"  seed {e.seed}: {e.result}, {e.steps} steps, {e.length:.2f} m"
        ),
        say,
    )


def _deploy(
    plan: DemoPlan, model: SimulatorModel, policy: str, seed: int, say: Say
) -> Episode:
    scene = sample_scene(load_world(plan.world), model.robot.footprint_radius, seed)
    goal = [float(value) for value in scene.goals[0]]
    model_parameter = {"model": str(plan.model)}
    limits = _write_limits(model.robot, plan.out / "limits.yaml")
    boxes = str(plan.out / "black_box")
    gate = {"use_sim_time": True, "e_stop_required": False}
    nodes: dict[str, dict[str, Any]] = {
        "simulator_node": {
            **model_parameter,
            "world": plan.world,
            "episode_seed": seed,
        },
        "middleware_node": model_parameter,
        "command_gate": {
            **model_parameter,
            **gate,
            "limits": str(limits),
            "black_box": boxes,
        },
        "policy_node": {**model_parameter, "policy": policy, "goal": goal},
    }
    say(f"deploying {', '.join(nodes)} in real time")
    # The policy stops where it believes the goal is, but its odometry drifts.
    near = Navigation(model.robot, model.lidar).goal_radius + 0.1
    arrived, path = _watch_episode(
        nodes, plan.out / "logs" / "realtime", goal, near, say
    )
    say(
        f"  the deployed nodes {'reached' if arrived else 'did not reach'} the goal of seed {seed}"
    )
    result = "success" if arrived else "time-out"
    return Episode(seed, result, path, path, scene.goals[0], scene.bodies, 0.0)


def _watch_episode(
    nodes: dict[str, dict[str, Any]],
    logs: Path,
    goal: list[float],
    near: float,
    say: Say,
) -> tuple[bool, Any]:
    from nics_drl_bridge.nodes.processes import NodeProcess, Witness, free_domain_id

    domain_id = free_domain_id()
    with ExitStack() as stack:
        witness = stack.enter_context(Witness(domain_id))
        processes = []
        for node, parameters in nodes.items():
            processes.append(
                stack.enter_context(NodeProcess(node, logs, parameters, domain_id))
            )
            if node == "simulator_node" and not witness.sees(START_S):
                processes[0].check()
                fix = f"look at its log, {processes[0].log}."
                raise BackendError(
                    f"{node} publishes nothing after {START_S:g} s; {fix}"
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
    commands = {}
    for variable in robot.command:
        low = min(variable.min, 0.0)
        high = max(variable.max, 0.0)
        rate = max(-low, high) / FULL_COMMAND_S
        jerk = rate / FULL_RATE_S
        commands[variable.name] = {"min": low, "max": high, "rate": rate, "jerk": jerk}
    write_text(path, dump_yaml({"robot": robot.name, "commands": commands}))
    return path


def make_sections(
    plan: DemoPlan,
    model: SimulatorModel,
    identified: Identified,
    learned: Learned,
    episodes: DemoEpisodes,
) -> list[tuple[str, Sequence[str]]]:
    """Returns the sections of the report, verdict first: a heading and HTML blocks each."""
    return [
        ("Verdict", _make_verdict(plan, learned, identified, episodes)),
        ("Paths in the world", _format_episodes(plan, model, episodes)),
        ("The policy", _make_policy_lines(plan, learned, episodes)),
        ("Paths of the model", make_path_blocks(identified)),
        ("The model", model_blocks(model.robot, identified, model.report)),
    ]


def _make_verdict(
    plan: DemoPlan, learned: Learned, identified: Identified, episodes: DemoEpisodes
) -> Sequence[str]:
    summary = episodes.summary
    here = episodes.here
    there = episodes.there
    success = summary.success
    dds_successes = successes(there)
    arrived = episodes.live is not None and episodes.live.result == "success"
    between = f"95 % confidence: {100 * success.low:.1f} to {100 * success.high:.1f} %"
    tiles = [
        fit_tile(identified),
        (
            f"{100 * success.value:.1f} %",
            f"of {summary.episodes} unseen episodes succeed in the fast simulator ({between})",
            success.value >= GOOD,
        ),
        (
            f"{dds_successes} of {len(there)}",
            f"episodes succeed over DDS; in process, {successes(here)} of the same {len(here)}",
            dds_successes >= GOOD * len(there),
        ),
        ("arrived" if arrived else "did not arrive", "deployed, in real time", arrived),
    ]
    conclusion = conclude(identified)
    tiles = tiles if episodes.live else tiles[:2]
    if conclusion.ready:
        more = "drive more episodes, or use a recording of your own robot"
        next_step = (
            more if success.value >= GOOD else "train longer, with --train-steps"
        )
        conclusion = conclusion._replace(advice=f"Next: {next_step}.")
    return make_verdict_blocks(
        tiles,
        conclusion,
        f"nics watch {learned.policy} --model {plan.model} --world {plan.world}",
        f"nics evaluate {learned.policy} --model {plan.model} --world {plan.world}",
        "nics demo --recording DRIVE --robot ROBOT.yaml  # your own robot",
    )


def _make_policy_lines(
    plan: DemoPlan, learned: Learned, episodes: DemoEpisodes
) -> list[str]:
    summary = episodes.summary
    blocks = [html.make_paragraph(learned.how)]
    if learned.curve:
        caption = "Success and collisions during exploration; every episode is new."
        curve = pictures.draw_training_curve(learned.curve)
        blocks.append(html.make_picture(curve, caption))
    text = (
        f"{summary.episodes} unseen episodes in the world {plan.world!r}, in parallel in the fast "
        "simulator, without exploration; path and time are means of the successful ones. Below, "
        f"each perturbation of {PERTURBED!r} alone."
    )
    return [
        *blocks,
        html.make_paragraph(text),
        html.make_table(("", "value", "95 % from", "to"), _list_results(episodes)),
    ]


def _list_results(episodes: DemoEpisodes) -> list[tuple[str, ...]]:
    """Returns a row for each result of the evaluation: its name, value, and 95 % bounds."""
    summary = episodes.summary
    perturbed = {
        f"success with {what.replace('_', ' ')}": summary.success
        for what, summary in episodes.summaries.items()
        if what != AS_IT_IS
    }
    rows = list[tuple[str, ...]]()
    for name, fraction in {**summary.shares, **perturbed}.items():
        rows.append((name, *(f"{100 * value:.1f} %" for value in astuple(fraction))))
    for name, amount in (("path [m]", summary.length), ("time [s]", summary.time)):
        texts = (
            f"{value:.2f}" if isfinite(value) else "-" for value in astuple(amount)
        )
        rows.append((name, *texts))
    return rows


def _format_episodes(
    plan: DemoPlan, model: SimulatorModel, episodes: DemoEpisodes
) -> list[str]:
    here = episodes.here
    there = episodes.there
    live = episodes.live
    labels = (LABELS[FAST], LABELS[DDS])
    world = load_world(plan.world)
    radius = model.robot.footprint_radius
    if live is None:
        text = f"{successes(here)} of {len(here)} episodes reached the goal in process."
        alone = {labels[0]: here[:DEMO_PANELS]}
        png = pictures.draw_trajectories(alone, world, radius)
        return [html.make_paragraph(text), html.make_picture(png, "")]
    shown = {
        labels[0]: here[:DEMO_PANELS],
        labels[1]: there[:DEMO_PANELS],
        "deployed": [live if a.seed == live.seed else None for a in here][:DEMO_PANELS],
    }
    text = (
        f"{successes(here)} of {len(here)} episodes reached the goal in process, "
        f"{successes(there)} of {len(there)} over DDS in lock-step. Then simulator_node in real "
        "time, middleware_node, policy_node and command_gate ran as separate processes, not in "
        f"lock-step. The robot {'reached' if live.result == 'success' else 'did not reach'} "
        f"its goal, that of seed {live.seed}."
    )
    about = "Deviation is the greatest distance between the two true paths at the same step."
    table = _make_episode_table(here, there)
    return [
        html.make_paragraph(text),
        html.make_picture(pictures.draw_trajectories(shown, world, radius), ""),
        html.make_details("Episode by episode", [html.make_paragraph(about), table]),
    ]


def _make_episode_table(here: Sequence[Episode], there: Sequence[Episode]) -> str:
    rows = [
        (
            f"{a.seed}",
            a.result,
            f"{a.steps}",
            f"{a.length:.2f}",
            b.result,
            f"{b.steps}",
            f"{b.length:.2f}",
            f"{deviation(a, b):.1g}",
        )
        for a, b in zip(here, there, strict=True)
    ]
    columns = ("steps", "path [m]")
    heads = ("seed", LABELS[FAST], *columns, LABELS[DDS], *columns, "deviation [m]")
    return html.make_table(heads, rows)
