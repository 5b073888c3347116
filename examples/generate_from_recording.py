"""A recording of a textbook robot becomes a simulator, which then moves 64 robots at once."""

import numpy as np

from nics_drl_bridge.generator import generate
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.recording import textbook
from nics_drl_bridge.robot.spec import load_robot
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import load_world

robot, world = load_robot("differential"), load_world("arena")
recording = textbook.record(robot, np.random.default_rng(0))
model, _ = generate(recording, robot, load_lidar("paper"), world.shapes)
print(model.report)

simulator = FastSimulator(model, world, worlds=64)
simulator.reset(range(64))
for _ in range(20):
    simulator.step(np.full((64, 1, 2), 0.3))
print("mean distance driven [m]:", np.hypot(*(simulator.data.pose[:, 0, :2]).T).mean().round(2))
