"""Further sensors over ROS 2: published, transformed, awaited, observed and guarded."""

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import LaserScan

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.generator import save_model
from nics_drl_bridge.lidar.further_lidar import FurtherLidar
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.nodes import conversions, gate_inputs, qos
from nics_drl_bridge.nodes.backends import DdsBackend
from nics_drl_bridge.sim.world import load_world
from nodes.peer import drive_alike

pytestmark = pytest.mark.ros
TASK = {"sensors": ["rear_scan"]}


@pytest.fixture(scope="module")
def two_lidars(model, tmp_path_factory):
    """A car with a lidar at its back, and the folder of its model."""
    changes = {"beams": 91, "angle_min": -1.0, "angle_max": 1.0, "noise_std": 0.01}
    changes |= {"name": "rear", "mount": (-0.1, 0.0, np.pi), "frame": "rear_laser"}
    spec = LidarSpec.model_validate(model.lidar.model_dump() | changes)
    made = replace(model, sensors=(FurtherLidar(name="rear_scan", lidar=spec),))
    folder = tmp_path_factory.mktemp("model") / "two"
    save_model(made, folder)
    env = BridgeEnv(model=made, world="arena", task_options=TASK, estimator=True)
    seen, _ = env.reset(seed=0)
    assert seen[-91:].min() < 1.0  # the rear lidar sees something
    env.step(env.action_space.sample())
    return made, str(folder)


def test_an_env_over_dds_sees_both_lidars_as_the_one_in_process(
    launch, meet, domain_id, two_lidars
):
    launch("simulator_node", domain_id, model=two_lidars[1], mode="lockstep")
    peer = meet(domain_id)
    scans = peer.listen(LaserScan, "rear_scan", qos.SENSOR)
    arguments = {"model": two_lidars[0], "world": "arena", "task_options": TASK}
    options = {"domain_id": domain_id}
    here = BridgeEnv(estimator=True, **arguments)
    with closing(BridgeEnv("dds", backend_options=options, **arguments)) as there:
        drive_alike(here, there, seeds=(3,))
        _, *_, info = there.step(there.action_space.sample())
        assert info["rear_scan_stamp_ns"] == info["scan_stamp_ns"]
        # Again, as the first may be published before the peer's subscription is known.
        peer.until(lambda: there.reset(seed=0) and scans, "a scan from the back")
    assert scans[-1].header.frame_id == "rear_laser"
    sensor = two_lidars[0].sensors[0]
    assert sensor.read(scans[-1]).shape == (91,)


def test_a_sensor_that_nobody_publishes_is_missing(domain_id, two_lidars):
    options = {"domain_id": domain_id, "timeout_s": 0.3}
    with pytest.raises(BackendError, match="no publisher of /rear_scan"):
        DdsBackend(two_lidars[0], load_world("arena"), **options)


def test_the_gate_reads_where_a_sensor_shows_something(two_lidars):
    sensor = two_lidars[0].sensors[0]
    reading = np.full(91, np.inf, np.float32)
    reading[45] = 0.5
    message = conversions.sensor_to_ros(sensor, reading, 7_000_000_000, "rear_laser")
    given = gate_inputs.read_sensor(sensor, serialize_message(message))
    assert (given.stamp_ns, given.name) == (7_000_000_000, "rear_scan")
    assert given.points == pytest.approx(np.array([[-0.6, 0.0]]), abs=1e-5)
    with pytest.raises(ValueError, match="LaserScan"):
        gate_inputs.read_sensor(sensor, b"\x00\x01\x00\x00nothing")
