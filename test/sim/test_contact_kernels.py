from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.sim import contact_kernels as kernels
from nics_drl_bridge.sim.state import Cells


@pytest.mark.parametrize("count", [1, 2, 7, 60, 300])
def test_every_body_that_comes_within_reach_is_found_once(count):
    rng = np.random.default_rng(count)
    side = int(np.sqrt(2 * count))
    found = np.zeros(count, np.int64)
    order, cell_of = np.zeros(count, np.int64), np.zeros(count, np.int64)
    cells = Cells(np.zeros(side * side + 2, np.int64), order, cell_of, np.zeros(5), found)
    bodies = np.zeros((1, count, 7))
    some = False
    for _ in range(40):
        bodies[0, :, :2] = rng.uniform(-10.0, 10.0, (count, 2))
        bodies[0, :, 5] = rng.choice([0.0, 0.1, 0.3, 5.0], count, p=[0.1, 0.4, 0.4, 0.1])
        kernels.sort_bodies(bodies, 0, cells)
        spot, reach = rng.uniform(-12.0, 12.0, 2), rng.uniform(0.0, 3.0)
        several = kernels.bodies_around(*spot, reach, cells)
        got = found[:several].tolist()
        away = np.hypot(*(bodies[0, :, :2] - spot).T) - bodies[0, :, 5]
        assert len(set(got)) == len(got)
        assert set(np.flatnonzero((away <= reach) & (bodies[0, :, 5] > 0.0))) <= set(got)
        some = some or several < count // 2
    assert some or count < 60
