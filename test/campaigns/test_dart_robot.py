"""A skid-steer robot in a physics engine that nobody here wrote."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from .campaign import FOLDER

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
pytest.importorskip("dartpy", reason="needs DART: dartpy is not installed")

SIZE = [8.0, 8.0]
ORIGIN = [0.0, 0.0, 0.0]


@pytest.fixture
def dart(monkeypatch):
    monkeypatch.setattr(sys, "path", [str(FOLDER), *sys.path])
    from parts import dart_skid_steer

    return dart_skid_steer


def turned(engine, dart, seconds: float) -> tuple[float, float]:
    """Lets the robot turn on the spot; returns its true turn and that by its wheels [rad]."""
    true_turn = 0.0
    by_wheels = 0.0
    for _ in range(round(seconds / dart.STEP_S)):
        engine.wheel_speeds[:] = [-2.0, 2.0, -2.0, 2.0]
        engine.step()
        speeds = dart.WHEEL_RADIUS * engine.measured_wheel_speeds
        true_turn += dart.STEP_S * engine.turn_rate
        by_wheels += dart.STEP_S * (speeds[1] - speeds[0]) / dart.BELIEVED_TRACK
    return true_turn, by_wheels


def test_its_wheels_slip_when_it_turns_so_that_odometry_believes_in_too_much(dart):
    engine = dart.Engine(SIZE, [], ORIGIN)
    true_turn, by_wheels = turned(engine, dart, 4.0)
    assert true_turn > 0.5
    assert by_wheels > 1.15 * true_turn


def test_a_held_body_stands_while_its_wheels_go_on(dart):
    engine = dart.Engine(SIZE, [], ORIGIN)
    engine.hold(True)
    true_turn, by_wheels = turned(engine, dart, 1.0)
    assert abs(true_turn) < 0.01
    assert by_wheels > 0.3
    engine.hold(False)
    assert turned(engine, dart, 1.0)[0] > 0.1


def test_a_pillar_in_its_way_is_seen_and_touched(dart):
    engine = dart.Engine(SIZE, [[2.0, 0.0, 0.3]], [0.8, 0.0, 0.0])
    ranges = engine.cast_scan()
    assert ranges[np.argmin(np.abs(dart.LIDAR.angles))] == pytest.approx(0.9, abs=0.01)
    for _ in range(round(2.0 / dart.STEP_S)):
        assert not engine.touches or engine.pose[0] > 1.0
        engine.wheel_speeds[:] = 4.0
        engine.step()
    assert engine.touches
