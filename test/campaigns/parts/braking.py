"""How a robot stops in the simulator, beside what its shield takes for granted."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from nics_drl_bridge.gate.footprint import get_body
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.gate.stopping import shield_config
from nics_drl_bridge.generator import SimulatorModel, builtin_model
from nics_drl_bridge.geometry import between
from nics_drl_bridge.interface import Array
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import load_world

SHARES = (1.0, 0.5, 0.25, 0.1)
PERIODS = 15


def measure_braking(robot: str, overrides: Mapping[str, float] | None) -> float:
    """Returns the longest way of a robot to rest, in parts of what its shield keeps free for it.

    It drives straight at several speeds in each direction and lets go, at the worst moment: its
    base has just looked for a command, and looks again a control period later. One with an outline
    turns on the spot as well. `overrides` replace values of the shipped shield.
    """
    model = builtin_model(robot)
    limits = load_limits(robot, model.robot)
    shield, _ = shield_config(model, limits, robot, overrides)
    reach = get_body(shield).farthest_corner
    arms = np.where(limits.linear, 1.0, reach * limits.turn)
    ends = np.concatenate([np.diag(limits.low), np.diag(limits.high)])
    commands = np.concatenate([share * ends for share in SHARES])
    commands = commands[(commands * arms).any(axis=1)]
    away = _measure_stops(model, commands, limits.turn)
    speeds = np.abs(commands.sum(axis=1))
    braking = np.abs(commands) ** 2 @ arms / (2.0 * shield.deceleration)
    kept = speeds * shield.latency_s + braking
    return float(((away + speeds * model.control_period) / kept).max())


def _measure_stops(model: SimulatorModel, commands: Array, turns: Array) -> Array:
    """Returns how far from where the commands (N, C) were let go the robot comes [m], or turns."""
    count = len(commands)
    simulator = FastSimulator(model, load_world("empty"), count)
    starts = np.zeros((count, 1, 3))
    starts[:, 0, 0] = -2.0 * np.sign(commands.sum(axis=1))
    simulator.reset(np.zeros(count, np.int64), starts=starts)
    for _ in range(PERIODS):
        simulator.step(commands[:, None])
    pose = simulator.data.pose[:, 0]
    let_go = pose.copy()
    furthest = np.zeros(count)
    for _ in range(PERIODS):
        simulator.step(0.0 * commands[:, None])
        # Not the length of its track, which grows by the noise of a robot at rest.
        x, y, angle = np.abs(between(let_go, pose)).T
        is_turn = (commands != 0.0) @ turns
        furthest = np.maximum(furthest, np.where(is_turn, angle, np.hypot(x, y)))
    return furthest
