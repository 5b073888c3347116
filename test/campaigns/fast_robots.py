"""Do thousands of small, fast robots overlap anything, or pass through it?

Robots of 2 cm drive at up to 50 m/s among each other, walls and obstacles, in fields that two walls
divide into four rooms. They keep their commands for some periods, so that many push and slide.

Bars: no overlap of more than 1 mm, no robot in another room than the one in which it began, and
contacts in most periods. The controls measure the robots 2 mm larger, or take the dividing walls
out of the simulator.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from campaign import Given, Result, at_least, at_most, run_campaign
from numpy.typing import NDArray
from robots import DIRECT, direct_model, lidar

from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import World

RADIUS = 0.02
FASTEST = 50.0
FASTEST_TURN = 100.0
PERIOD_S = 0.01
SIZE = 8.0
ROBOTS = 40
HELD_PERIODS = 5
WALLS = [(-0.5 * SIZE, 0.0, 0.5 * SIZE, 0.0), (0.0, -0.5 * SIZE, 0.0, 0.5 * SIZE)]
FATTER_M = 2e-3
BARS = {
    "overlap_mm": at_most(1.0),
    "passed_a_wall": at_most(0),
    "contacts_per_robot": at_least(0.5),
}


def make_simulator(worlds: int, walls: bool) -> FastSimulator:
    """Return worlds of robots whose commands are their twists."""
    about = DIRECT.model_dump(exclude={"footprint_radius"})
    for command, most in zip(
        about["command"], (FASTEST, FASTEST, FASTEST_TURN), strict=True
    ):
        command["min"] = -most
        command["max"] = most
    robot = RobotSpec.model_validate(about | {"footprint_radius": RADIUS})
    model = direct_model(sensor=lidar(rate=1.0 / PERIOD_S))
    model = dataclasses.replace(model, robot=robot, control_period=PERIOD_S)
    world = World.model_validate(
        {
            "name": "rooms",
            "size": [SIZE, SIZE],
            "walls": WALLS if walls else [],
            "obstacles": [{"shapes": [{"kind": "circle", "radius": 0.2}], "count": 8}],
            "clearance": 0.1,
            "goal_distance": [0.5, SIZE],
        }
    )
    return FastSimulator(model, world, worlds, ROBOTS, warn=lambda message: None)


def find_overlap(bodies: NDArray[np.float64], radius: float) -> float:
    """Return the largest overlap [m] of robots with each other, obstacles and walls."""
    place = bodies[:, -ROBOTS:, :2]
    between = np.linalg.norm(place[:, :, None] - bodies[:, None, :, :2], axis=-1)
    radii = bodies[..., 5].copy()
    radii[:, -ROBOTS:] = radius
    overlap = radius + radii[:, None] - between
    own = np.eye(ROBOTS, bodies.shape[1], bodies.shape[1] - ROBOTS, dtype=bool)
    to_field = np.abs(place) + radius - 0.5 * SIZE
    to_walls = radius - np.abs(place)
    return float(max(overlap[:, ~own].max(), to_field.max(), to_walls.max()))


def measure(given: Given) -> Result:
    """Drive all robots for some periods."""
    walls = given.control != "no_walls"
    simulator = make_simulator(max(1, given.robots // ROBOTS), walls)
    radius = RADIUS + (FATTER_M if given.control == "fat" else 0.0)
    simulator.reset(np.arange(len(simulator.data.steps)) + given.seed)
    bodies = simulator.data.bodies
    shape = simulator.data.pose.shape
    rooms = bodies[:, -ROBOTS:, :2] > 0.0
    rng = np.random.default_rng(given.seed)
    overlap = -np.inf
    contacts = 0
    for step in range(given.steps):
        if step % HELD_PERIODS == 0:
            most = [FASTEST, FASTEST, FASTEST_TURN]
            commands = rng.uniform(-1.0, 1.0, shape) ** 3 * most
        simulator.data.collided[:] = 0
        simulator.step(commands)
        contacts += int(simulator.data.collided.sum())
        overlap = max(overlap, find_overlap(bodies, radius))
    passed = (rooms != (bodies[:, -ROBOTS:, :2] > 0.0)).any(axis=-1)
    return {
        "robots": passed.size,
        "overlap_mm": 1e3 * max(overlap, 0.0),
        "passed_a_wall": int(passed.sum()),
        "contacts_per_robot": contacts / passed.size,
    }


if __name__ == "__main__":
    run_campaign(measure, BARS, {"robots": 10_000, "steps": 300, "seed": 1})
