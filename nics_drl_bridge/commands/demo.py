"""`nics demo`.

Runs the parts of the demo in sequence.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from nics_drl_bridge.commands.console import WorldOption, one_sentence
from nics_drl_bridge.commands.demo_plan import DemoPlan, DemoResult, Say
from nics_drl_bridge.commands.demo_policy import deploy, learn
from nics_drl_bridge.commands.demo_report import Shown, report
from nics_drl_bridge.commands.episodes import DDS, FAST, Trial, drive_in
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import MISSING_ROS, ConfigError
from nics_drl_bridge.files import write_text
from nics_drl_bridge.generator import SimulatorModel, generate, save_model
from nics_drl_bridge.identify.identify import Identified
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.policy.evaluation import Episode, successes
from nics_drl_bridge.policy.evaluation_batch import FIRST_SEED, Summary, drive_worlds, summarise
from nics_drl_bridge.policy.policies import open_policy
from nics_drl_bridge.recording import textbook
from nics_drl_bridge.recording.readers import read_recording
from nics_drl_bridge.recording.recording import save_recording
from nics_drl_bridge.robot.spec import RobotSpec, load_robot
from nics_drl_bridge.sim.world import load_world

QUICK_TO_LEARN, RECORDED = "differential", "ackermann"
"""Default robot of the demo, without and with a recording."""


def demo(
    recording: Annotated[
        Path | None, typer.Option(help="A drive; by default one of the textbook robot.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for everything the demo writes.")] = Path(
        "runs/demo"
    ),
    robot: Annotated[
        str | None,
        typer.Option(
            help="A shipped robot or a YAML file; by default differential, and the car, ackermann, "
            "for a recording."
        ),
    ] = None,
    world: WorldOption = "arena",
    episodes: Annotated[
        int, typer.Option(min=1, help="How many, in process and again over DDS.")
    ] = 5,
    policy: Annotated[
        str | None,
        typer.Option(help="Train none; drive with a policy file, a shipped one or a baseline."),
    ] = None,
    train_steps: Annotated[
        int | None, typer.Option(min=1, help="Environment steps of the training.")
    ] = None,
) -> None:
    """Goes the whole road once: generate, train, evaluate, drive over DDS, deploy, report."""
    with one_sentence():
        from nics_drl_bridge.commands.demo_plan import DemoPlan

        robot = robot or (RECORDED if recording else QUICK_TO_LEARN)
        plan = DemoPlan(out, robot, world, recording, episodes, policy, train_steps)
        outcome = run(plan, lambda line: typer.echo(line))
        typer.echo(outcome.line())


RECORDING_SEED = 1
MANY = 500
"""Episodes of the evaluation in the fast simulator."""


@dataclass
class Clock:
    """Measures and reports the duration of each part of the demo."""

    say: Say
    took: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Times the block."""
        begin = time.perf_counter()
        yield
        self.took[name] = time.perf_counter() - begin
        self.say(f"  {name} took {self.took[name]:.0f} s")


def run(plan: DemoPlan, say: Say) -> DemoResult:
    """Generates a simulator, trains a policy in it, drives it over DDS, and writes the report.

    Every process that this starts has ended when it returns or raises.

    Args:
        plan: the plan.
        say: called with each line of progress.

    Raises:
        BridgeError: a bad recording or name, or a node that does not start.
    """
    if find_spec("rclpy") is None:
        raise ConfigError(f"the demo {MISSING_ROS.format(module='rclpy')}")
    clock = Clock(say)
    with clock.part("generating"):
        model, identified = _generate(plan, say)
    with clock.part("learning"):
        learned = learn(plan, model, say)
    with clock.part("evaluating"):
        summary = _evaluate(plan, model, learned.policy, say)
    with clock.part("driving in process"):
        here = _drive(FAST, f"driving {plan.episodes} episodes", plan, learned.policy, say)
    with clock.part("driving over DDS"):
        there = _drive(DDS, f"driving the same {plan.episodes} episodes", plan, learned.policy, say)
    with clock.part("deploying"):
        arrived = [episode.seed for episode in there if episode.result == "success"]
        live = deploy(plan, model, learned.policy, next(iter(arrived), 0), say)
    shown = Shown(model, identified, learned, summary, here, there, live, clock.took)
    page = plan.out / "report.html"
    write_text(page, report(plan, shown))
    return DemoResult(successes(here), successes(there), plan.episodes, page)


def _generate(plan: DemoPlan, say: Say) -> tuple[SimulatorModel, Identified]:
    robot, world = load_robot(plan.robot), load_world(plan.world)
    source = plan.recording or _record(robot, plan.out / "recording.npz", say)
    say(f"generating a simulator of the robot {robot.name!r} from {source}")
    recording = read_recording(source, robot)
    # The demo has to steer even if the drive never did; the report names the assumptions.
    model, identified = generate(recording, robot, load_lidar("paper"), world.shapes, assume=True)
    save_model(model, plan.model)
    say(model.report.rstrip())
    return model, identified


def _record(robot: RobotSpec, path: Path, say: Say) -> Path:
    say(f"recording a drive of the textbook {robot.name!r} robot")
    save_recording(textbook.record(robot, np.random.default_rng(RECORDING_SEED)), path)
    return path


def _evaluate(plan: DemoPlan, model: SimulatorModel, name: str, say: Say) -> Summary:
    """Drives many unseen episodes at once, without the estimator."""
    say(f"evaluating {name} in {MANY} unseen episodes, all at once")
    policy, task = open_policy(name, model)
    env = BridgeVectorEnv(MANY, model, plan.world, task)
    outcomes = drive_worlds(env, policy.act, range(FIRST_SEED, FIRST_SEED + MANY))
    summary = summarise(outcomes, model.control_period)
    rates = (summary.success, summary.collision, summary.time_out)
    named = zip(("success", "collision", "time-out"), rates, strict=True)
    say("  " + ", ".join(f"{word} {100 * rate.value:.1f} %" for word, rate in named))
    return summary


def _drive(place: str, what: str, plan: DemoPlan, policy: str, say: Say) -> list[Episode]:
    """Drives the plan's episodes in one of `trial.PLACES` and reports each."""
    say(f"{what} {'in process' if place == FAST else 'over DDS in lock-step'}")
    return drive_in(
        place,
        Trial(policy, str(plan.model), plan.world, range(plan.episodes), plan.out / "logs" / place),
        lambda e: say(f"  seed {e.seed}: {e.result}, {e.steps} steps, {e.length:.2f} m"),
        say,
    )
