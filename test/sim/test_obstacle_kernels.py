from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from moving import PERIOD, scattered, sides, state_of, surroundings_of, watch
from pydantic import TypeAdapter
from robots import circles, direct_model
from shapely import LineString, MultiLineString, box, unary_union

from nics_drl_bridge.config import Schema, validate
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.maps import GridMap
from nics_drl_bridge.lidar.shapes import place
from nics_drl_bridge.sim import obstacle_kernels as kernels
from nics_drl_bridge.sim import separation_kernels as at
from nics_drl_bridge.sim.allocation import map_field
from nics_drl_bridge.sim.obstacle_kernels import FAR, repulsion
from nics_drl_bridge.sim.obstacles import (
    Motion,
    Patrol,
    Pedestrian,
    plan_arrays,
)
from nics_drl_bridge.sim.separation_kernels import MARK
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import World

WALKER = Pedestrian()
STROLLER = Pedestrian(speed=(0.3, 0.8))
SQUARE = Patrol(
    waypoints=((-2.0, -2.0), (2.0, -2.0), (2.0, 2.0), (-2.0, 2.0)), speed=0.7
)
MIXED = [STROLLER, SQUARE, WALKER, None, WALKER, STROLLER]
WALLS = np.array([(-3.0, 0.5, -0.5, 0.5), (0.8, -1.0, 0.8, 3.0)])
TOUCH = 1e-9


class Mover(Schema):
    motion: Motion


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("motions", [[WALKER] * 6, MIXED], ids=["walk", "mixed"])
@pytest.mark.parametrize("walls", [None, WALLS], ids=["open", "walled"])
def test_nothing_ever_touches_or_leaves_the_field(motions, walls, seed):
    radii = np.array(
        [0.2, 0.3, 0.15, 0.25, 0.2, 0.3, 0.2, 0.2]
    )  # the last two are robots
    rng = np.random.default_rng(seed)
    places = scattered(radii, (3.0, 3.0), rng, walls)
    seen = watch(motions, places, radii, walls=walls, seed=seed)
    assert seen.gaps(radii).min() > -TOUCH
    reach = np.abs(seen.places[:, :6]).max(axis=(0, 2)) + radii[:6]
    assert reach.max() < 3.0 + TOUCH
    if walls is not None:
        solid = MultiLineString([wall.reshape(2, 2) for wall in walls])
        for k in range(6):  # the whole way, not only where a period ends
            track = LineString(np.concatenate([seen.places[:, k], seen.places[-1:, k]]))
            assert track.distance(solid) > radii[k] - TOUCH


@pytest.mark.parametrize("motions", [[WALKER] * 6, MIXED], ids=["walk", "mixed"])
def test_two_that_move_do_not_touch_within_a_period_either(motions):
    radii = np.full(6, 0.25)
    seen = watch(
        motions,
        scattered(radii, (2.0, 2.0), np.random.default_rng(0)),
        radii,
        (2.0, 2.0),
    )
    for share in (0.25, 0.5, 0.75):
        between = seen.places[:-1] + share * np.diff(seen.places, axis=0)
        away = np.linalg.norm(between[:, :, None] - between[:, None], axis=-1)
        assert away[:, ~np.eye(6, dtype=bool)].min() > 0.5 - TOUCH


def test_what_moves_stays_within_open_bounds_wherever_they_lie_and_uses_all_of_them():
    low = np.array([10.0, -2.0])
    high = np.array([13.0, 1.0])
    group = circles(4) | {"motion": {"kind": "pedestrian", "speed": [0.5, 0.9]}}
    world = {"name": "open", "bounds": [*low, *high], "goal_distance": [0.5, 2.0]}
    world = World.model_validate(world | {"obstacles": [group], "clearance": 0.05})
    simulator = FastSimulator(direct_model(), world, 3)
    simulator.reset(range(3))
    seen = []
    for _ in range(300):
        simulator.step(np.zeros((3, 1, 3)))
        seen.append(simulator.data.bodies[:, :4, :2].reshape(-1, 2).copy())
    places = np.concatenate(seen)
    assert ((places >= low) & (places <= high)).all()
    assert np.ptp(places, axis=0).min() > 2.0


