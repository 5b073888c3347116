"""Every shipped robot can be armed with the parameters that the launch files give its nodes."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

import yaml

from nics_drl_bridge.config import find_config, list_shipped
from nics_drl_bridge.gate import inputs
from nics_drl_bridge.gate.gate import decide
from nics_drl_bridge.gate.state import begin
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.nodes.command_gate import declare_gate
from nics_drl_bridge.nodes.parameters import NODES

pytestmark = pytest.mark.ros

ROBOTS = list_shipped("robots")
FILE = find_config("bridge", "nodes")
TICK_S = 0.02
SETTLED_S = 3.0
START_NS = 10**18


class Standing:
    """A robot that stands in the open, whose topics come at the rates of its model."""

    def __init__(self, config, model):
        self.config = config
        self.model = model
        self.state = begin(config)
        self.now = 0.0

    def give(self, event):
        self.state, decision = decide(self.config, self.state, event, self.now)
        return decision

    def stand(self, seconds):
        """Lets time pass while all topics come."""
        lidar = self.model.lidar
        scans = 0
        odometries = 0
        for tick in range(round(seconds / TICK_S)):
            self.now = tick * TICK_S
            while odometries * self.model.control_period <= self.now:
                stamp = START_NS + round(
                    odometries * self.model.control_period * NS_PER_S
                )
                self.give(inputs.Odometry(stamp, np.zeros(3), np.zeros(3)))
                self.give(
                    inputs.Estimate(np.zeros(3), np.zeros(3), np.diag([1e-4] * 3))
                )
                odometries += 1
            while scans / lidar.rate <= self.now:
                stamp = START_NS + round(scans / lidar.rate * NS_PER_S)
                ranges = np.full(lidar.beams, 2.0 + 1e-3 * scans, np.float32)
                angles = (lidar.angle_min, lidar.angle_increment)
                self.give(inputs.Scan(stamp, ranges, angles))
                scans += 1
            self.give(inputs.Tick())


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_shipped_robot_is_armed_with_the_shipped_parameters(make_node, robot):
    words = ["--params-file", str(FILE), "-r", "__node:=command_gate"]
    for given in (f"model:={robot}", f"limits:={robot}", "e_stop_required:=false"):
        words += ["-p", f"command_gate:{given}"]  # as specific as those of `launch`
    model = builtin_model(robot)
    standing = Standing(declare_gate(make_node(words=words), model), model)
    standing.stand(SETTLED_S)
    answer = standing.give(inputs.Arm(publishers=1))
    assert answer.granted, answer.answer


@pytest.mark.parametrize("node", NODES)
def test_the_shipped_file_sets_nothing_that_a_node_derives_from_the_robot(node):
    content = yaml.safe_load(FILE.read_text(encoding="utf-8"))
    given = content.get(f"/**/{node}", {"ros__parameters": {}})["ros__parameters"]
    derived = {row.name for row in NODES[node]().parameters if row.shown}
    assert not derived & given.keys()
