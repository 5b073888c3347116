from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.middleware import kernels
from nics_drl_bridge.middleware.kernels import ROOM, CommandLog


def in_effect(log, time):
    return log.arrays.commands[kernels.in_effect(log.arrays, time)].tolist()


def test_before_the_first_command_there_is_none():
    log = CommandLog(2)
    assert in_effect(log, 10**18) == [0.0, 0.0]
    log.add(100, [1.0, 2.0], 0)
    assert in_effect(log, 100) == [0.0, 0.0]
    assert in_effect(log, 101) == [1.0, 2.0]


def test_the_order_of_adding_does_not_matter():
    rng = np.random.default_rng(0)
    times = rng.permutation(1000)[:100] * 10
    log = CommandLog(1)
    for time in times:
        assert log.add(int(time), [float(time)], -1)
    effective, commands, count = log.arrays
    assert effective[1:count].tolist() == sorted(times.tolist())
    assert np.array_equal(commands[1:count, 0], effective[1:count])
    for now in rng.integers(0, 10_000, 100):
        earlier = times[times < now]
        assert in_effect(log, now) == [float(earlier.max()) if len(earlier) else 0.0]


@pytest.mark.parametrize("time", [10, 20, 30])
def test_of_two_commands_at_once_the_first_stays(time):
    log = CommandLog(1)
    for other in (10, 20, 30):
        assert log.add(other, [1.0], 0)
    assert not log.add(time, [2.0], 0)
    assert in_effect(log, time + 1) == [1.0]


def test_what_is_no_longer_needed_is_forgotten_and_all_else_kept():
    log = CommandLog(1)
    for k in range(100 * ROOM):
        log.add(k, [float(k)], k - 50)
        for back in (0, 1, 49):
            assert in_effect(log, k - back + 1) == [float(max(k - back, 0))]
    assert len(log.arrays.effective) == ROOM


def test_it_grows_with_what_is_needed():
    log = CommandLog(1)
    for k in range(10 * ROOM):
        log.add(k, [float(k)], 0)
    assert [in_effect(log, k + 1) for k in range(10 * ROOM)] == [
        [float(k)] for k in range(10 * ROOM)
    ]


def test_clearing_forgets_all():
    log = CommandLog(1)
    log.add(5, [1.0], 0)
    log.clear()
    assert in_effect(log, 100) == [0.0]
    assert log.add(5, [2.0], 0)
