from __future__ import annotations

import numpy as np
import pytest
from robots import circles, field

from nics_drl_bridge.watch.frame import Frame, WorldFrame
from nics_drl_bridge.watch.motion import FASTEST_M_S, LONGEST_S, MotionMeter
from watch.rig import shot, source


def moved(right=0.0, up=0.0, body=(0.0, 0.0), **changes):
    """The known shot with its robot, and its disc, so far away from where they were [m]."""
    known = shot()
    poses = known.poses + np.array([right, up, 0.0])
    bodies = known.bodies.copy()
    bodies[0, :2] += body
    return shot(poses=poses, bodies=bodies, **changes)


def measured(meter, time_s, *shots):
    """Velocities (2,) of the robot and of the disc in each world."""
    found = meter.measure([time_s] * len(shots), shots)
    return [(each.robots[0].tolist(), each.bodies[0].tolist()) for each in found]


def test_a_velocity_is_the_way_between_two_frames_over_their_time():
    meter = MotionMeter()
    assert measured(meter, 1.0, moved()) == [([0.0, 0.0], [0.0, 0.0])]
    ((robot, body),) = measured(meter, 1.2, moved(right=0.1, up=-0.2, body=(0.0, 0.3)))
    assert robot == pytest.approx([0.5, -1.0])
    assert body == pytest.approx([0.0, 1.5])


def test_the_same_frame_once_more_has_the_same_velocities():
    meter = MotionMeter()
    measured(meter, 1.0, moved())
    first = measured(meter, 1.1, moved(right=0.1))
    assert measured(meter, 1.1, moved(right=0.1)) == first
    assert first[0][0] == pytest.approx([1.0, 0.0])


@pytest.mark.parametrize(
    ("time_s", "changes"),
    [
        (0.0, {"right": 0.1}),  # another episode
        (1.1 + 1.1 * LONGEST_S, {"right": 0.1}),
        (1.1, {"right": 0.2 * FASTEST_M_S}),
        (1.1, {"right": 0.1, "member": 1}),
        (1.1, {"right": np.nan}),
    ],
)
def test_what_was_put_elsewhere_does_not_move(time_s, changes):
    meter = MotionMeter()
    measured(meter, 1.0, moved())
    assert measured(meter, time_s, moved(**changes))[0][0] == [0.0, 0.0]


def test_a_new_obstacle_does_not_move_and_the_robot_goes_on():
    meter = MotionMeter()
    measured(meter, 1.0, moved())
    grown = moved(right=0.1)
    two = shot(poses=grown.poses, bodies=np.repeat(grown.bodies, 2, axis=0))
    (velocities,) = meter.measure([1.1], [two])
    assert velocities.bodies.tolist() == [[0.0, 0.0], [0.0, 0.0]]
    assert velocities.robots[0] == pytest.approx([1.0, 0.0])


def test_each_world_has_the_time_of_its_own_episode():
    meter = MotionMeter()
    meter.measure([5.0, 1.0], [moved(), moved()])
    first, second = meter.measure([0.0, 1.1], [moved(right=0.1), moved(right=0.1)])
    assert first.robots[0].tolist() == [0.0, 0.0]
    assert second.robots[0] == pytest.approx([1.0, 0.0])


def test_velocities_go_over_the_wire_of_the_bodies_that_are_there():
    meter = MotionMeter()
    bodies = np.concatenate([np.zeros((1, 7)), moved().bodies])
    later = bodies.copy()
    later[1, 1] += 0.2
    Frame(1.0, (WorldFrame(shot(bodies=bodies)),)).plain(meter)
    frame = Frame(1.1, (WorldFrame(shot(bodies=later)),))
    (world,) = frame.plain(meter)["worlds"]
    assert world["velocities"] == [[0, 0]]
    assert world["body_velocities"] == [[0, 2000]]
    assert len(world["bodies"]) == 1


def test_a_robot_and_a_person_who_walk_have_their_velocities():
    patrol = {"kind": "patrol", "waypoints": [[-2.0, -2.0], [2.0, -2.0]], "speed": 0.5}
    crowd = field(count=1, obstacles=[circles(1) | {"motion": patrol}])
    driven = source(world=crowd)
    meter = MotionMeter()
    try:
        for _ in range(4):
            driven.advance()
            world = driven.frame().plain(meter)["worlds"][0]
    finally:
        driven.close()
    assert np.hypot(*world["body_velocities"][0]) == pytest.approx(500, abs=2)
    assert np.hypot(*world["velocities"][0]) > 100
