import numpy as np
import pytest

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.extras.mujoco.machines import build_machine
from nics_drl_bridge.extras.mujoco.simulator import MujocoRobot
from nics_drl_bridge.extras.physics.machines import fit_roller
from nics_drl_bridge.extras.physics.simulator import record
from nics_drl_bridge.identify.identify import identify
from nics_drl_bridge.robot.spec import RobotSpec, load_robot


@pytest.mark.slow
def test_a_model_is_identified_from_a_drive():
    pytest.importorskip("mujoco", reason="needs MuJoCo: the extra `mujoco`")
    robot = MujocoRobot(load_robot("differential"))
    drive = record(robot, np.random.default_rng(0), 20.0)
    found = identify(drive, robot.spec)
    assert found.held_out is not None
    assert found.held_out.mean_position_error_m < 0.03 * found.held_out.mean_path_m


def test_rollers_make_a_wheel_round():
    radius = 0.05
    count = 12
    a, b = fit_roller(radius, count)
    q = np.linspace(0.0, np.pi / count, 50)
    reach = (radius - a) * np.cos(q) + np.sqrt(
        a**2 + (b**2 - a**2) * np.sin(q) ** 2 / 2.0
    )
    assert reach == pytest.approx(radius, rel=2e-3)
    assert reach[[0, -1]] == pytest.approx(radius)


def test_a_spec_without_a_length_is_refused_by_its_name():
    data = load_robot("ackermann").model_dump()
    del data["parameters"]["wheelbase"]
    with pytest.raises(ConfigError, match="wheelbase"):
        build_machine(RobotSpec.model_validate(data))
