"""Adversarial policies through the gate with its shipped shield: does any robot touch anything?

Over DDS and in real time: a `command_gate` process for each of nine robots, three kinds of them in
the worlds `arena`, `clutter` and `crowd`, with the shield as it is shipped. An adversary knows the
true scene and tries hard: it rams the nearest thing, grazes it, turns into it at the last moment,
or jerks the robot about. Some episodes are driven again without the shield, to show that the
adversaries are some; and a policy that means well drives with and without, to show what the shield
costs. `--in-process` drives the same without processes, with drawn delays, many times as fast.

A touch of a robot that moves is a contact; one that stands when something comes to touch it was
walked into, which no shield prevents. Over DDS this process is all the robots: when it was held up
itself, the running episodes are driven again, and when that was often, the run is none.
"""

from __future__ import annotations

import math
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from campaign import Given, Result, at_least, at_most, missed_bars, run_campaign
from parts import shield_in_process
from parts.adversaries import ADVERSARIES
from parts.braking import braking_used
from parts.shield_places import ADVERSARY_S, GOAL, Job, Outcome, Place

from nics_drl_bridge.gate.state import GateConfig

ROBOTS = ("ackermann", "differential", "mecanum")
WORLDS = ("arena", "clutter", "crowd")
OUTLINED = "jackal"  # has an outline, and a lidar that does not look behind it
WITHOUT, GOALS = 10, 10
"""One in so many episodes is driven without the shield as well; and so many goals are tried."""
MOST_HELD_UP = 0.02
"""Of the time that this process ran; beyond it the machine was too busy for a run in real time."""
LEAST_PATH = 0.5
LEAST_CONTACTS_WITHOUT = 0.4
MOST_LATCHED = 0.1
LEAST_GOALS = 0.6
HELD_UP = ("count", "seconds", "of_s", "repeated")
NOTHING = {"latency": 0.0, "deceleration": 1e3, "margin": 0.0, "obstacle_speed": 0.0}