def test_what_has_no_motion_stands_still():
    seen = watch(
        MIXED, scattered([0.2] * 6, (3.0, 3.0), np.random.default_rng(0)), [0.2] * 6
    )
    assert (seen.velocities[:, 3] == 0.0).all()
    assert (seen.speeds[:, [0, 1, 2, 4, 5]].max(axis=0) > 0.2).all()


def test_speeds_stay_within_their_bounds():
    seen = watch(
        MIXED, scattered([0.2] * 6, (3.0, 3.0), np.random.default_rng(0)), [0.2] * 6
    )
    drawn = seen.marks[-1, :, at.SPEED]
    fastest = seen.speeds.max(axis=0)
    for k, motion in enumerate(MIXED):
        if motion is not None:
            low, high = np.broadcast_to(motion.speed, 2)
            assert low <= drawn[k] <= high
            assert fastest[k] <= (drawn[k] if motion is SQUARE else high) * (
                1.0 + 1e-12
            )
    assert np.abs(seen.velocities[..., 2]).max() <= kernels.TURN


def test_an_obstacle_looks_where_it_goes():
    seen = watch([SQUARE], np.array(SQUARE.waypoints[:1]), [0.2], steps=300)
    ahead = np.arctan2(seen.velocities[:, 0, 1], seen.velocities[:, 0, 0])
    off = np.angle(np.exp(1j * (seen.headings[1:, 0] - ahead)))
    assert np.median(np.abs(off)) < 1e-9


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


def test_a_patrol_waits_while_a_robot_stands_in_its_way():
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


def test_patrols_that_meet_head_on_stop_and_do_not_touch():
    there = Patrol(waypoints=((-2.0, 0.0), (2.0, 0.0)), speed=0.5)
    back = Patrol(waypoints=((2.0, 0.0), (-2.0, 0.0)), speed=1.0)
    seen = watch(
        [there, back], np.array([(-2.0, 0.0), (2.0, 0.0)]), [0.3, 0.3], steps=200
    )
    assert 0.0 <= seen.gaps([0.3, 0.3]).min() < 0.01
    assert seen.speeds[-1].max() < 1e-3


def arrivals(seen, k):
    """How often walker k got a new goal, and how often because it had reached the old one."""
    goals = seen.marks[:, k, at.GOAL_X : at.GOAL_Y + 1]
    new = np.flatnonzero(np.any(goals[1:] != goals[:-1], axis=1))
    left = np.linalg.norm(seen.places[new + 1, k] - goals[new], axis=1)
    return len(new), int((left < 0.3).sum())


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_walkers_reach_their_goals_and_keep_apart(seed):
    count = 5
    radii = [0.2] * 6
    places = scattered(radii, (4.0, 4.0), np.random.default_rng(seed))
    seen = watch([WALKER] * count, places, radii, half=(4.0, 4.0), seed=seed)
    new, reached = np.sum([arrivals(seen, k) for k in range(count)], axis=0)
    assert reached > 0.9 * new
    assert reached > 100  # in 1000 s of walking, some 4 m each
    assert (seen.gaps(radii).min(axis=1) < 0.05).mean() < 0.001
    assert seen.speeds.mean() > 0.8


@pytest.mark.parametrize("aside", [0.0, 0.05, -0.2])
def test_a_walker_goes_around_a_robot_that_stands_in_the_way(aside):
    half = (10.0, 2.0)
    for seed in range(5):
        places = np.array([(-4.0, 0.0), (0.0, aside)])
        seen = watch([WALKER], places, [0.25, 0.25], half=half, seed=seed, steps=1)
        marks = seen.marks[0].copy()
        marks[0, [at.GOAL_X, at.GOAL_Y, at.UNTIL]] = 4.0, 0.0, 1e9
        track = walk_on(marks, places, [0.25, 0.25], half, seed)
        away = np.linalg.norm(track - places[1], axis=1)
        assert away.min() > 0.65  # the radii are half a metre together
        assert np.linalg.norm(track - (4.0, 0.0), axis=1).min() < 0.35


