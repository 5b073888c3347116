"""Is a body that is held, while its wheels spin, stopped within a second, and nobody else?

In the fast simulator, robots with real lidars' noise are driven by planners, policies and random
commands through the shipped worlds, people among them. Their odometry drifts: scales of path and
turn are wrong, those of a skid-steer robot's turns by 30 %. A gate watches each, and its rule
`body_held` must not stop it in all those hours. Then bodies are held while the wheels turn on, and
the gate must stop each within a second. Nobody obeys the gates, so all is driven as it is.
"""

from __future__ import annotations

import warnings

import numpy as np
from campaign import Bars, Given, Result, at_least, at_most, run_campaign, tell
from parts.held_body import RULE, Case, Tally, drive_freely, hold_bodies

from nics_drl_bridge.gate import scan_motion

HOKUYO = "hokuyo_ust_10lx"
SICK = "sick_tim571"
BURGER = "turtlebot3_burger"
DIFFERENTIAL = "differential"
CASES = (
    Case("jackal", "crowd", turn_scale=1.3),
    Case("jackal", "room", driver="random", rate=20.0, turn_scale=1.3),
    Case(BURGER, "room", rate=5.0),
    Case("turtlebot3_waffle", "arena", driver="random", rate=5.0, path_scale=1.1),
    Case(BURGER, "crowd", rate=5.0, path_scale=0.9, turn_scale=1.3),
    Case(DIFFERENTIAL, "crowd", HOKUYO, "random", 40.0, turn_scale=1.3),
    Case(DIFFERENTIAL, "corridor", "rplidar_a1", rate=5.5, path_scale=0.9),
    Case(
        DIFFERENTIAL, "arena", SICK, "random", beams=180, turn_scale=1.3, dropout=0.05
    ),
    Case(DIFFERENTIAL, "arena", driver=DIFFERENTIAL, turn_scale=1.3),
    Case("mecanum", "clutter", SICK, rate=15.0, path_scale=1.1, dropout=0.1),
    Case("mecanum", "crowd", "rplidar_a2", "random", path_scale=0.95, turn_scale=0.9),
    Case("ackermann", "corridor", HOKUYO, rate=20.0, beams=180),
    Case("ackermann", "doorway", SICK, "random", path_scale=1.05, noise_told=0.0),
)
WORLDS = 8
WITHIN_S = 1.0
# share of the held bodies to be stopped within that time: of some, no scan tells enough
LEAST_STOPPED = 0.94
LEAST_JUDGED = 0.5  # share of the driven time in which scans tell about the motion


def measure(given: Given) -> Result:
    """Drives freely, then holds bodies, in all cases."""
    warnings.simplefilter("ignore")  # robots may go faster than their recordings did
    has_rule = given.control != "rule_off"
    if given.control == "zero_thresholds":
        scan_motion.SETTINGS = scan_motion.Settings(
            min_path=1e-9,
            min_turn=1e-9,
            min_half=0.0,
            min_half_motion=0.0,
            usual_half=1e-9,
            min_change=0.0,
            min_deviations=0.0,
            min_sectors=1,
            min_contradicting=0.0,
            sector_share=np.inf,
            held_share=np.inf,
            confirmed_s=0.0,
            max_changed=np.inf,
        )
    cases = CASES if given.case is None else [CASES[index] for index in given.case]
    seconds = 3600.0 * given.hours / len(cases) / WORLDS
    holds = -(-given.holds // len(cases))
    free = Tally()
    held = Tally()
    for index, case in enumerate(cases):
        seed = given.seed + 1000 * index
        free.add(drive_freely(case, WORLDS, seconds, seed, has_rule))
        held.add(hold_bodies(case, WORLDS, holds, seed + 500, has_rule))
        late = f"{len(held.missed)} of {len(held.delays_s)} held bodies stopped late"
        tell(f"{case.robot} in {case.world}: {len(free.trips)} trips so far, {late}")
    delays = np.array(held.delays_s or [np.inf])
    return {
        "hours": free.driven_s / 3600.0,
        "judged_share": free.judged_s / max(free.driven_s, 1e-9),
        "trips": len(free.trips) + len(held.trips),
        "tripped": free.trips[:20],
        "held": len(held.delays_s),
        "stopped_share": float((delays <= WITHIN_S + 1e-6).mean()),
        "median_s": float(np.median(delays)),
        "late": held.missed[:20],
        "other_stops": dict(free.other_stops + held.other_stops),
        "asked": (given.hours, holds * len(cases)),
    }


def set_bars(result: Result) -> Bars:
    hours, holds = result["asked"]
    return {
        "trips": at_most(0, f"stops by {RULE} of robots that drove freely"),
        "hours": at_least(0.99 * hours, "invalid: hours that were driven"),
        "judged_share": at_least(LEAST_JUDGED, "invalid: time in which scans told"),
        "held": at_least(holds, "invalid: held bodies"),
        "stopped_share": at_least(
            LEAST_STOPPED, "share of the held bodies that were stopped in time"
        ),
    }


OPTIONS = {
    "hours": (10.0, "of free driving, all together"),
    "holds": (390, "bodies that are held, all together"),
    "seed": 0,
    "case": {"type": int, "action": "append", "choices": range(len(CASES))},
}

if __name__ == "__main__":
    run_campaign(measure, set_bars, OPTIONS)
