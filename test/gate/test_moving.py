from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gate.rig import LIDAR, Rig, config
from nics_drl_bridge import geometry
from nics_drl_bridge.gate.inputs import Odometry, Scan
from nics_drl_bridge.gate.moving import MEMORY_S, SPACING_S, movers, remember
from nics_drl_bridge.gate.state import ShieldConfig, View, begin
from nics_drl_bridge.interface import NS_PER_S

SHIELD = ShieldConfig(0.2, 2.0, 0.05, 0.2, 0.15, 0.2, obstacle_speed=1.0, range_max=3.0)
GIVEN = config(shield=SHIELD)
WALL_Y = 1.5


def seen(pose, discs=(), noise=0.0, rng=None):
    """A scan (B,) of a wall to the left at `WALL_Y` and of discs x, y, radius, by geometry."""
    angles = LIDAR.angles + pose[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        wall = (WALL_Y - pose[1]) / np.sin(angles)
    out = np.where((wall > 0.0) & (wall < LIDAR.range_max), wall, np.inf)
    for x, y, radius in discs:
        dx, dy = x - pose[0], y - pose[1]
        along = dx * np.cos(angles) + dy * np.sin(angles)
        beside2 = dx**2 + dy**2 - along**2
        hit = (along > 0.0) & (beside2 < radius**2)
        far = along - np.sqrt(np.maximum(radius**2 - beside2, 0.0))
        out = np.where(hit, np.minimum(out, far), out)
    if noise:
        out = out + rng.normal(0.0, noise, len(out))
    return out.astype(np.float32)


def drive(twist, discs_at, times=(0.0, 0.1, 0.2, 0.3), **noise):
    """Views along an arc, of discs that are somewhere at each time."""
    poses = [geometry.exp(t * np.array(twist)) for t in times]
    return tuple(
        View(round(t * NS_PER_S), pose, seen(pose, discs_at(t), **noise))
        for t, pose in zip(times, poses, strict=True)
    )


def facing(views, bearing, width=0.05):
    """The beams of the newest view around a bearing in its own frame."""
    return np.abs(LIDAR.angles - bearing) < width


@pytest.mark.parametrize("twist", [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.7, -0.7, 2.0), (0, 0, -2)])
def test_what_stands_does_not_move_however_the_robot_does(twist):
    discs = [(1.5, 0.4, 0.2), (1.0, -0.9, 0.15), (-0.8, 0.3, 0.25), (2.4, -0.2, 0.2)]
    assert not movers(GIVEN, SHIELD, drive(twist, lambda _: discs)).any()


@pytest.mark.parametrize("speed", [0.3, 0.5, 1.0, 1.6])
@pytest.mark.parametrize("twist", [(0.0, 0.0, 0.0), (0.5, 0.0, 1.0)])
def test_somebody_who_comes_on_moves(speed, twist):
    views = drive(twist, lambda t: [(2.0 - speed * t, 0.3, 0.2)])
    found, pose = movers(GIVEN, SHIELD, views), views[-1].pose
    where = geometry.between(pose, np.array([2.0 - speed * 0.3, 0.3, 0.0]))
    assert found[facing(views, np.arctan2(where[1], where[0]))].all()
    assert found.sum() < 60


def test_the_leading_edge_of_somebody_who_crosses_moves():
    views = drive((0.0, 0.0, 0.0), lambda t: [(1.5, -0.6 + 0.8 * t, 0.2)])
    edge = np.arctan2(-0.6 + 0.24 + 0.19, 1.5)
    assert movers(GIVEN, SHIELD, views)[facing(views, edge, 0.02)].any()


def test_who_walks_away_and_what_was_hidden_does_not():
    away = drive((0.0, 0.0, 0.0), lambda t: [(1.0 + 0.8 * t, -0.3, 0.2)])
    assert not movers(GIVEN, SHIELD, away).any()
    behind = [(1.0, 0.0, 0.15), (2.0, -0.1, 0.2)]  # the second comes out from behind the first
    assert not movers(GIVEN, SHIELD, drive((0.0, 0.7, 0.0), lambda _: behind)).any()