def walk_on(marks, places, radii, half, seed, steps=120):
    """The way (T, 2) of one walker with given marks, until it is at its goal."""
    poses = np.concatenate([places, np.zeros((2, 1))], axis=1)[None]
    bodies = place(poses, np.asarray(radii)[None], np.zeros((1, 2)))
    marks = marks[None].copy()
    velocity = np.zeros((1, 1, 3))
    track = []
    scene = surroundings_of([WALKER], half, sides(half))
    state = state_of(bodies, marks, velocity, [seed])
    goal = marks[0, 0, at.GOAL_X].copy()
    for t in range(steps):
        state.steps[0] = t + 1
        kernels.steer(0, state, scene, PERIOD, np.zeros((1, 2)))
        if marks[0, 0, at.GOAL_X] != goal:
            break
        bodies[0, 0, :2] += velocity[0, 0, :2] * PERIOD
        track.append(bodies[0, 0, :2].copy())
    return np.array(track)


def test_a_walker_alone_takes_up_its_speed_as_the_model_says():
    alone = Pedestrian(fluctuation=0.0, wall_repulsion=0.0)
    seen = watch([alone], np.zeros((1, 2)), [0.2], half=(200.0, 200.0), steps=40)
    speed = seen.marks[0, 0, at.SPEED]
    expected = speed * (1.0 - (1.0 - PERIOD / alone.relaxation) ** np.arange(1, 41))
    assert np.allclose(seen.speeds[:, 0], expected, rtol=1e-9)


def in_batch(seeds, motions=tuple(MIXED), steps=200):
    count = len(motions)
    worlds = len(seeds)
    radii = np.full((worlds, count + 1), 0.2)
    half = np.array([3.0, 3.0])
    places = scattered([0.2] * (count + 1), half, np.random.default_rng(0))
    poses = np.tile(
        np.concatenate([places, np.zeros((count + 1, 1))], 1), (worlds, 1, 1)
    )
    bodies = place(poses, radii, np.zeros_like(radii))
    marks = np.full((worlds, count, MARK), 7.0)
    velocity = np.full((worlds, count, 3), 9.0)
    scene = surroundings_of(motions, half, sides(half))
    still = np.zeros((1, 2))
    state = state_of(bodies, marks, velocity, seeds)
    for n in range(worlds):
        kernels.reset_marks(n, state, scene.movers.plans)
    for t in range(steps):
        state.steps[:] = t
        for n in range(worlds):
            kernels.steer(n, state, scene, PERIOD, still)
        bodies[:, :count, :3] += velocity * PERIOD
    return bodies


def test_a_seed_gives_the_same_motion_in_any_batch():
    together = in_batch([11, 5, 2**63 - 1])
    for n, seed in enumerate([11, 5, 2**63 - 1]):
        assert np.array_equal(in_batch([seed])[0], together[n])
    assert np.abs(together[0, :, :2] - together[1, :, :2]).max() > 0.5


@pytest.mark.parametrize("heading", [0.0, 0.4])
def test_what_moves_keeps_clear_of_a_static_map(heading):
    cells = np.zeros((120, 120), np.int8)
    cells[40:50, 20:70] = 100
    cells[70:100, 80:84] = 100
    cells[20:23, 90:93] = 100
    grid = GridMap(cells, 0.05, (-2.5, -3.0, heading))
    corners = np.stack(np.nonzero(grid.blocked), axis=1)
    squares = [
        box(j * 0.05, i * 0.05, (j + 1) * 0.05, (i + 1) * 0.05) for i, j in corners
    ]
    solid, (x, y, _) = unary_union(squares), grid.origin
    c = np.cos(heading)
    s = np.sin(heading)
    radius = 0.2
    count = 4
    rng = np.random.default_rng(0)
    places = []
    while len(places) < count:
        spot = scattered([radius], (2.5, 2.5), rng)[0]
        row, column = grid.world_to_cell(spot)
        inside = 0 <= row < 120 and 0 <= column < 120
        if (not inside or grid.distance_field[row, column] > radius + 0.1) and all(
            np.linalg.norm(spot - other) > 0.5 for other in places
        ):
            places.append(spot)
    seen = watch(
        [WALKER] * count, np.array(places), [radius] * count, grid=map_field(grid)
    )
    d = seen.places - (x, y)
    local = np.stack(
        [c * d[..., 0] + s * d[..., 1], c * d[..., 1] - s * d[..., 0]], axis=-1
    )
    for k in range(count):
        assert LineString(local[:, k]).distance(solid) > radius - 0.005
        assert np.ptp(local[:, k], axis=0).max() > 2.0
    assert seen.gaps([radius] * count).min() > -TOUCH


