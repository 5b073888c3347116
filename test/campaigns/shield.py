"""Adversarial policies through the gate with its shipped shield: does any robot touch anything?

Robots drive in the worlds `arena`, `clutter` and `crowd`, each behind a gate with the shield as it
is shipped, with delays to and from the gate that are drawn up to what a robot may have. An
adversary knows the true scene and tries hard: it rams the nearest thing, grazes it, turns into it
at the last moment, or jerks the robot about. Some episodes are driven again without the shield, to
show that the adversaries are some; and a policy that means well drives with and without, to show
what the shield costs.

A touch of a robot that moves is a contact; one that stands when something comes to touch it was
walked into, which no shield prevents.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

from campaign import Bars, Given, Result, at_least, at_most, run_campaign, tell
from parts.braking import measure_braking

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
WITHOUT_EVERY = 10  # one of so many episodes is driven without the shield as well
GOALS_EVERY = 10  # for one of so many episodes, a goal is tried
LEAST_PATH = 0.5
LEAST_CONTACTS_WITHOUT = 0.4
MOST_LATCHED = 0.1
LEAST_GOALS = 0.6
NOTHING = {"latency": 0.0, "deceleration": 1e3, "margin": 0.0, "obstacle_speed": 0.0}
Jobs = list[list[Job]]


def plan_jobs(
    count: int, seed: int, places: int, is_standing: bool
) -> tuple[Jobs, Jobs]:
    """Returns the episodes of each place: with the shield, and without it."""
    with_it: Jobs = [[] for _ in range(places)]
    without: Jobs = [[] for _ in range(places)]
    kinds = tuple(ADVERSARIES)
    for index in range(count):
        turn = index // places
        job = Job(kinds[turn % len(kinds)], seed + index, is_standing)
        with_it[index % places].append(job)
        is_early = turn < len(kinds) and index % 2 == 0
        if is_early or turn % WITHOUT_EVERY == 0:
            without[index % places].append(job)
    for index in range(max(places, count // GOALS_EVERY)):
        for jobs in (with_it, without):
            jobs[index % places].append(Job(POLICY, seed + index, is_standing))
    return with_it, without


def drive(
    places: Sequence[Place], jobs: Jobs, shield: dict[str, float] | None
) -> tuple[list[Outcome], list[Outcome]]:
    """Drives all episodes; returns those of adversaries, and those with a goal."""
    found = []
    for place, own in zip(places, jobs, strict=True):
        config = episodes.configure_gate(
            place.model, place.robot, shield, shielded=shield is not None
        )
        found += [episodes.drive(place, config, job) for job in own]
        tell(f"{place.robot} in {place.world}: {len(own)} episodes")
    tried = [outcome for outcome in found if outcome.kind != POLICY]
    return tried, [outcome for outcome in found if outcome.kind == POLICY]


def set_bars(result: Result) -> Bars:
    asked = result["asked"]
    least_contacts = max(1.0, LEAST_CONTACTS_WITHOUT * result["tried_without"])
    least_goals = max(1.0, LEAST_GOALS * result["goals_reached_without"])
    return {
        "contacts": at_most(0, "contacts of robots in motion"),
        "episodes": at_least(max(asked, 1), "episodes driven"),
        "path_m": at_least(LEAST_PATH * asked, "path driven [m]"),
        "latched": at_most(math.ceil(MOST_LATCHED * asked), "latched stops"),
        "contacts_without": at_least(least_contacts, "contacts without the shield"),
        "goals_reached": at_least(least_goals, "goals reached"),
        "braking": at_most(
            1.0, "braking distance in parts of what the shield keeps free"
        ),
    }


def measure(given: Given) -> Result:
    """Drives all episodes, some of them without the shield as well."""
    controls = {"no_shield": None, "no_braking_distance": NOTHING}
    shield = controls.get(given.control, {})
    named = [name.split("/") for name in given.place]
    places = [Place(builtin_model(robot), world) for robot, world in named]
    is_standing = given.control == "standing"
    jobs, bare = plan_jobs(given.episodes, given.seed, len(places), is_standing)
    tried, goals = drive(places, jobs, shield)
    without, goals_without = drive(places, bare, None)
    touched = [outcome for outcome in (*tried, *goals) if outcome.contact]
    return {
        "asked": given.episodes,
        "episodes": len(tried),
        "contacts": len(touched),
        "walked_into": sum(outcome.walked_into for outcome in (*tried, *goals)),
        "path_m": round(math.fsum(outcome.path for outcome in tried), 1),
        "latched": sum(bool(outcome.latched) for outcome in tried),
        "latched_by": dict(Counter(one.latched for one in tried if one.latched)),
        "tried_without": len(without),
        "contacts_without": sum(outcome.contact for outcome in without),
        "goals": len(goals),
        "goals_reached": sum(outcome.reached for outcome in goals),
        "goals_reached_without": sum(outcome.reached for outcome in goals_without),
        "touched": [
            f"{one.kind} {one.robot} {one.world} {one.seed} at {one.speed:.3f} m/s"
            for one in touched
        ],
        "braking": max(measure_braking(place.robot, shield) for place in places),
    }


OPTIONS = {
    "episodes": (300, f"of {ADVERSARY_S:g} s each"),
    "seed": 0,
    "place": {
        "nargs": "+",
        "choices": [f"{r}/{world}" for r in (*ROBOTS, OUTLINED) for world in WORLDS],
        "default": [f"{robot}/{world}" for robot in ROBOTS for world in WORLDS],
    },
}

if __name__ == "__main__":
    run_campaign(measure, set_bars, OPTIONS)
