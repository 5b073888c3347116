"""A robot with more than one sensor, in process; a kind of sensor of a user's own, in one file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from robots import direct_model, field, lidar

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.registry import make_task
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import BridgeError, ConfigError
from nics_drl_bridge.generator import load_model, save_model
from nics_drl_bridge.lidar.further_lidar import FurtherLidar
from nics_drl_bridge.lidar.scanner import Scanner
from nics_drl_bridge.lidar.sensor import add_sensor_kind, load_sensor, sensor_of_data
from nics_drl_bridge.lidar.table import LidarTable
from nics_drl_bridge.policy.file.contract import make_contract, read_contract
from nics_drl_bridge.sim.simulator import FastSimulator

SONAR = '''
"""How far it is to the nearest thing straight ahead of the robot's centre, of any shape."""

from typing import ClassVar

import numpy as np

from nics_drl_bridge.lidar.exact_kernels import RADIUS, X, Y
from nics_drl_bridge.lidar.sensor import Sensor


class Nearest(Sensor):
    message = "sensor_msgs/msg/Range"
    size: ClassVar[int] = 1
    mount: ClassVar[tuple[float, float, float]] = (0.0, 0.0, 0.0)

    reach: float = 5.0

    def renderer(self, around):
        def render(out, worlds):
            for n in worlds:
                bodies = around.state.bodies[n, : around.first]
                for m, pose in enumerate(around.state.pose[n]):
                    away = np.hypot(bodies[:, X] - pose[0], bodies[:, Y] - pose[1])
                    gaps = np.where(bodies[:, RADIUS] > 0.0, away - bodies[:, RADIUS], np.inf)
                    out[n, m, 0] = min(gaps.min(initial=np.inf), self.reach)

        return render

    def write(self, message, reading):
        message.max_range, message.range = self.reach, float(reading[0])

    def read(self, message):
        return np.array([message.range], np.float32)

    def shares(self, readings):
        return (readings / self.reach).astype(np.float32)