@pytest.mark.parametrize(
    ("motion", "sentence"),
    [
        (
            {"kind": "pedestrian", "speed": [0.8, 0.3]},
            "speed must be [minimum, maximum]",
        ),
        ({"kind": "pedestrian", "speed": [0.0, 0.3]}, "above 0"),
        ({"kind": "pedestrian", "speed": [1.0, 30.0]}, "at most 10 m/s"),
        (
            {"kind": "patrol", "waypoints": [[0, 0]], "speed": 1.0},
            "motion.patrol.waypoints",
        ),
        (
            {"kind": "patrol", "waypoints": [[0, 0], [0, 0]], "speed": 1.0},
            "must differ",
        ),
        (
            {"kind": "patrol", "waypoints": [[0, 0], [1, 0], [0, 0]], "speed": 1.0},
            "must differ",
        ),
        ({"kind": "pedestrian", "relaxation": 0.0}, "relaxation"),
        ({"kind": "wander", "speed": [0.3, 0.8]}, "unknown kind 'wander'"),
        (
            {"kind": "pedestrain"},
            "unknown kind 'pedestrain'; did you mean 'pedestrian'?",
        ),
    ],
)
def test_a_wrong_motion_is_one_sentence(motion, sentence):
    with pytest.raises(ConfigError) as caught:
        validate({"motion": motion}, Mover, "world.yaml")
    assert sentence in str(caught.value)


def test_motions_are_read_by_their_kind():
    read = TypeAdapter(Motion).validate_python
    assert read({"kind": "pedestrian"}) == Pedestrian()
    back = {
        "kind": "patrol",
        "waypoints": [[0, 0], [1, 0], [0, 0]],
        "speed": 1,
        "loop": False,
    }
    assert isinstance(read(back), Patrol)


def test_plans_hold_the_waypoints_of_all_patrols_one_after_the_other():
    rows, waypoints = plan_arrays(
        [None, SQUARE, WALKER, Patrol(waypoints=((0, 0), (1, 1)), speed=1)]
    )
    assert rows[:, at.KIND].tolist() == [at.STILL, at.PATROL, at.PEDESTRIAN, at.PATROL]
    assert rows[[1, 3], at.FIRST].tolist() == [0, 4]
    assert np.array_equal(waypoints, [*SQUARE.waypoints, (0, 0), (1, 1)])
    assert [part.shape for part in plan_arrays([])] == [(0, 16), (0, 2)]


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


def test_the_force_is_that_of_the_library_socialforce():
    potentials = pytest.importorskip("socialforce.potentials")
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(1)
    count = 6
    model = potentials.PedPedPotential(v0=STRENGTH, sigma=REACH)
    places = rng.uniform(-1.0, 1.0, (count, 2))
    v = rng.uniform(-1.5, 1.5, (count, 2))
    state = np.concatenate([places, v, 0.0 * v, places + 10.0 * v], axis=1)
    expected = -model.grad_r_ab(torch.tensor(state)).detach().numpy()
    for a in range(count):
        for b in range(count):
            if a != b:
                r = places[a] - places[b]
                force = repulsion(*r, *v[b], model.delta_t_step, STRENGTH, REACH)
                assert np.allclose(force, expected[a, b], rtol=1e-3, atol=5e-3)
