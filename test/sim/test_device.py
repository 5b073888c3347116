from __future__ import annotations

import numpy as np
import pytest
from robots import direct_model

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.sim.device import (
    DeviceWorld,
    propagate,
    step_covariance,
    variances,
)
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import load_world


def test_the_covariance_of_odometry_is_that_of_the_errors_of_many_drives():
    worlds = 400
    steps = 80
    model = builtin_model("mecanum")
    simulator = FastSimulator(model, load_world("empty"), worlds=worlds)
    simulator.reset(range(worlds), starts=np.zeros((worlds, 1, 3)))
    added = step_covariance(model.noise.odometry, model.control_period)
    covariance = np.tile(added, (worlds, 1, 1))
    data = simulator.data
    for k in range(steps):
        before = data.odom[:, 0].copy()
        simulator.step(np.tile([0.3 * np.sin(k / 9.0), 0.2, 0.4], (worlds, 1, 1)))
        covariance = propagate(covariance, before, data.odom[:, 0], added)
    error = data.odom[:, 0] - data.pose[:, 0]
    error[:, 2] = geometry.wrap_angle(error[:, 2])
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    # A mean of 400 of 3 degrees of freedom has a deviation of sqrt(6 / 400).
    assert nees.mean() == pytest.approx(3.0, abs=4 * np.sqrt(6 / worlds))


def test_an_episode_that_would_begin_outside_the_world_is_refused_and_the_one_at_hand_goes_on():
    model = direct_model()
    world = load_world("empty")
    device = DeviceWorld(FastSimulator(model, world), model, 1)
    device.begin(3, np.array([1.0, -1.0, 0.5]))
    with pytest.raises(
        ConfigError, match=r"^episode_start: \(99, 0\) m lies outside the world"
    ):
        device.begin(4, np.array([99.0, 0.0, 0.0]))
    device.advance()
    assert device.simulator.data.pose[0, 0] == pytest.approx([1.0, -1.0, 0.5])


def test_odometry_without_noise_is_not_said_to_be_unknown():
    assert (variances((0.0, 0.0)) > 0.0).all()
    assert (np.linalg.eigvalsh(step_covariance((0.0, 0.0), 0.1)) > 0.0).all()