@dataclass(frozen=True)
class Plan:
    """What is driven.

    Attributes:
        episodes: of adversaries.
        seed: of the first scene.
        in_process: without processes.
        control: what is taken out; empty for nothing.
        at_once: so many robots, each with its gate's process, drive side by side over DDS.
    """

    episodes: int
    seed: int
    in_process: bool
    control: str
    at_once: int = len(ROBOTS) * len(WORLDS)

    @property
    def shield(self) -> dict[str, float] | None:
        """What goes before the shipped values; None for no shield."""
        if self.control == "no_shield":
            return None
        return NOTHING if self.control == "no_braking_distance" else {}

    def jobs(self, places: int) -> tuple[list[list[Job]], list[list[Job]]]:
        """The episodes of each place: with the shield, and without it."""
        standing = self.control == "standing"
        with_it: list[list[Job]] = [[] for _ in range(places)]
        without: list[list[Job]] = [[] for _ in range(places)]
        for index in range(self.episodes):
            kind = ADVERSARIES[index // places % len(ADVERSARIES)]
            job = Job(kind, self.seed + index, standing)
            with_it[index % places].append(job)
            if index // places % WITHOUT == 0 or (
                index < places * len(ADVERSARIES) and not index % 2
            ):
                without[index % places].append(job)
        for index in range(max(places, self.episodes // GOALS)):
            job = Job(GOAL, self.seed + index, standing)
            with_it[index % places].append(job)
            without[index % places].append(job)
        return with_it, without


def drive(
    plan: Plan, places: Sequence[Place], jobs: Sequence[Sequence[Job]], shield: Any
) -> tuple[list[Outcome], Mapping[str, float]]:
    """All episodes, in process or over DDS; and how well this process kept up, for the latter."""
    if plan.in_process:
        found = []
        for place, some in zip(places, jobs, strict=True):
            config = shield_in_process.config_of(place, shield)
            found += shield_in_process.drive(place, config, some)
            sys.stderr.write(f"{place.robot} in {place.world}: {len(some)} episodes\n")
        return found, {}
    from parts import shield_over_dds  # needs ROS 2

    given: dict[str, Any] = {"shield": False}
    if shield is not None:
        given = {f"shield_{name}": value for name, value in shield.items()}
    outcomes = []
    held_up = shield_over_dds.HeldUp()
    for first in range(0, len(places), plan.at_once):
        some = slice(first, first + plan.at_once)
        with tempfile.TemporaryDirectory() as folder:
            more, late = shield_over_dds.drive(
                places[some],
                jobs[some],
                given,
                Path(folder),
                lambda line: sys.stderr.write(f"{line}\n"),
            )
        outcomes += more
        held_up.add(late)
    return outcomes, asdict(held_up)


def summary(
    shielded: Sequence[Outcome],
    bare: Sequence[Outcome],
    kept_up: Sequence[Mapping[str, float]],
) -> dict[str, Any]:
    """The figures, for the JSON object."""
    held_up = {name: sum(each[name] for each in kept_up if each) for name in HELD_UP}
    tried = [one for one in shielded if one.kind != GOAL]
    goals = [one for one in shielded if one.kind == GOAL]
    without = [one for one in bare if one.kind != GOAL]
    goals_without = [one for one in bare if one.kind == GOAL]
    touched = [one for one in shielded if one.contact]
    return {
        "episodes": len(tried),
        "contacts": len(touched),
        "walked_into": sum(one.walked_into for one in shielded),
        "path_m": round(math.fsum(one.path for one in tried), 1),
        "latched": sum(bool(one.latched) for one in tried),
        "latched_by": dict(Counter(one.latched for one in tried if one.latched)),
        "tried_without": len(without),
        "contacts_without": sum(one.contact for one in without),
        "goals": len(goals),
        "goals_reached": sum(one.reached for one in goals),
        "goal_s": _mean([one.seconds for one in goals if one.reached]),
        "goals_reached_without": sum(one.reached for one in goals_without),
        "goal_without_s": _mean([one.seconds for one in goals_without if one.reached]),
        "held_up": held_up["count"],
        "held_up_share": round(held_up["seconds"] / max(held_up["of_s"], 1e-9), 4),
        "repeated": held_up["repeated"],
        "gate_paused": sum(one.silence > GateConfig.gap_s for one in shielded),
        "touched": [
            f"{one.kind} {' '.join(map(str, one.where))} at {one.speed:.3f} m/s, "
            f"its gate silent for up to {one.silence:.2f} s"
            for one in touched
        ],
        "by_world": {
            world: {
                "episodes": sum(one.where[1] == world for one in tried),
                "contacts": sum(one.where[1] == world for one in touched),
                "goals_reached": sum(
                    one.reached and one.where[1] == world for one in goals
                ),
                "goals_reached_without": sum(
                    one.reached and one.where[1] == world for one in goals_without
                ),
            }
            for world in WORLDS
        },
    }


def _mean(values: Sequence[float]) -> float | None:
    return round(float(np.mean(values)), 2) if values else None


def judge(result: Result) -> list[str]:
    asked = result["asked"]
    least_contacts = max(1.0, LEAST_CONTACTS_WITHOUT * result["tried_without"])
    least_goals = max(1.0, LEAST_GOALS * result["goals_reached_without"])
    bars = {
        "contacts": at_most(0, "contacts of robots in motion"),
        "episodes": at_least(max(asked, 1), "episodes driven"),
        "path_m": at_least(LEAST_PATH * asked, "path driven [m]"),
        "held_up_share": at_most(
            MOST_HELD_UP, "share of the time for which the robots were held up"
        ),
        "latched": at_most(math.ceil(MOST_LATCHED * asked), "latched stops"),
        "contacts_without": at_least(least_contacts, "contacts without the shield"),
        "goals_reached": at_least(least_goals, "goals reached"),
        "braking": at_most(
            1.0, "braking distance in parts of what the shield keeps free"
        ),
    }
    return missed_bars(result, bars)


def measure(given: Given) -> Result:
    """Drives all episodes, some of them without the shield as well."""
    named = given.place or [f"{robot}/{world}" for robot in ROBOTS for world in WORLDS]
    if not given.in_process and any(name.startswith(OUTLINED) for name in named):
        raise SystemExit(f"the {OUTLINED} drives in process alone; add --in-process")
    plan = Plan(
        given.episodes, given.seed, given.in_process, given.control or "", given.at_once
    )
    places = [Place(*name.split("/")) for name in named]
    with_it, without = plan.jobs(len(places))
    shielded, first = drive(plan, places, with_it, plan.shield)
    bare, second = drive(plan, places, without, None)
    return {
        **summary(shielded, bare, (first, second)),
        "asked": plan.episodes,
        "driven": "in process" if plan.in_process else "over DDS",
        "braking": max(braking_used(place.robot, plan.shield) for place in places),
    }


OPTIONS = {
    "episodes": (300, f"of {ADVERSARY_S:g} s each"),
    "seed": 0,
    "in-process": (False, "without DDS, with drawn delays"),
    "place": {
        "action": "append",
        "choices": [f"{r}/{world}" for r in (*ROBOTS, OUTLINED) for world in WORLDS],
        "help": f"only there; those of the {OUTLINED} go in process alone",
    },
    "at-once": (Plan.at_once, "robots side by side over DDS"),
}

if __name__ == "__main__":
    run_campaign(measure, judge, OPTIONS)
