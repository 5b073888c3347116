"""The demo's plan, its results, and its report: one page with all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

from nics_drl_bridge.commands.episodes import DDS, FAST, LABELS
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.identify.identify import Identified
from nics_drl_bridge.policy.evaluation import Episode, Summary, deviation, successes
from nics_drl_bridge.report.calibration_pictures import CAPTIONS, calibration_pictures
from nics_drl_bridge.report.fit_pictures import accuracy
from nics_drl_bridge.report.page import Block, Code, Picture, Table, page
from nics_drl_bridge.report.pictures import Point, training_curve, trajectories
from nics_drl_bridge.sim.world import load_world

IN_PROCESS, OVER_DDS = LABELS[FAST], LABELS[DDS]
PANELS = 9  # maximum number of episodes that are drawn


@dataclass(frozen=True)
class DemoPlan:
    """Plan of a demo."""

    out: Path  # output folder
    robot: str = "differential"  # name or YAML file, as the world
    world: str = "arena"
    recording: Path | None = None  # of a drive; None makes one with the robot's textbook kinematics
    episodes: int = 5  # number of episodes, in process and again over DDS
    policy: str | None = None  # a policy file or a name, to drive with instead of training one
    train_steps: int | None = None  # environment steps of the training; None: as in `demo.yaml`

    @property
    def model(self) -> Path:
        """Folder of the generated simulator."""
        return self.out / "model"

    @property
    def policy_file(self) -> Path:
        """Path of the trained policy."""
        return self.out / "policy.onnx"


@dataclass(frozen=True)
class Learned:
    """The policy of the demo by file or name, its origin in a sentence, and its training curve."""

    policy: str
    how: str
    curve: Sequence[Point] = ()


@dataclass(frozen=True)
class Live:
    """A drive of the deployed nodes, with its path; `arrived` is True if it reached the goal."""

    arrived: bool
    path: Episode


@dataclass(frozen=True)
class DemoResults:
    """All results of the demo; `here` and `there` are the same episodes in process and over DDS."""

    model: SimulatorModel
    identified: Identified
    learned: Learned
    summary: Summary  # of the policy's many episodes in the fast simulator
    here: Sequence[Episode]
    there: Sequence[Episode]
    live: Live
    took: dict[str, float]  # part of the demo -> wall time [s]


def report(plan: DemoPlan, results: DemoResults) -> str:
    """Builds the page, as HTML."""
    took = {**results.took, "all": sum(results.took.values())}
    times = [(part, f"{seconds:.0f}") for part, seconds in took.items()]
    sections: list[tuple[str, Sequence[Block]]] = [
        ("The model", _model(plan, results)),
        ("The policy", _policy(plan, results)),
        ("The same episodes, in process and over DDS", _episodes(plan, results)),
        ("Deployed", _deployed(plan, results)),
        ("Time", [Table(("part", "wall time [s]"), times)]),
    ]
    policy = results.learned.policy
    lead = f"Robot {results.model.robot.name!r} in the world {plan.world!r}, policy {policy!r}."
    return page("nics_drl_bridge: demo", lead, sections)


def _model(plan: DemoPlan, results: DemoResults) -> list[Block]:
    calibrated = calibration_pictures(results.model.robot, results.identified)
    return [
        f"Generated from {plan.recording or 'a textbook drive'}.",
        Code(results.model.report),
        Picture(
            accuracy(results.identified),
            "What each further term is worth; circles mark how many are kept.",
        ),
        *(Picture(picture, CAPTIONS[name]) for name, picture in calibrated.items()),
    ]


def _policy(plan: DemoPlan, results: DemoResults) -> list[Block]:
    blocks: list[Block] = [results.learned.how]
    if results.learned.curve:
        caption = "Success and collisions while it explores; all episodes are new ones."
        blocks.append(Picture(training_curve(results.learned.curve), caption))
    summary = results.summary
    shares = (summary.success, summary.collision, summary.time_out)
    rows = [
        (name, *(f"{100 * value:.1f} %" for value in astuple(share)))
        for name, share in zip(("success", "collision", "time-out"), shares, strict=True)
    ]
    for name, amount in (("path [m]", summary.length), ("time [s]", summary.time)):
        rows.append((name, *(f"{value:.2f}" for value in astuple(amount))))
    text = (
        f"{summary.episodes} unseen episodes in the world {plan.world!r}, side by side in the fast "
        "simulator, the policy at its best; path and time are means of the successful ones."
    )
    return [*blocks, text, Table(("", "value", "95 % from", "to"), rows)]


def _episodes(plan: DemoPlan, results: DemoResults) -> list[Block]:
    here, there = results.here, results.there
    rows = [
        (
            str(a.seed), a.result, f"{a.steps}", f"{a.length:.2f}", b.result, f"{b.steps}",
            f"{b.length:.2f}", f"{deviation(a, b):.1g}",
        )
        for a, b in zip(here, there, strict=True)
    ]  # fmt: skip
    head = ("seed", IN_PROCESS, "steps", "path [m]", OVER_DDS, "steps", "path [m]", "deviation [m]")
    runs = {IN_PROCESS: here[:PANELS], OVER_DDS: there[:PANELS]}
    both = trajectories(runs, load_world(plan.world), results.model.robot.footprint_radius)
    return [
        f"{successes(here)} of {len(here)} episodes reached the goal in process, "
        f"{successes(there)} of {len(there)} over DDS in lock-step. Deviation is the "
        "greatest distance between the two true paths at the same step.",
        Table(head, rows),
        Picture(both, "Blue: in process. Red, dashed: over DDS."),
    ]


def _deployed(plan: DemoPlan, results: DemoResults) -> list[Block]:
    live = results.live
    beside = [episode for episode in results.here if episode.seed == live.path.seed]
    runs = {IN_PROCESS: beside, "deployed": [live.path]}
    drawn = trajectories(runs, load_world(plan.world), results.model.robot.footprint_radius)
    return [
        "simulator_node in real time, middleware_node, policy_node and command_gate ran as "
        "processes of their own; nobody stepped them. The robot "
        f"{'reached' if live.arrived else 'did not reach'} its goal.",
        Picture(drawn, "The true path of the deployed robot beside the lock-step one."),
    ]
