from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import yaml
from moving import PERIOD, scattered, watch
from robots import FOOTPRINT, RADIUS, circles, direct_model, field

from nics_drl_bridge.config import Schema, validate
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.maps import GridMap
from nics_drl_bridge.sim import obstacle_kernels as at
from nics_drl_bridge.sim.obstacle_kernels import FAR, repulsion
from nics_drl_bridge.sim.simulator import FastSimulator, map_field
from nics_drl_bridge.sim.world import (
    Motion,
    Patrol,
    Pedestrian,
)

WALKER = Pedestrian()
STROLLER = Pedestrian(speed=(0.3, 0.8))
SQUARE = Patrol(
    waypoints=((-2.0, -2.0), (2.0, -2.0), (2.0, 2.0), (-2.0, 2.0)), speed=0.7
)
MIXED = [STROLLER, SQUARE, WALKER, None, WALKER, STROLLER]
TOUCH = 1e-9


class Mover(Schema):
    motion: Motion


def test_what_moves_stays_within_open_bounds_wherever_they_lie_and_uses_all_of_them():
    walkers = circles(4) | {"motion": {"kind": "pedestrian", "speed": [0.5, 0.9]}}
    changes = {"goal_distance": [0.5, 2.0], "clearance": 0.05, "obstacles": [walkers]}
    world = field(size=None, bounds=[10.0, -2.0, 13.0, 1.0], **changes)
    simulator = FastSimulator(direct_model(), world, 3)
    simulator.reset(range(3))
    seen = []
    for _ in range(300):
        simulator.step(np.zeros((3, 1, 3)))
        seen.append(simulator.data.bodies[:, :4, :2].copy())
    assert ((np.array(seen) >= (10.0, -2.0)) & (np.array(seen) <= (13.0, 1.0))).all()
    assert np.ptp(seen, axis=(0, 1, 2)).min() > 2.0


def test_speeds_stay_within_their_bounds_and_what_has_no_motion_stands_still():
    radii = [0.2] * 6
    seen = watch(MIXED, scattered(radii, (3.0, 3.0), np.random.default_rng(0)), radii)
    fastest = seen.speeds.max(axis=0)
    for motion, drawn, speed in zip(MIXED, seen.marks[-1], fastest, strict=True):
        low, high = np.broadcast_to(0.0 if motion is None else motion.speed, 2)
        assert low <= drawn["speed"] <= high
        assert 0.5 * low <= speed <= high * (1.0 + 1e-12)
    assert np.abs(seen.velocities[..., 2]).max() <= at.TURN
    assert seen.gaps(radii).min() > -TOUCH


def on_path(corners, speed, pause, times):
    """Where a patrol is that was at the first corner at time 0, by interpolation in time."""
    when = [0.0]
    where = [corners[0]]
    now = 0.0
    for one, other in pairwise(corners):
        for spent, stop in (
            (pause, one),
            (np.linalg.norm(np.subtract(other, one)) / speed, other),
        ):
            now += spent
            when.append(now)
            where.append(stop)
    where = np.array(where)
    return np.stack([np.interp(times, when, where[:, i]) for i in range(2)], axis=1)


@pytest.mark.parametrize("loop", [True, False])
@pytest.mark.parametrize("pause", [0.0, 0.37])
@pytest.mark.parametrize("speed", [0.73, 6.0])
def test_a_patrol_is_at_every_time_where_its_path_says(loop, pause, speed):
    points = [(-2.0, -2.0), (1.0, -2.0), (1.1, -1.9), (1.0, 2.0)]
    patrol = Patrol(waypoints=points, speed=speed, loop=loop, pause=pause)
    seen = watch([patrol], np.array(points[:1]), [0.2], steps=400)
    once = points if loop else [*points, points[2], points[1]]
    times = np.arange(401) * PERIOD
    expected = on_path(once * 60, speed, pause, times)
    assert np.abs(seen.places[:, 0] - expected).max() < 1e-9


def test_a_patrol_looks_ahead_and_waits_while_a_robot_stands_in_its_way():
    patrol = Patrol(waypoints=((-2.0, 0.0), (2.0, 0.0)), speed=0.5, loop=False)
    places = np.array([(-2.0, 0.0), (0.0, 0.1)])
    leaves = np.zeros((160, 1, 2))
    leaves[100:120, 0, 1] = 1.0
    seen = watch([patrol], places, [0.2, 0.2], steps=160, robots=leaves)
    assert np.ptp(seen.places[60:100, 0], axis=0).max() < 1e-3
    assert -0.5 < seen.places[100, 0, 0] < -0.44  # 0.1 m away
    assert (seen.places[:, 0, 1] == 0.0).all()
    assert seen.places[:, 0, 0].max() > 1.95  # it got to the other end after all
    assert seen.gaps([0.2, 0.2]).min() > -TOUCH
    x, y = seen.velocities[:, 0, :2].T
    turned = np.cos(seen.headings[1:, 0] - np.arctan2(y, x))[np.hypot(x, y) > 0.0]
    assert np.median(turned) == pytest.approx(1.0, abs=1e-12)


def arrivals(seen, k):
    """How often walker k got a new goal, and how often because it had reached the old one."""
    goals = np.stack([seen.marks[name][:, k] for name in ("goal_x", "goal_y")], axis=1)
    new = np.flatnonzero(np.any(goals[1:] != goals[:-1], axis=1))
    left = np.linalg.norm(seen.places[new + 1, k] - goals[new], axis=1)
    return len(new), int((left < 0.3).sum())


