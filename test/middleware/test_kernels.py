from __future__ import annotations

import numpy as np

from nics_drl_bridge.middleware import kernels
from nics_drl_bridge.middleware.kernels import insert_command, make_log


def in_effect(log, time):
    return log.commands[kernels.find_command(log, time)].tolist()


def test_the_order_of_adding_does_not_matter():
    rng = np.random.default_rng(0)
    times = rng.permutation(1000)[:100] * 10
    log = make_log([0.0])
    for time in times:
        log = insert_command(log, int(time), np.array([float(time)]), -1)
    assert log.effective[1:].tolist() == sorted(times.tolist())
    assert np.array_equal(log.commands[1:, 0], log.effective[1:])
    for now in rng.integers(0, 10_000, 100):
        earlier = times[times < now]
        assert in_effect(log, now) == [float(earlier.max()) if len(earlier) else 0.0]


def test_what_is_no_longer_needed_is_forgotten_and_all_else_kept():
    log = make_log([0.0])
    for k in range(1000):
        log = insert_command(log, k, np.array([float(k)]), k - 50)
        for back in (0, 1, 49, 50):  # just before the time that is needed, too
            assert in_effect(log, k - back + 1) == [float(max(k - back, 0))]
        assert in_effect(log, k - 50) == [float(max(k - 51, 0))]
    assert len(log.effective) == 52
