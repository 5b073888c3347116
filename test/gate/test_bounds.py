"""A check or a rule accepts the value at its bound, and nothing beyond it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gate.rig import config
from nics_drl_bridge.gate.arming import CHECKS
from nics_drl_bridge.gate.estimate import track_estimate
from nics_drl_bridge.gate.inputs import Arm, Command, Estimate, Odometry, Scan, Tick
from nics_drl_bridge.gate.intake import check_odometry, scan_malformed
from nics_drl_bridge.gate.state import (
    Arrivals,
    EstimateMark,
    EstimateTrack,
    EStopState,
    Push,
    SensorState,
    begin,
)
from nics_drl_bridge.gate.stops import SOURCE_S, STOPS, take_time, watch_source

NOW = 100.0
# Times here are exact in binary.
AGE_S = 0.25
OLDER_S = 0.28125
CONFIG = config(
    scan_age_s=AGE_S,
    odom_age_s=AGE_S,
    command_age_s=AGE_S,
    estimate_silence_s=AGE_S,
    e_stop_silence_s=AGE_S,
    race_s=AGE_S,
    gap_s=AGE_S,
    settle_s=1.0,
    clock_jump_s=0.5,
    estimate_position=0.5,
    estimate_heading=0.25,
    scan_rate=8.0,
    odom_rate=8.0,
    rate_tolerance=0.25,
    sensors=("rear",),
)
RULES = {rule.name: rule for rule in STOPS}
COMMAND = Command(0, np.zeros(3))
STANDING = Odometry(0, np.zeros(3), np.zeros(3))
SURE = Estimate(np.zeros(3), np.zeros(3), np.zeros((3, 3)))


def arrived(age_s=0.0, late_s=0.0, rate=8, unbroken_s=0.0, ahead_s=0.0):
    """Arrivals of a rate over the settling time, the newest of which has an age."""
    return Arrivals(
        stamps_ns=(round((1.0 + ahead_s) * 1e9),),
        times=(NOW - age_s,),
        late=(late_s,),
        count=1 + rate,
        unbroken_s=unbroken_s,
        marks=((NOW - 1.0, 0, 1, 0.0),),
    )


def at(x):
    return Odometry(0, np.array([x, 0.0, 0.0]), np.zeros(3))


def pushed(since_s, path):
    """A motion commanded since a time, over a path [m] from the origin."""
    commanded = np.array([path, 0.0, 0.0])
    return Push(since_s, NOW, NOW, commanded, ((since_s, np.zeros(3), np.zeros(3)),))


ODOM = {"odometries": arrived()}


def judge(name, changes):
    """Returns what a check or a rule finds in a state."""
    state = replace(begin(CONFIG), **changes)
    if name in CHECKS:
        return CHECKS[name](CONFIG, state, Arm(1), NOW)
    return RULES[name].judge(CONFIG, state, NOW)


AGES = {
    "scan_fresh": lambda age: {"scans": arrived(age)},
    "odom_fresh": lambda age: {"odometries": arrived(age)},
    "estimator_converged": lambda age: {"estimate": SURE, "estimate_s": NOW - age},
    "scan_silent": lambda age: {"scans": arrived(age / 2, age / 2)},
    "odom_silent": lambda age: {"odometries": arrived(age)},
    "sensor_silent": lambda age: {"sensors": (SensorState(arrived(age)),)},
    "command_silent": lambda age: {"command": COMMAND, "command_s": NOW - age},
    "scan_behind_old": lambda age: {"command": COMMAND, "behind_s": NOW - age},
    "scan_behind_unknown": lambda age: {
        "command": COMMAND,
        "pending": COMMAND,
        "pending_s": NOW - age,
    },
    "e_stop_silent": lambda age: {"e_stop": EStopState(heard_s=NOW - age)},
}
CASES = [
    *((name, make, AGE_S, OLDER_S) for name, make in AGES.items()),
    ("scan_fresh", lambda s: {"scans": arrived(unbroken_s=s)}, 99.0, 99.5),
    ("scan_rate", lambda rate: {"scans": arrived(rate=rate)}, 6, 5),
    ("odom_rate", lambda rate: {"odometries": arrived(rate=rate)}, 10, 11),
    ("clocks_agree", lambda s: {"scans": arrived(ahead_s=s), **ODOM}, 0.5, 0.5625),
    ("clocks_agree", lambda s: {"scans": arrived(ahead_s=s), **ODOM}, -0.5, -0.5625),
    ("standing_still", lambda s: {"odometry": STANDING, "restless_s": s}, 99.0, 99.5),
    ("one_policy", lambda s: {"last_mixed": "two", "mixed_s": s}, 99.0, 99.5),
    ("no_motion", lambda s: {"odometry": STANDING, "push": pushed(s, 1.0)}, 99.0, 98.5),
    ("no_motion", lambda x: {"odometry": at(x), "push": pushed(98.0, 1.0)}, 0.1, 0.09),
    ("no_motion", lambda x: {"odometry": at(0), "push": pushed(98.0, x)}, 0.0299, 0.03),
]


@pytest.mark.parametrize(("name", "make", "bound", "beyond"), CASES)
def test_a_value_at_its_bound_is_accepted_and_one_beyond_it_is_not(
    name, make, bound, beyond
):
    assert not judge(name, make(bound))
    assert judge(name, make(beyond))


@pytest.mark.parametrize(
    ("tick_s", "awake_s", "is_fault"),
    [
        (NOW - AGE_S, 0.0, False),
        (NOW - OLDER_S, 0.0, True),
        (NOW - AGE_S, NOW - AGE_S, True),  # awake again for too short a time
        (NOW - AGE_S, NOW - OLDER_S, False),
    ],
)
def test_a_gate_that_slept_for_too_long_is_at_fault_until_it_was_awake_as_long(
    tick_s, awake_s, is_fault
):
    state = replace(begin(CONFIG), tick_s=tick_s, awake_s=awake_s, now_s=NOW - AGE_S)
    for event in (Tick(), COMMAND):
        after = take_time(CONFIG, state, event, NOW)
        assert bool(after.clock_fault) == is_fault
        assert after.tick_s == (NOW if event == Tick() else tick_s)


@pytest.mark.parametrize(
    ("variances", "x", "is_fault"),
    [
        ((0.25, 0.0, 0.0625), 0.0, False),
        ((0.2501, 0.0, 0.0), 0.0, True),
        ((0.0, 0.2501, 0.0), 0.0, True),
        ((0.0, 0.0, 0.0626), 0.0, True),
        ((0.0, 0.0, 0.0), 1.0, False),  # 0.5 m, and 0.5 m at twice the maximum speed
        ((0.0, 0.0, 0.0), 1.001, True),
    ],
)
def test_an_estimate_may_gain_and_jump_by_its_limits_and_no_more(
    variances, x, is_fault
):
    track = EstimateTrack((EstimateMark(NOW - 10.0, np.zeros(3), np.zeros((3, 3))),))
    state = replace(
        begin(CONFIG), estimate=SURE, estimate_s=NOW - AGE_S, estimates=track
    )
    after = Estimate(np.zeros(3), np.array([x, 0.0, 0.0]), np.diag(variances))
    assert bool(track_estimate(CONFIG, state, after, NOW).fault) == is_fault
    assert not track_estimate(CONFIG, state, after, NOW + 1.0).fault  # it is too old


def test_a_command_of_another_publisher_is_accepted_once_the_first_was_silent():
    for silent_s, mixed in ((SOURCE_S, False), (0.5, True)):
        state = replace(begin(CONFIG), source="one", source_s=NOW - silent_s)
        command = replace(COMMAND, source="another")
        assert bool(watch_source(state, command, NOW).mixed) == mixed


def test_odometry_may_be_as_fast_as_a_mobile_robot_can_be():
    for speed, refused in ((100.0, False), (-100.01, True)):
        assert (
            bool(check_odometry(CONFIG, replace(STANDING, twist=np.full(3, speed))))
            == refused
        )


@pytest.mark.parametrize(("off", "refused"), [(1e-3, False), (-1.1e-3, True)])
def test_the_beams_may_be_off_by_the_tolerance_of_their_angles(off, refused):
    given = config(beam_angles=np.array([0.0, 0.5]))
    scan = Scan(0, np.ones(2, np.float32), (off, 0.5))
    assert bool(scan_malformed(given, scan)) == refused