def test_walkers_reach_their_goals_and_keep_apart():
    count = 5
    radii = [0.2] * 6
    places = scattered(radii, (4.0, 4.0), np.random.default_rng(1))
    seen = watch([WALKER] * count, places, radii, half=(4.0, 4.0))
    new, reached = np.sum([arrivals(seen, k) for k in range(count)], axis=0)
    assert reached > 0.9 * new
    assert reached > 100  # in 1000 s of walking, some 4 m each
    assert (seen.gaps(radii).min(axis=1) < 0.05).mean() < 0.001
    assert seen.speeds.mean() > 0.8


@pytest.mark.parametrize("aside", [0.0, -0.2])
def test_a_walker_goes_around_a_robot_that_stands_in_the_way(aside):
    walker = circles(None) | {
        "at": [[-4.0, 0.0, 0.0]],
        "motion": {"kind": "pedestrian"},
    }
    simulator = FastSimulator(direct_model(), field(20.0, obstacles=[walker]), 5)
    simulator.reset(range(5), starts=np.tile([0.0, aside, 0.0], (5, 1, 1)))
    still = np.zeros((5, 1, 3))
    simulator.step(still)
    track = []
    for _ in range(100):
        for name, value in (("goal_x", 4.0), ("goal_y", 0.0), ("until", 1e9)):
            simulator.data.marks[name][:, 0] = value
        simulator.step(still)
        track.append(simulator.data.bodies[:, 0, :2].copy())
    away = np.linalg.norm(np.subtract(track, [0.0, aside]), axis=-1)
    assert away.min() > RADIUS + FOOTPRINT + 0.1
    assert (
        np.linalg.norm(np.subtract(track, [4.0, 0.0]), axis=-1).min(axis=0) < 0.35
    ).all()


def test_a_walker_alone_takes_up_its_speed_as_the_model_says():
    alone = Pedestrian(fluctuation=0.0, wall_repulsion=0.0)
    seen = watch([alone], np.zeros((1, 2)), [0.2], half=(200.0, 200.0), steps=40)
    speed = seen.marks["speed"][0, 0]
    expected = speed * (1.0 - (1.0 - PERIOD / alone.relaxation) ** np.arange(1, 41))
    assert np.allclose(seen.speeds[:, 0], expected, rtol=1e-9)


@pytest.mark.parametrize("heading", [0.0, 0.4])
def test_what_moves_keeps_clear_of_a_static_map(heading):
    cells = np.zeros((120, 120), np.int8)
    cells[40:50, 20:70] = cells[70:100, 80:84] = cells[20:23, 90:93] = 100
    grid = map_field(GridMap(cells, 0.05, (-2.5, -3.0, heading)))
    rng = np.random.default_rng(0)
    radii = np.full(4, 0.2)

    def clearance(places):
        away = [at.map_distance(x, y, grid) for x, y in places.reshape(-1, 2)]
        return min(away) - 0.2

    places = scattered(radii, (2.5, 2.5), rng)
    while clearance(places) < 0.1:
        places = scattered(radii, (2.5, 2.5), rng)
    seen = watch([WALKER] * 4, places, radii, grid=grid)
    assert clearance(seen.places) > -0.005
    assert np.ptp(seen.places, axis=0).min() > 2.0
    assert seen.gaps(radii).min() > -TOUCH


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("{kind: pedestrian, speed: [0.8, 0.3]}", "speed must be [minimum, maximum]"),
        ("{kind: pedestrian, speed: [1.0, 30.0]}", "at most 10 m/s"),
        ("{kind: pedestrian, relaxation: 0.0}", "relaxation"),
        ("{kind: patrol, speed: 1, waypoints: [[0, 0]]}", "motion.patrol.waypoints"),
        (
            "{kind: patrol, speed: 1, waypoints: [[0, 0], [1, 0], [0, 0]]}",
            "must differ",
        ),
        ("{kind: pedestrain}", "did you mean 'pedestrian'?"),
    ],
)
def test_a_wrong_motion_is_refused_by_its_key(text, key):
    with pytest.raises(ConfigError) as caught:
        validate({"motion": yaml.safe_load(text)}, Mover, "world.yaml")
    assert key in str(caught.value)


STRENGTH = 2.1
REACH = 0.3


def potential(r, v, foresight):
    """Equations 3 and 4 of Helbing and Molnar (1995), as they stand there."""
    step = v * foresight
    both = np.linalg.norm(r) + np.linalg.norm(r - step)
    return STRENGTH * np.exp(-0.5 * np.sqrt(both**2 - step @ step) / REACH)


@pytest.mark.parametrize("foresight", [0.0, 0.4, 2.0])
def test_the_force_is_the_downhill_slope_of_the_potential(foresight):
    rng = np.random.default_rng(0)
    delta = 1e-6
    for _ in range(300):
        r = rng.uniform(-1.0, 1.0, 2)
        v = rng.uniform(-1.5, 1.5, 2)
        slope = [
            (potential(r + d, v, foresight) - potential(r - d, v, foresight))
            / (2.0 * delta)
            for d in delta * np.eye(2)
        ]
        force = np.array(repulsion(*r, *v, foresight, STRENGTH, REACH))
        if potential(r, v, foresight) < STRENGTH * np.exp(-FAR):
            assert (force == 0.0).all()  # so far away that it is left out
        else:
            assert np.allclose(force, -np.array(slope), rtol=1e-4, atol=1e-6)
