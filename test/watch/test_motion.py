from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.watch.motion import FASTEST_M_S, LONGEST_S, MotionMeter
from watch.rig import shot


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
    again = measured(meter, 1.2, moved(right=0.1, up=-0.2, body=(0.0, 0.3)))
    assert again == [(robot, body)]  # the same frame once more
    grown = np.repeat(moved().bodies, 2, axis=0)  # another obstacle
    (velocities,) = meter.measure([1.3], [shot(bodies=grown)])
    assert velocities.bodies.tolist() == [[0.0, 0.0], [0.0, 0.0]]
    assert velocities.robots[0] == pytest.approx([-1.0, 2.0])


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


def test_each_world_has_the_time_of_its_own_episode():
    meter = MotionMeter()
    meter.measure([5.0, 1.0], [moved(), moved()])
    first, second = meter.measure([0.0, 1.1], [moved(right=0.1), moved(right=0.1)])
    assert first.robots[0].tolist() == [0.0, 0.0]
    assert second.robots[0] == pytest.approx([1.0, 0.0])
