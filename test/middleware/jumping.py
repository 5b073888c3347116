"""Drives by odometry alone whose clock is set on the way, and how far off the estimate then is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from robots import field

from middleware.rig import PERIOD, SECOND
from nics_drl_bridge import geometry
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.middleware.middleware import Middleware
from nics_drl_bridge.robot.noise import Level, Noise
from nics_drl_bridge.sim.simulator import FastSimulator

NOISE = Noise(
    odom_linear=Level(std=0.05, unit="m/s", source="measured"),
    odom_angular=Level(std=0.05, unit="rad/s", source="measured"),
    position_drift=Level(std=0.03, unit="m/sqrt(s)", source="measured"),
    heading_drift=Level(std=0.03, unit="rad/sqrt(s)", source="measured"),
)


@dataclass(frozen=True)
class Setting:
    """What happens to the data of a drive.

    Attributes:
        jump_s: what the clock is set by [s].
        latency: periods that data are under way.
        lost: share of odometry that does not arrive.
        pose: what the robot says of its pose by odometry, given (k, odom) of period k.
        silent: periods of which nothing arrives, before the clock is set.
    """

    jump_s: float
    latency: int = 0
    lost: float = 0.0
    pose: Callable[[int, np.ndarray], np.ndarray] = lambda k, odom: odom
    silent: int = 0


def noisy_model(robot):
    """The built-in robot; its state drifts by two per cent of its range within a second."""
    model = builtin_model(robot)
    states = {
        v.name: Level(
            std=0.02 * (v.max - v.min), unit=f"{v.unit}/sqrt(s)", source="measured"
        )
        for v in model.robot.state
    }
    return replace(model, noise=NOISE.model_copy(update={"state_drift": states}))


def full_speed(model, rng):
    """Straight on at the greatest speed, turning at random."""
    command = rng.uniform(model.robot.command_low, model.robot.command_high)
    command[0] = model.robot.command_high[0]
    return command


def errors_after(model, simulator, seed, setting, seconds=12.0):
    """Errors (3,) of the pose and its NEES, at every odometry taken after the clock was set.

    Odometry counts at its stamp, so it is compared with the truth of that moment.
    """
    rng = np.random.default_rng(seed)
    middleware = Middleware(model)
    start = np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    simulator.reset([seed], starts=start[None, None])
    middleware.reset(0, start)
    when = int(rng.integers(20, 40))
    truth = [start]
    underway = []
    errors = []
    nees = []
    command = full_speed(model, rng)
    for k in range(1, round(seconds * 10)):
        if k % 8 == 0:
            command = full_speed(model, rng)
        moved = round(setting.jump_s * SECOND)
        middleware.command((k - 1) * PERIOD + (moved if k > when else 0), command)
        simulator.step(command[None, None])
        truth.append(simulator.data.pose[0, 0].copy())
        shift = moved if k >= when else 0
        silent = when <= k < when + setting.silent
        if rng.random() >= setting.lost and not silent:
            odom = setting.pose(k - when, simulator.data.odom[0, 0].copy())
            underway.append((k, shift, odom, simulator.data.twist[0, 0].copy()))
        while underway and underway[0][0] + setting.latency <= k:
            at, moved, odom, twist = underway.pop(0)
            taken = middleware.odometry(at * PERIOD + moved, k * PERIOD, odom, twist)
            if taken and at >= when:
                belief = middleware.estimator.belief
                assert belief.time_ns == at * PERIOD + moved
                error = belief.mean[:3] - truth[at]
                error[2] = geometry.wrap_angle(error[2])
                errors.append(error)
                nees.append(error @ np.linalg.solve(belief.covariance[:3, :3], error))
    return np.array(errors), np.array(nees), middleware


def campaign(robot, drives, settings, seed=0):
    """First and last errors and NEES after each drive's jump: (D, 3), (D,), (D, 3), (D,)."""
    model = noisy_model(robot)
    simulator = FastSimulator(model, field(200.0))
    rows = []
    for k in range(drives):
        errors, nees, _ = errors_after(
            model, simulator, seed + k, settings[k % len(settings)]
        )
        rows.append((errors[0], nees[0], errors[-1], nees[-1]))
    return [np.array(each) for each in zip(*rows, strict=True)]
