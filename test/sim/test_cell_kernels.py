from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.sim import collision_kernels as kernels

RADIUS = 5


def bodies_at_random(rng, count):
    bodies = np.zeros((count, 7))
    bodies[:, :2] = rng.uniform(-10.0, 10.0, (count, 2))
    bodies[:, RADIUS] = rng.choice([0.0, 0.1, 0.3, 5.0], count, p=[0.1, 0.4, 0.4, 0.1])
    return bodies


def within(bodies, spot, reach):
    """The bodies there that do come within reach."""
    away = np.hypot(*(bodies[:, :2] - spot).T) - bodies[:, RADIUS]
    return set(np.flatnonzero((away <= reach) & (bodies[:, RADIUS] > 0.0)).tolist())


@pytest.mark.parametrize("count", [1, 2, 7, 60, 300])
def test_every_body_that_comes_within_reach_is_found_once(count):
    rng = np.random.default_rng(count)
    cells = kernels.body_cells(3, count)
    some = False
    for n in rng.integers(0, 3, 40):
        bodies = bodies_at_random(rng, count)
        standing = int(rng.integers(count + 1))
        kernels.sort_into_cells(n, bodies, standing, cells)
        spot = rng.uniform(-12.0, 12.0, 2)
        reach = rng.uniform(0.0, 3.0)
        several = kernels.find_around(n, *spot, reach, cells)
        got = cells.found[:several].tolist()
        assert len(set(got)) == len(got)
        assert within(bodies, spot, reach) <= set(got)
        moving = np.flatnonzero(bodies[standing:, RADIUS] > 0.0) + standing
        assert set(moving.tolist()) <= set(got)
        some = some or several < count // 2
    assert some or count < 60


def test_bodies_that_are_put_in_order_are_the_same_and_found_among_those_that_move():
    rng = np.random.default_rng(2)
    cells = kernels.body_cells(2, 80, ordered=True)
    few = 0
    for n in (0, 1, 1, 0):
        bodies = bodies_at_random(rng, 80)
        before = bodies.copy()
        kernels.put_in_order(n, bodies, 70, np.zeros((81, 7)), cells)
        assert np.array_equal(bodies[70:], before[70:])
        assert sorted(map(tuple, bodies)) == sorted(map(tuple, before))
        for spot in rng.uniform(-12.0, 12.0, (10, 2)):
            got = cells.found[: kernels.find_around(n, *spot, 1.0, cells)].tolist()
            assert len(set(got)) == len(got)
            assert within(bodies, spot, 1.0) | set(range(70, 80)) <= set(got)
            few += len(got) < 40
    assert few > 0
