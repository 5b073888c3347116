"""The demo's report: one page with all results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from nics_drl_bridge.commands.demo_plan import DemoPlan
from nics_drl_bridge.commands.demo_policy import Learned, Live
from nics_drl_bridge.commands.episodes import DDS, FAST, LABELS
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.identify.identify import Identified
from nics_drl_bridge.policy.evaluation import Episode, deviation, successes
from nics_drl_bridge.policy.evaluation_batch import Summary
from nics_drl_bridge.policy.statistics import ConfidenceInterval
from nics_drl_bridge.report.calibration_pictures import CAPTIONS, calibration_pictures
from nics_drl_bridge.report.fit_pictures import accuracy
from nics_drl_bridge.report.page import Block, Code, Picture, Table, page
from nics_drl_bridge.report.pictures import training_curve, trajectories
from nics_drl_bridge.sim.world import load_world

IN_PROCESS, OVER_DDS = LABELS[FAST], LABELS[DDS]
PANELS = 9
"""Maximum number of episodes that are drawn."""


@dataclass(frozen=True)
class Shown:
    """All results of the demo.

    Attributes:
        model, identified: the generated model, and the identification that it is based on.
        learned: the policy.
        summary: of the policy's many episodes in the fast simulator.
        here, there: the same episodes in process and over DDS.
        live: drive of the deployed nodes.
        took: part of the demo -> wall time [s].
    """

    model: SimulatorModel
    identified: Identified
    learned: Learned
    summary: Summary
    here: Sequence[Episode]
    there: Sequence[Episode]
    live: Live
    took: dict[str, float]


def report(plan: DemoPlan, shown: Shown) -> str:
    """Builds the page, as HTML."""
    sections: list[tuple[str, Sequence[Block]]] = [
        ("The model", _model(plan, shown)),
        ("The policy", _policy(plan, shown)),
        ("The same episodes, in process and over DDS", _episodes(plan, shown)),
        ("Deployed", _deployed(plan, shown)),
        ("Time", [Table(("part", "wall time [s]"), _times(shown.took))]),
    ]
    policy = shown.learned.policy
    lead = f"Robot {shown.model.robot.name!r} in the world {plan.world!r}, policy {policy!r}."
    return page("nics_drl_bridge: demo", lead, sections)


def _model(plan: DemoPlan, shown: Shown) -> list[Block]:
    calibrated = calibration_pictures(shown.model.robot, shown.identified)
    return [
        "Generated from " + str(plan.recording or "a textbook drive") + ".",
        Code(shown.model.report),
        Picture(
            accuracy(shown.identified),
            "What each further term is worth; circles mark how many are kept.",
        ),
        *(Picture(picture, CAPTIONS[name]) for name, picture in calibrated.items()),
    ]


def _policy(plan: DemoPlan, shown: Shown) -> list[Block]:
    blocks: list[Block] = [shown.learned.how]
    if shown.learned.curve:
        caption = "Success and collisions while it explores; all episodes are new ones."
        blocks.append(Picture(training_curve(shown.learned.curve), caption))
    summary = shown.summary
    rows = [
        *(
            (name, *(f"{100 * value:.1f} %" for value in _ends(share)))
            for name, share in (
                ("success", summary.success),
                ("collision", summary.collision),
                ("time-out", summary.time_out),
            )
        ),
        *(
            (name, *(f"{value:.2f}" for value in _ends(amount)))
            for name, amount in (("path [m]", summary.length), ("time [s]", summary.time))
        ),
    ]
    told = (
        f"{summary.episodes} unseen episodes in the world {plan.world!r}, side by side in the fast "
        "simulator, the policy at its best; path and time are means of the successful ones."
    )
    return [*blocks, told, Table(("", "value", "95 % from", "to"), rows)]


def _ends(estimate: ConfidenceInterval) -> tuple[float, float, float]:
    return estimate.value, estimate.low, estimate.high


def _episodes(plan: DemoPlan, shown: Shown) -> list[Block]:
    here, there = shown.here, shown.there
    rows = [
        (
            str(a.seed), a.result, f"{a.steps}", f"{a.length:.2f}", b.result, f"{b.steps}",
            f"{b.length:.2f}", f"{deviation(a, b):.1g}",
        )
        for a, b in zip(here, there, strict=True)
    ]  # fmt: skip
    head = ("seed", IN_PROCESS, "steps", "path [m]", OVER_DDS, "steps", "path [m]", "deviation [m]")
    runs = {IN_PROCESS: here[:PANELS], OVER_DDS: there[:PANELS]}
    both = trajectories(runs, load_world(plan.world), shown.model.robot.footprint_radius)
    return [
        f"{successes(here)} of {len(here)} episodes reached the goal in process, "
        f"{successes(there)} of {len(there)} over DDS in lock-step. Deviation is the "
        "greatest distance between the two true paths at the same step.",
        Table(head, rows),
        Picture(both, "Blue: in process. Red, dashed: over DDS."),
    ]


def _deployed(plan: DemoPlan, shown: Shown) -> list[Block]:
    live = shown.live
    beside = [episode for episode in shown.here if episode.seed == live.path.seed]
    drawn = trajectories(
        {IN_PROCESS: beside, "deployed": [live.path]},
        load_world(plan.world),
        shown.model.robot.footprint_radius,
    )
    return [
        "simulator_node in real time, middleware_node, policy_node and command_gate ran as "
        "processes of their own; nobody stepped them. The robot "
        f"{'reached' if live.arrived else 'did not reach'} its goal.",
        Picture(drawn, "The true path of the deployed robot beside the lock-step one."),
    ]


def _times(took: dict[str, float]) -> list[tuple[str, str]]:
    total = ("all", f"{sum(took.values()):.0f}")
    return [*((part, f"{seconds:.0f}") for part, seconds in took.items()), total]
