"""How a robot stops in the simulator, beside what its shield takes for granted."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from nics_drl_bridge.gate.footprint import get_body
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.gate.stopping import shield_config
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.geometry import between
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import load_world

SHARES = (1.0, 0.5, 0.25, 0.1)
PERIODS = 15


def braking_used(robot: str, given: Mapping[str, float] | None) -> float:
    """The longest way of a robot to rest, in parts of what its shield keeps free for it.

    It drives straight at several speeds in each direction and lets go, at the worst moment: its
    base has just looked for a command, and looks again a control period later. One with an outline
    turns on the spot as well.

    Args:
        robot: a shipped one.
        given: values that go before those that are shipped; None for those.
    """
    model = builtin_model(robot)
    limits = load_limits(robot, model.robot)
    shield, _ = shield_config(model, limits, robot, given)
    sim = FastSimulator(model, load_world("empty"))
    most = 0.0
    reach = get_body(shield).farthest_corner
    for index, (low, high) in enumerate(zip(limits.low, limits.high, strict=True)):
        arm = 1.0 if limits.linear[index] else reach * limits.turn[index]
        if arm == 0.0:
            continue
        for speed in (
            share * end for end in (low, high) if end != 0.0 for share in SHARES
        ):
            kept = abs(speed) * shield.latency_s + arm * speed**2 / (
                2.0 * shield.deceleration
            )
            away = (
                _stopping_distance(sim, index, speed)
                + abs(speed) * model.control_period
            )
            most = max(most, away / kept)
    return most


def _stopping_distance(sim: FastSimulator, index: int, speed: float) -> float:
    """How far from where the command was let go the robot comes [m], or turns on the spot [rad]."""
    command = np.zeros((1, 1, len(sim.model.robot.command)))
    sim.reset([0], starts=np.array([[[-2.0 * np.sign(speed), 0.0, 0.0]]]))
    command[..., index] = speed
    for _ in range(PERIODS):
        sim.step(command)
    let_go = sim.data.pose[0, 0].copy()
    furthest = 0.0
    turns = bool(load_limits(sim.model.robot.name, sim.model.robot).turn[index])
    for _ in range(PERIODS):
        sim.step(0.0 * command)
        # Not the length of its track, which grows by the noise of a robot at rest.
        x, y, angle = np.abs(between(let_go, sim.data.pose[0, 0]))
        furthest = max(furthest, float(angle if turns else np.hypot(x, y)))
    return furthest
