from __future__ import annotations

import numpy as np
import pytest

from gate.rig import config
from nics_drl_bridge.gate.arrivals import (
    AHEAD_S,
    JUMPED,
    REPEATED,
    account_for_arrival,
    measure_creep,
    measure_rate,
)
from nics_drl_bridge.gate.state import Arrivals
from nics_drl_bridge.interface import NS_PER_S

CONFIG = config(clock_jump_s=0.5)
GAP_S = 0.25
START_NS = 1_000 * NS_PER_S


def receive(data, armed=False):
    """Adds data, each a stamp and an arrival [s]; returns the arrivals and the last fault."""
    arrivals = Arrivals()
    fault = ""
    for stamp_s, now in data:
        stamp_ns = START_NS + round(stamp_s * NS_PER_S)
        arrivals, fault = account_for_arrival(
            CONFIG, arrivals, stamp_ns, now, GAP_S, armed
        )
    return arrivals, fault


@pytest.mark.parametrize(
    ("stamp_s", "armed", "expected"),
    [
        (0.0, False, REPEATED),
        (-0.5, False, REPEATED),
        (-0.5625, False, JUMPED),
        (0.625, False, ""),
        (0.6875, False, JUMPED),
        (0.125 + AHEAD_S - 1e-3, True, ""),
        (0.125 + AHEAD_S + 1e-3, True, JUMPED),
    ],
)
def test_a_stamp_jumps_only_beyond_what_is_tolerated(stamp_s, armed, expected):
    arrivals, fault = receive([(0.0, 100.0), (stamp_s, 100.125)], armed)
    assert fault == expected
    assert arrivals.count == (2 if expected == "" else 1)
    assert arrivals.times[-1] == (100.0 if expected == REPEATED else 100.125)


@pytest.mark.parametrize(("passed", "since"), [(GAP_S, 100.0), (0.26, 100.26)])
def test_only_a_longer_time_than_the_tolerated_one_is_a_gap(passed, since):
    arrivals, _ = receive([(0.0, 100.0), (passed, 100.0 + passed)])
    assert arrivals.unbroken_s == since


def test_rates_are_those_of_the_settling_time_and_creep_that_of_its_later_half():
    """The stamps run fast; the data come at 10 Hz, and at 20 Hz for the last half second."""
    times = np.concatenate([np.arange(35) / 10.0, 3.5 + np.arange(11) / 20.0])
    arrivals, _ = receive([(1.02 * t, 100.0 + t) for t in times])
    settle_s = CONFIG.settle_s
    rates = measure_rate(arrivals, 104.0, settle_s)
    assert rates == pytest.approx((15.0, 15.0 / 1.02))
    assert measure_rate(arrivals, 106.0, settle_s) == (0.0, 0.0)
    assert measure_creep(arrivals) == pytest.approx(0.012)
