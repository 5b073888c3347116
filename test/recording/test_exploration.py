from __future__ import annotations

import numpy as np
import pytest
from robots import DIRECT

from nics_drl_bridge import geometry
from nics_drl_bridge.identify.excitation import commands_together, levels, unmoved_variables
from nics_drl_bridge.recording.excite import (
    PERIOD_S,
    STILL_S,
    DrivePlan,
    Exploration,
    expected_motion,
)
from nics_drl_bridge.recording.recording import samples_on_one_clock
from nics_drl_bridge.robot.spec import load_robot

ROBOTS = [load_robot(name) for name in ("ackermann", "differential", "mecanum")] + [DIRECT]
STILL = round(STILL_S / PERIOD_S)

robots = pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.name)


@robots
@pytest.mark.parametrize("seed", range(3))
def test_the_whole_robot_keeps_within_its_circle(robot, seed):
    pattern = DrivePlan(robot, bound=2.0, duration=60.0, seed=seed).preview()
    away = np.hypot(*pattern.pose[:, :2].T) + robot.footprint_radius
    assert 0.8 < away.max() <= 2.0


@robots
def test_it_begins_and_ends_at_rest(robot):
    pattern = DrivePlan(robot, duration=30.0).preview()
    assert len(pattern.command) == 30.0 / PERIOD_S
    assert (pattern.command[:STILL] == 0.0).all()
    assert np.abs(pattern.command[-STILL:]).max() < 1e-12
    assert np.abs(pattern.twist[-1]).max() < 1e-3


@robots
@pytest.mark.parametrize("speed", [1.0, 0.5])
def test_commands_stay_within_a_share_of_the_limits_that_leaves_angles_alone(robot, speed):
    command = DrivePlan(robot, duration=60.0, speed=speed).preview().command
    share = np.array([1.0 if c.unit == "rad" else speed for c in robot.command])
    assert (command >= share * robot.command_low - 1e-12).all()
    assert (command <= share * robot.command_high + 1e-12).all()
    width = share * (robot.command_high - robot.command_low)
    assert (np.ptp(command, axis=0) > 0.8 * width).all()


@robots
@pytest.mark.parametrize("duration", [20.0, 60.0])
def test_every_command_is_moved_by_the_rules_that_a_fit_judges_a_drive_by(robot, duration):
    pattern = DrivePlan(robot, duration=duration).preview()
    t = pattern.period * np.arange(len(pattern.command))
    none = np.zeros((len(t), 0))
    stateless = robot.model_copy(update={"state": ()})
    samples = samples_on_one_clock(t, pattern.pose[:-1], none, pattern.command)
    assert unmoved_variables(samples, stateless) == ()
    assert commands_together(samples, stateless) == ()
    assert set(levels(samples, stateless).values()) == {10}
    # Each also changes while the others are held: on its own.
    changes = np.abs(np.diff(pattern.command, axis=0)) > 1e-9
    alone = changes & (changes.sum(axis=1) == 1)[:, None]
    assert alone.any(axis=0).all()
    assert (changes.sum(axis=1) == len(robot.command)).any()


def test_a_robot_that_can_reverse_does():
    command = DrivePlan(load_robot("mecanum")).preview().command
    assert (command.min(axis=0) < -0.5).all()


def test_a_seed_tells_a_drive():
    one, same, other = (DrivePlan(ROBOTS[0], seed=seed).preview().command for seed in (1, 1, 2))
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)


def drive_another(robot, really, gain, seed):
    """Greatest distance of a robot that moves otherwise than expected, and is watched."""
    drive = DrivePlan(robot, bound=2.0, duration=60.0, seed=seed).begin()
    motion = expected_motion(really)
    pose, state, away = np.zeros((1, 3)), np.zeros((1, motion.size)), 0.0
    while not drive.done:
        command = gain * drive.next()
        poses, states = motion.roll(pose, state, command[None, None], PERIOD_S)
        pose, state = poses[:, -1], states[:, -1]
        drive.see(pose[0])
        away = max(away, float(np.hypot(*pose[0, :2])))
    return away + robot.footprint_radius


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("name", "changes", "gain"),
    [
        ("ackermann", {"wheelbase": 0.24, "speed_lag": 0.2}, (1.1, 1.0)),
        ("ackermann", {"wheelbase": 0.17, "steering_lag": 0.2}, (0.8, 1.0)),
        ("differential", {"track": 0.25, "wheel_lag": 0.2}, (1.1, 0.9)),
        ("mecanum", {"wheel_lag": 0.2}, (1.2, 0.8, 1.2)),
    ],
)
def test_a_robot_that_moves_otherwise_than_expected_is_kept_within_too(name, changes, gain, seed):
    robot = load_robot(name)
    really = robot.model_copy(update={"parameters": {**robot.parameters, **changes}})
    assert drive_another(robot, really, np.array(gain), seed) <= 2.0


def test_without_being_watched_such_a_robot_would_leave(monkeypatch):
    robot = load_robot("ackermann")
    really = robot.model_copy(update={"parameters": {**robot.parameters, "wheelbase": 0.24}})
    monkeypatch.setattr(Exploration, "see", lambda *_: None)
    away = [drive_another(robot, really, np.array([1.1, 1.0]), seed) for seed in range(3)]
    assert max(away) > 2.0


def test_what_is_seen_moves_the_expected_pose():
    drive = DrivePlan(ROBOTS[1]).begin()
    while not np.hypot(*drive.pose[:2]) > 0.1:
        before = drive.pose
        drive.next()
    step = geometry.between(before, drive.pose)
    drive.see(np.array([5.0, 0.0, 1.0]))
    assert geometry.between([5.0, 0.0, 1.0], drive.pose) == pytest.approx(step)
