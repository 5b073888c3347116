from __future__ import annotations

import numpy as np

from nics_drl_bridge.middleware import kernels
from nics_drl_bridge.middleware.kernels import insert_command, make_log


def in_effect(log, time):
    return log.commands[kernels.find_command(log, time)].tolist()


def test_what_is_no_longer_needed_is_forgotten_and_all_else_kept():
    log = make_log([0.0])
    for k in range(1000):
        log = insert_command(log, k, np.array([float(k)]), k - 50)
        for back in (0, 1, 49, 50):  # just before the time that is needed, too
            assert in_effect(log, k - back + 1) == [float(max(k - back, 0))]
        assert in_effect(log, k - 50) == [float(max(k - 51, 0))]
    assert len(log.effective) == 52
