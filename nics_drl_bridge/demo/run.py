"""The demo's parts, one after the other."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from nics_drl_bridge.calibration.identify import Identified
from nics_drl_bridge.demo.deploy import deploy
from nics_drl_bridge.demo.learn import learn
from nics_drl_bridge.demo.plan import Outcome, Plan, Say
from nics_drl_bridge.demo.report import Shown, report
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import MISSING_ROS, ConfigError
from nics_drl_bridge.files import write_text
from nics_drl_bridge.generator import SimulatorModel, generate, save_model
from nics_drl_bridge.kinematics import textbook
from nics_drl_bridge.kinematics.readers import read_recording
from nics_drl_bridge.kinematics.recording import save_recording
from nics_drl_bridge.kinematics.spec import RobotSpec, load_robot
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.policy.evaluation import Episode, successes
from nics_drl_bridge.policy.evaluation_batch import FIRST_SEED, Summary, drive_worlds, summarise
from nics_drl_bridge.policy.policies import open_policy
from nics_drl_bridge.sim.world import load_world
from nics_drl_bridge.trial import DDS, FAST, Trial, drive_in

RECORDING_SEED = 1
MANY = 500
"""Episodes of the evaluation in the fast simulator."""


@dataclass
class Clock:
    """Tells how long each part of the demo took."""

    say: Say
    took: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Times what is done within."""
        begin = time.perf_counter()
        yield
        self.took[name] = time.perf_counter() - begin
        self.say(f"  {name} took {self.took[name]:.0f} s")


def run(plan: Plan, say: Say) -> Outcome:
    """Generates a simulator, learns to drive in it, drives the same over DDS, and reports.

    Every process that it starts has ended when it returns or raises.

    Args:
        plan: what to do.
        say: takes each line of progress.

    Raises:
        BridgeError: a bad recording or name, or a node that does not come up.
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
    return Outcome(successes(here), successes(there), plan.episodes, page)


def _generate(plan: Plan, say: Say) -> tuple[SimulatorModel, Identified]:
    robot, world = load_robot(plan.robot), load_world(plan.world)
    source = plan.recording or _record(robot, plan.out / "recording.npz", say)
    say(f"generating a simulator of the robot {robot.name!r} from {source}")
    recording = read_recording(source, robot)
    # A demo has to steer, even if the drive never did; the report names what is assumed.
    model, identified = generate(recording, robot, load_lidar("paper"), world.shapes, assume=True)
    save_model(model, plan.model)
    say(model.report.rstrip())
    return model, identified


def _record(robot: RobotSpec, path: Path, say: Say) -> Path:
    say(f"recording a drive of the textbook {robot.name!r} robot")
    save_recording(textbook.record(robot, np.random.default_rng(RECORDING_SEED)), path)
    return path


def _evaluate(plan: Plan, model: SimulatorModel, name: str, say: Say) -> Summary:
    """Many unseen episodes side by side, without the estimator."""
    say(f"evaluating {name} in {MANY} unseen episodes, all at once")
    policy, task = open_policy(name, model)
    env = BridgeVectorEnv(MANY, model, plan.world, task)
    outcomes = drive_worlds(env, policy.act, range(FIRST_SEED, FIRST_SEED + MANY))
    summary = summarise(outcomes, model.control_period)
    rates = (summary.success, summary.collision, summary.time_out)
    named = zip(("success", "collision", "time-out"), rates, strict=True)
    say("  " + ", ".join(f"{word} {100 * rate.value:.1f} %" for word, rate in named))
    return summary


def _drive(place: str, what: str, plan: Plan, policy: str, say: Say) -> list[Episode]:
    """The plan's episodes in one of `trial.PLACES`, told of one by one."""
    say(f"{what} {'in process' if place == FAST else 'over DDS in lock-step'}")
    return drive_in(
        place,
        Trial(policy, str(plan.model), plan.world, range(plan.episodes), plan.out / "logs" / place),
        lambda e: say(f"  seed {e.seed}: {e.result}, {e.steps} steps, {e.length:.2f} m"),
        say,
    )
