"""The shield of a skid-steer whose turn ends apart from its speed."""

from __future__ import annotations

import numpy as np
import pytest
from skid_rover import kinematics, limits_in, rover_model

from nics_drl_bridge.gate.footprint import get_body
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.gate.shield import STEP, list_stops
from nics_drl_bridge.gate.shield_kernels import compute_clearance, is_free
from nics_drl_bridge.gate.stopping import shield_config
from nics_drl_bridge.robot.braking import derive_slowest_model

HELD_S = 0.4


@pytest.fixture(scope="module")
def model():
    return rover_model()


@pytest.fixture(scope="module")
def shield(model, tmp_path_factory):
    file = limits_in(tmp_path_factory.mktemp("limits"))
    return shield_config(model, load_limits(file, model.robot))[0]


def stopping_poses(plant, command, latency_s):
    """Poses (T, 3) from the steady motion of a command: it is kept for a time, then stopped."""
    state = np.zeros((1, 2))
    pose = np.zeros((1, 3))
    command = np.array([command])
    for _ in range(200):
        _, state = plant.step(pose, state, command)
    poses = [pose[0]]
    for k in range(150):
        told = command if k * plant.dt < latency_s else 0.0 * command
        pose, state = plant.step(pose, state, told)
        poses.append(pose[0])
    return np.array(poses)


@pytest.mark.parametrize("command", [(0.8, 1.2), (-0.4, 1.0), (0.15, -1.2), (0.0, 1.2)])
@pytest.mark.parametrize("responds", ["as its model", "as slowly as its errors allow"])
@pytest.mark.slow
def test_a_point_that_the_shield_takes_for_free_is_never_touched_by_a_stop(
    model, shield, command, responds
):
    plant = kinematics()
    if responds != "as its model":
        plant = derive_slowest_model(plant)
        assert plant is not None
    # The command that the base heard last is followed for a period.
    poses = stopping_poses(plant, command, HELD_S + model.control_period)
    state = np.array(command) * (10.6 / 10.7, 3.21 / 4.45)
    twist = np.array([[state[0], 0.0, state[1]]])
    body = get_body(shield)
    stops = list_stops(shield, HELD_S + shield.latency_s, 1.0, 1.0)
    count = 0
    for x, y in np.random.default_rng(0).uniform(-1.5, 1.5, (700, 2)):
        if compute_clearance(x, y, body) < shield.margin:
            continue
        point = np.array([[x, y, 0.0]])
        if not all(is_free(point, twist, stop, STEP) for stop in stops):
            continue
        count += 1
        c = np.cos(poses[:, 2])
        s = np.sin(poses[:, 2])
        dx = x - poses[:, 0]
        dy = y - poses[:, 1]
        seen = zip(c * dx + s * dy, c * dy - s * dx, strict=True)
        assert (
            min(compute_clearance(*each, body) for each in seen) > 0.5 * shield.margin
        )
    assert count > 50
