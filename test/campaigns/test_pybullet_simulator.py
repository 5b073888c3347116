"""A third engine that nobody here wrote, built on the parts that all engines share.

It passes the tests of the engines that come with the package, as far as it has one robot.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pybullet", reason="needs PyBullet: pip install pybullet==3.2.7")

from extras.physics import test_simulators as shared
from extras.physics.driving import drive
from extras.physics.engines import Engine
from extras.physics.test_simulators import (  # noqa: F401
    test_a_footprint_of_corners_touches_by_its_corners,
    test_a_robot_that_drives_into_a_wall_stops_there_and_has_collided,
    test_a_wrong_command_is_refused,
    test_an_episode_is_the_same_bits_whatever_was_before,
    test_faults_of_sensors_are_drawn_as_in_the_fast_simulator,
    test_wheel_odometry_is_wrong_after_a_turn_in_which_the_wheels_skid,
)

from nics_drl_bridge import geometry
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import load_world

from .campaign import FOLDER

pytestmark = pytest.mark.campaign


class PybulletEngine(Engine):
    """The campaigns' own engine."""

    def find(self, kind: str) -> Any:
        """See `Engine`."""
        return getattr(import_module("parts.pybullet_simulator"), kind)


@pytest.fixture
def engine(monkeypatch) -> Engine:
    monkeypatch.setattr(sys, "path", [str(FOLDER), *sys.path])
    return PybulletEngine(
        name="PyBullet",
        library="pybullet",
        rest_error=3e-3,
        encoder_error=0.02,
        skid_error=0.1,
        slip_error=0.07,
        wall_error=0.015,
    )


@pytest.mark.parametrize("name", ["ackermann", "differential", "mecanum"])
def test_a_robot_that_does_not_slip_moves_nearly_as_the_model_says(engine, name):
    shared.test_a_robot_that_does_not_slip_moves_nearly_as_the_model_says(engine, name)


@pytest.mark.parametrize("world", [load_world("crowd"), load_world("room")], ids=str)
def test_its_rays_measure_what_the_exact_scanner_computes(engine, world):
    model = builtin_model("differential")
    lidar = model.lidar.model_copy(update={"noise_std": 0.0})
    model = replace(model, lidar=lidar)
    ours = engine.simulator(model, world)
    theirs = FastSimulator(model, world, renderer="exact")
    far = 0
    for seed in range(4):
        for simulator in (ours, theirs):
            simulator.reset([seed])
        pair = ours.data.ranges[0, 0], theirs.data.ranges[0, 0]
        assert np.isfinite(pair[0]).sum() > 100
        far += int((~np.isclose(*pair, rtol=0.0, atol=0.01)).sum())
    assert far <= 0.002 * 4 * lidar.beams


def test_a_jackal_skids_in_turns(engine):
    world = load_world("empty").model_copy(update={"size": (40.0, 40.0)})
    ours = engine.simulator(builtin_model("jackal"), world)
    ours.reset([0], starts=np.zeros((1, 1, 3)))
    turned = 0.0
    for _ in range(30):
        before = ours.data.pose[0, 0].copy()
        ours.step(np.array([[[0.0, 1.5]]]))
        turned += geometry.between(before, ours.data.pose[0, 0])[2]
    assert ours.data.pose[0, 0, :2] == pytest.approx(0.0, abs=0.05)
    assert turned == pytest.approx(3.0 * 1.5, rel=0.2)


def test_putting_obstacles_keeps_the_motion_of_the_robot(engine):
    ours = engine.simulator(builtin_model("differential"), load_world("crowd"))
    ours.reset([2])
    drive(ours, np.array([[[0.3, 0.0]]]), 5)
    before = ours._rigs[0].read()
    ours.put_bodies(ours.obstacles[0].copy())
    after = ours._rigs[0].read()
    assert after.pose == pytest.approx(before.pose, abs=1e-9)
    assert after.twist == pytest.approx(before.twist, abs=1e-9)