def test_noise_that_is_declared_is_no_motion():
    rng = np.random.default_rng(0)
    noisy = replace(SHIELD, range_noise=(0.03, 0.0))
    discs = [(1.5, 0.4, 0.2)]
    found = [
        movers(GIVEN, noisy, drive((0.3, 0.0, 0.0), lambda _: discs, noise=0.03, rng=rng)).sum()
        for _ in range(20)
    ]
    assert np.mean(found) < 3.0


def test_one_beam_alone_is_noise():
    views = list(drive((0.0, 0.0, 0.0), lambda _: []))
    alone = views[-1].ranges.copy()
    alone[100] = 1.0
    views[-1] = replace(views[-1], ranges=alone)
    assert not movers(GIVEN, SHIELD, tuple(views)).any()


def test_where_nothing_was_known_nothing_moves():
    views = list(drive((0.0, 0.0, 0.0), lambda t: [(2.0 - t, 0.0, 0.2)]))
    for index in range(3):
        views[index] = replace(views[index], ranges=np.full(LIDAR.beams, np.nan, np.float32))
    assert not movers(GIVEN, SHIELD, tuple(views)).any()


def test_where_all_is_taken_to_stand_nothing_moves():
    still = replace(SHIELD, obstacle_speed=0.0)
    assert not movers(GIVEN, still, drive((0, 0, 0), lambda t: [(2.0 - t, 0.0, 0.2)])).any()


def test_the_views_of_the_last_moments_are_kept_apart_from_each_other():
    state, step = begin(GIVEN), NS_PER_S // 40
    for index in range(40):
        state = replace(state, odometry=Odometry(index * step, np.zeros(3), np.zeros(3)))
        scan = Scan(index * step, np.full(LIDAR.beams, 1.0, np.float32), (0.0, 0.01))
        state = replace(state, views=remember(GIVEN, state, scan))
    stamps = np.array([view.stamp_ns for view in state.views])
    assert stamps[-1] == 39 * step
    assert (np.diff(stamps[:-1]) >= SPACING_S * NS_PER_S).all()
    assert MEMORY_S / 2 < (stamps[-1] - stamps[0]) / NS_PER_S <= MEMORY_S
    assert 4 <= len(stamps) <= 6


def test_a_view_is_from_where_the_robot_was_when_it_was_scanned():
    odometry = Odometry(5 * NS_PER_S, np.array([1.0, 2.0, np.pi / 2]), np.array([1.0, 0.0, 0.0]))
    state = replace(begin(GIVEN), odometry=odometry)
    scan = Scan(5 * NS_PER_S + NS_PER_S // 10, np.ones(LIDAR.beams, np.float32), (0.0, 0.01))
    assert remember(GIVEN, state, scan)[-1].pose == pytest.approx([1.0, 2.1, np.pi / 2])
    assert remember(config(), state, scan) == ()


def test_a_robot_is_at_rest_before_somebody_who_walks_up_to_it_is_there():
    """The same robot, told that nothing moves, still drives when they meet."""

    def speed_at_meeting(obstacle_speed):
        given = replace(SHIELD, obstacle_speed=obstacle_speed)
        rig = Rig(config(shield=given, frozen_distance=1e9, stuck_s=1e9))
        rig.frozen, rig.wish = True, np.array([0.5, 0.0, 0.0])
        rig.ranges = seen(rig.pose)
        rig.run(1.5)
        assert rig.arm().granted
        person = 2.8
        for tick in range(400):
            rig.speed = float(rig.decision.twist[0])
            person -= 0.8 * 0.02
            if tick % 5 == 4:
                rig.ranges = seen(rig.pose, [(person, 0.0, 0.2)])
            rig.run(0.02)
            if person - 0.2 - rig.pose[0] < SHIELD.footprint_radius:
                return rig.speed
        raise AssertionError("they never met")

    assert speed_at_meeting(1.0) == 0.0
    assert speed_at_meeting(0.0) > 0.01
