"""Adversarial policies through the gate with its shipped shield: does any robot touch anything?

Three kinds of robots drive in the worlds `arena`, `clutter` and `crowd`, each behind a gate with
the shield as it is shipped, with delays to and from the gate that are drawn up to what a robot may
have. With `--over-dds` each gate is a `command_gate` process, in real time. An adversary knows the
true scene and tries hard: it rams the nearest thing, grazes it, turns into it at the last moment,
or jerks the robot about. Some episodes are driven again without the shield, to show that the
adversaries are some; and a policy that means well drives with and without, to show what the shield
costs.

A touch of a robot that moves is a contact; one that stands when something comes to touch it was
walked into, which no shield prevents. Over DDS this process is all the robots: when it was held up
itself, the running episodes are driven again, and when that was often, the run is none.
"""

from __future__ import annotations

import math
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from campaign import Given, Result, at_least, at_most, missed_bars, run_campaign
from parts.braking import braking_used

from nics_drl_bridge.gate.assurance import episodes
from nics_drl_bridge.gate.assurance.adversaries import ADVERSARIES
from nics_drl_bridge.gate.assurance.place import (
    ADVERSARY_S,
    POLICY,
    Job,
    Outcome,
    Place,
)
from nics_drl_bridge.generator import builtin_model

ROBOTS = ("ackermann", "differential", "mecanum")
WORLDS = ("arena", "clutter", "crowd")
OUTLINED = "jackal"  # has an outline, and a lidar that does not look behind it
WITHOUT, GOALS = 10, 10
"""One in so many episodes is driven without the shield as well; and so many goals are tried."""
LEAST_PATH = 0.5
LEAST_CONTACTS_WITHOUT = 0.4
MOST_LATCHED = 0.1
LEAST_GOALS = 0.6
MOST_HELD_UP = 0.02
"""Of the time that this process ran; beyond it the machine was too busy for a run in real time."""
NOTHING = {"latency": 0.0, "deceleration": 1e3, "margin": 0.0, "obstacle_speed": 0.0}


def plan_jobs(
    count: int, seed: int, places: int, standing: bool
) -> tuple[list[list[Job]], list[list[Job]]]:
    """The episodes of each place: with the shield, and without it."""
    with_it: list[list[Job]] = [[] for _ in range(places)]
    without: list[list[Job]] = [[] for _ in range(places)]
    kinds = tuple(ADVERSARIES)
    for index in range(count):
        kind = kinds[index // places % len(kinds)]
        job = Job(kind, seed + index, standing)
        with_it[index % places].append(job)
        if index // places % WITHOUT == 0 or (
            index < places * len(ADVERSARIES) and not index % 2
        ):
            without[index % places].append(job)
    for index in range(max(places, count // GOALS)):
        job = Job(POLICY, seed + index, standing)
        with_it[index % places].append(job)
        without[index % places].append(job)
    return with_it, without


def drive(
    places: Sequence[Place],
    jobs: Sequence[Sequence[Job]],
    shield: dict[str, float] | None,
) -> list[Outcome]:
    """All episodes."""
    found = []
    for place, some in zip(places, jobs, strict=True):
        config = episodes.configure_gate(
            place.model, place.robot, shield, shielded=shield is not None
        )
        found += [episodes.drive(place, config, job) for job in some]
        sys.stderr.write(f"{place.robot} in {place.world}: {len(some)} episodes\n")
    return found


def drive_over_dds(
    places: Sequence[Place],
    jobs: Sequence[Sequence[Job]],
    shield: dict[str, float] | None,
) -> tuple[list[Outcome], float]:
    """All episodes side by side; and the share of the time for which this process was held up."""
    from parts import shield_over_dds  # needs ROS 2

    given: dict[str, float | bool] = {"shield": False}
    if shield is not None:
        given = {f"shield_{name}": value for name, value in shield.items()}
    with tempfile.TemporaryDirectory() as folder:
        outcomes, held_up = shield_over_dds.drive(
            places,
            jobs,
            given,
            Path(folder),
            lambda line: sys.stderr.write(f"{line}\n"),
        )
    return outcomes, held_up.seconds / max(held_up.of_s, 1e-9)


def summarise(shielded: Sequence[Outcome], bare: Sequence[Outcome]) -> Result:
    """The figures."""
    tried, goals = split_by_kind(shielded)
    without, goals_without = split_by_kind(bare)
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
        "goals_reached_without": sum(one.reached for one in goals_without),
        "touched": [
            f"{one.kind} {one.robot} {one.world} {one.seed} at {one.speed:.3f} m/s, "
            f"its gate silent for up to {one.silence:.2f} s"
            for one in touched
        ],
    }


def split_by_kind(
    outcomes: Sequence[Outcome],
) -> tuple[list[Outcome], list[Outcome]]:
    """Episodes of adversaries, and those with a goal."""
    tried = [one for one in outcomes if one.kind != POLICY]
    return tried, [one for one in outcomes if one.kind == POLICY]


def open_place(name: str) -> Place:
    """A shipped robot in a shipped world, by the name robot/world."""
    robot, world = name.split("/")
    return Place(builtin_model(robot), world)


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
    controls = {"no_shield": None, "no_braking_distance": NOTHING}
    shield = controls.get(given.control, {})
    places = [open_place(name) for name in given.place]
    stands = given.control == "standing"
    with_it, without = plan_jobs(given.episodes, given.seed, len(places), stands)
    held_up = [0.0]
    if given.over_dds:
        shielded, first = drive_over_dds(places, with_it, shield)
        bare, second = drive_over_dds(places, without, None)
        held_up = [first, second]
    else:
        shielded = drive(places, with_it, shield)
        bare = drive(places, without, None)
    return {
        **summarise(shielded, bare),
        "asked": given.episodes,
        "driven": "over DDS" if given.over_dds else "in process",
        "held_up_share": max(held_up),
        "braking": max(braking_used(place.robot, shield) for place in places),
    }


OPTIONS = {
    "episodes": (300, f"of {ADVERSARY_S:g} s each"),
    "seed": 0,
    "over-dds": (False, "with processes, in real time; not of the outlined robot"),
    "place": {
        "nargs": "+",
        "choices": [f"{r}/{world}" for r in (*ROBOTS, OUTLINED) for world in WORLDS],
        "default": [f"{robot}/{world}" for robot in ROBOTS for world in WORLDS],
    },
}

if __name__ == "__main__":
    run_campaign(measure, judge, OPTIONS)