'''


def rear(**changes) -> FurtherLidar:
    """A coarse lidar that looks back."""
    back = {
        "beams": 31,
        "angle_min": -1.5,
        "angle_max": 1.5,
        "mount": (-0.1, 0.05, np.pi),
    }
    return FurtherLidar(
        name="rear", lidar=lidar(**{**back, "frame": "back", **changes})
    )


@pytest.fixture(scope="module")
def model():
    return replace(direct_model(), sensors=(rear(),))


@pytest.fixture
def sonar(tmp_path):
    file = tmp_path / "sonar.py"
    file.write_text(SONAR)
    kind = add_sensor_kind(f"{file}:Nearest")
    return kind(kind="Nearest", name="sonar", reach=4.0)


def test_a_yaml_file_names_a_kind_that_the_caller_imported_and_no_file_of_code(
    tmp_path,
):
    (tmp_path / "nearest.py").write_text(SONAR)
    file = tmp_path / "sonar.yaml"
    file.write_text("{kind: 'nearest.py:Nearest', name: sonar}\n")
    with pytest.raises(ConfigError, match=r"sonar\.yaml: .*names a file of code"):
        load_sensor(file)
    kind = add_sensor_kind(f"{tmp_path}/nearest.py:Nearest")
    file.write_text("{kind: Nearest, name: sonar}\n")
    assert type(load_sensor(file)) is kind


def test_a_second_lidar_scans_what_the_exact_scanner_sees_from_its_place(model):
    simulator = FastSimulator(model, field(6.0, 5), worlds=3, robots=2)
    simulator.reset(range(3))
    simulator.step(np.full((3, 2, 3), 0.3))
    spec = model.sensors[0].lidar
    table = LidarTable.without_rows(spec, simulator._scanner.table.shapes)
    scanner = Scanner(spec, table, "exact")
    data = simulator.data
    for m in range(2):
        others = np.delete(data.bodies, simulator.sampler.count + m, axis=1)
        seen = scanner.scan(data.pose[:, m], others, simulator.world.all_walls())
        found = simulator.readings["rear"][:, m]
        assert np.isfinite(seen).any()
        hit = np.isfinite(seen) & np.isfinite(found)
        assert hit.sum() > 0.95 * np.isfinite(seen).sum()
        assert np.median(np.abs(found[hit] - seen[hit])) < 0.01


def test_its_noise_is_its_own_and_the_same_in_any_batch(model):
    with pytest.raises(ConfigError, match="the name or frame is already in use"):
        replace(model, sensors=(rear(), rear()))
    other = FurtherLidar(name="other", lidar=rear(noise_std=0.05, frame="other").lidar)
    noisy = replace(model, sensors=(rear(noise_std=0.05), other))
    one = FastSimulator(noisy, field(6.0, 5))
    many = FastSimulator(noisy, field(6.0, 5), 3)
    one.reset([7])
    many.reset([5, 6, 7])
    assert np.array_equal(one.readings["rear"][0], many.readings["rear"][2])
    assert not np.array_equal(one.readings["rear"], one.readings["other"])


@pytest.mark.parametrize("estimator", [False, True])
def test_a_task_observes_it_alike_alone_and_among_many(model, estimator):
    options = {"sensors": ["rear"]}
    env = BridgeEnv(
        model=model, world=field(6.0, 5), task_options=options, estimator=estimator
    )
    many = BridgeVectorEnv(3, model, field(6.0, 5), task_options=options)
    single, _ = env.reset(seed=0)
    batch, _ = many.reset(seed=0)
    assert single.shape == (72 + 6 + 31,) == env.observation_space.shape
    for _ in range(5):
        action = env.action_space.sample()
        single, _, _, _, info = env.step(action)
        batch, *_ = many.step(np.tile(action, (3, 1)))
        assert np.array_equal(single[-31:], batch[0, -31:]) or estimator
        assert env.observation_space.contains(single)
    assert info["sensed_age_s"] == 0.0
    assert 0.0 < single[-31:].min() < 1.0


def test_a_model_with_sensors_is_saved_whole(model, tmp_path):
    save_model(model, tmp_path / "model")
    found = load_model(tmp_path / "model")
    assert found.sensors == model.sensors
    assert found.fingerprint == model.fingerprint != direct_model().fingerprint


def test_a_policy_names_the_sensors_that_it_observes(model):
    task = make_task("navigation", model, {"sensors": ["rear"]})
    golden = {
        "observations": np.zeros((16, 109), np.float32),
        "actions": np.zeros((16, 3), np.float32),
        "commands": np.zeros((16, 3), np.float32),
    }
    text = make_contract(task, model, golden, "0" * 64, {"command": "test"})
    assert read_contract(text, "policy").sensors == model.sensors


def test_a_kind_in_a_file_of_a_users_own_is_simulated_and_observed(sonar, tmp_path):
    model = replace(direct_model(), sensors=(sonar,))
    save_model(model, tmp_path / "model")
    assert load_model(tmp_path / "model").sensors == (sonar,)
    env = BridgeEnv(
        model=model, world=field(6.0, 5), task_options={"sensors": ["sonar"]}
    )
    observation, _ = env.reset(seed=1)
    simulator = env._backend.simulator
    bodies = simulator.obstacles[0]
    pose = simulator.data.pose[0, 0]
    gap = (np.hypot(*(bodies[:, :2] - pose[:2]).T) - bodies[:, 5])[
        bodies[:, 5] > 0.0
    ].min()
    assert observation[-1] == pytest.approx(min(gap / 4.0, 1.0), abs=1e-6)


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"kind": "sonar", "name": "a"}, "unknown sensor 'sonar'.*lidar"),
        ({"name": "a"}, "needs a 'kind'"),
        ({"kind": "lidar", "name": "a"}, "lidar"),
        ({"kind": "nowhere.py:Sonar", "name": "a"}, "names a file of code"),
    ],
)
def test_what_is_no_sensor_is_refused(given, named):
    with pytest.raises(ConfigError, match=named):
        sensor_of_data(given)


def test_a_task_that_observes_no_sensors_refuses_them(model):
    with pytest.raises(BridgeError, match="does not observe additional sensors"):
        make_task("cooperative_reaching", model, {"sensors": ["rear"]})
    with pytest.raises(ConfigError, match=r"no sensor 'raer'.*rear"):
        make_task("navigation", model, {"sensors": ["raer"]})
