"""What the nodes and the playback of bags do with messages alike."""

from types import SimpleNamespace

import numpy as np
import pytest

from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.lidar.sectors import Reader
from nics_drl_bridge.middleware.intake import Intake
from nics_drl_bridge.middleware.measurement import ODOM, SCAN

MODEL = builtin_model("differential")


class OneLidar(Intake):
    def find_reader(self, scan):
        if len(scan.ranges) != MODEL.lidar.beams:
            return None
        return Reader(MODEL.lidar, backwards=False)


def at(seconds, **fields):
    stamp = SimpleNamespace(sec=seconds, nanosec=0)
    return SimpleNamespace(header=SimpleNamespace(stamp=stamp), **fields)


def odometry(seconds, x):
    position = SimpleNamespace(x=x, y=0.0)
    turn = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    pose = SimpleNamespace(position=position, orientation=turn)
    zero = SimpleNamespace(x=0.0, y=0.0, z=0.0)
    twist = SimpleNamespace(linear=zero, angular=zero)
    return at(
        seconds,
        pose=SimpleNamespace(pose=pose),
        twist=SimpleNamespace(twist=twist, covariance=np.zeros(36)),
    )


def test_a_pose_that_is_told_before_the_start_holds_from_the_first_odometry_on():
    intake = OneLidar(MODEL, has_pose=False)
    intake.place(np.array([3.0, 4.0, 1.0]), 1e-4 * np.eye(3))
    assert intake.take(ODOM, 0, odometry(1, x=7.0))
    assert intake.middleware.view(NS_PER_S).pose == pytest.approx([3.0, 4.0, 1.0])
    intake.restart()
    assert intake.take(ODOM, 0, odometry(1, x=7.0))
    assert intake.middleware.view(NS_PER_S).pose == pytest.approx([7.0, 0.0, 0.0])


def test_scans_before_the_begin_or_of_another_lidar_are_not_used():
    intake = OneLidar(MODEL, has_pose=False)
    intake.begin(2 * NS_PER_S, np.zeros(3))
    ranges = np.full(MODEL.lidar.beams, 1.0, np.float32)
    assert not intake.take(SCAN, 0, at(1, ranges=ranges))
    assert intake.take(SCAN, 0, at(2, ranges=ranges))
    assert not intake.take(SCAN, 0, at(3, ranges=ranges[1:]))
    (reason,) = intake.middleware.cache.rejected
    assert str(reason) == "scan: another lidar"
