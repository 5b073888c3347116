"""A third engine that nobody here wrote, built on the parts that all engines share."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

from nics_drl_bridge import geometry
from nics_drl_bridge.generator import SimulatorModel, builtin_model
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import World, load_world

from .campaign import FOLDER

pytest.importorskip("pybullet", reason="needs PyBullet: pip install pybullet==3.2.7")
pytestmark = pytest.mark.campaign
WIDE = load_world("empty").model_copy(update={"size": (40.0, 40.0)})


@pytest.fixture
def simulator(monkeypatch):
    monkeypatch.setattr(sys, "path", [str(FOLDER), *sys.path])
    from parts.pybullet_simulator import PybulletSimulator

    return PybulletSimulator


def exact(name: str) -> SimulatorModel:
    """A shipped model whose lidar measures without noise."""
    model = builtin_model(name)
    lidar = model.lidar.model_copy(update={"noise_std": 0.0})
    return replace(model, lidar=lidar)


@pytest.mark.parametrize("world", [load_world("crowd"), load_world("room")], ids=str)
def test_its_rays_measure_what_the_exact_scanner_computes(
    simulator, world: World
) -> None:
    model = exact("differential")
    ours = simulator(model, world)
    theirs = FastSimulator(model, world, renderer="exact")
    far = beams = 0
    for seed in range(4):
        for each in (ours, theirs):
            each.reset([seed])
        pair = ours.data.ranges[0, 0], theirs.data.ranges[0, 0]
        assert np.isfinite(pair[0]).sum() > 100
        far += int((~np.isclose(*pair, rtol=0.0, atol=0.01)).sum())
        beams += model.lidar.beams
    assert far <= 0.002 * beams


@pytest.mark.parametrize("name", ["ackermann", "differential", "mecanum"])
def test_a_robot_that_does_not_slip_moves_nearly_as_the_model_says(simulator, name):
    model = builtin_model(name)
    command = np.zeros((1, 1, len(model.robot.command)))
    command[..., 0] = 0.6
    command[..., -1] = 0.4 * model.robot.command_high[-1]
    moved = []
    for each in (simulator(model, WIDE), FastSimulator(model, WIDE)):
        each.reset([0], starts=np.zeros((1, 1, 3)))
        for _ in range(15):
            each.step(command)
        before = each.data.pose[0, 0].copy()
        for _ in range(5):
            each.step(command)
        step = geometry.between(before, each.data.pose[0, 0])
        moved.append([np.hypot(*step[:2]), step[2]])
    assert moved[0] == pytest.approx(moved[1], rel=0.07)


def test_a_jackal_skids_in_turns(simulator):
    ours = simulator(builtin_model("jackal"), WIDE)
    ours.reset([0], starts=np.zeros((1, 1, 3)))
    turned = 0.0
    for _ in range(30):
        before = ours.data.pose[0, 0].copy()
        ours.step(np.array([[[0.0, 1.5]]]))
        turned += geometry.between(before, ours.data.pose[0, 0])[2]
    assert ours.data.pose[0, 0, :2] == pytest.approx(0.0, abs=0.05)
    assert turned == pytest.approx(3.0 * 1.5, rel=0.2)


@pytest.mark.parametrize("name", ["ackermann", "differential", "jackal", "mecanum"])
def test_a_robot_that_drives_into_a_wall_stops_there_and_has_collided(simulator, name):
    model = builtin_model(name)
    ours = simulator(model, load_world("empty"))
    ours.reset([0], starts=np.array([[[2.0, 0.0, 0.0]]]))
    command = np.zeros((1, 1, len(model.robot.command)))
    command[..., 0] = 0.7
    collided = []
    for _ in range(30):
        ours.step(command)
        collided.append(int(ours.data.collided[0, 0]))
    outline = model.robot.footprint or [(model.robot.footprint_radius, 0.0)]
    assert ours.data.pose[0, 0, 0] == pytest.approx(
        3.0 - max(x for x, _ in outline), abs=0.015
    )
    first = collided.index(1)
    assert 8 < first < 25
    assert collided == [0] * first + [1] * (30 - first)


def test_putting_obstacles_keeps_the_motion_of_the_robot(simulator):
    model = builtin_model("differential")
    ours = simulator(model, load_world("crowd"))
    ours.reset([2])
    for _ in range(5):
        ours.step(np.array([[[0.3, 0.0]]]))
    before = ours._rigs[0].read()
    ours.put_bodies(ours.obstacles[0].copy())
    after = ours._rigs[0].read()
    assert after.pose == pytest.approx(before.pose, abs=1e-9)
    assert after.twist == pytest.approx(before.twist, abs=1e-9)
