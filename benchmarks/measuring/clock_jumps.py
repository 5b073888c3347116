"""Drives by odometry alone, at full speed, whose clock is set on the way."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.middleware.middleware import Middleware
from nics_drl_bridge.sim.simulator import FastSimulator

Array = NDArray[np.float64]
SECOND = 1_000_000_000
PERIOD = SECOND // 10
LATE, LOST = 1, 0.05
"""Periods that odometry is under way, and the share that gets lost."""
PERIODS = 160
JUMPS_S = (-3600.0, -30.0, -2.0, -1.5, -0.5, -0.3, 0.3, 0.5, 0.9, 5.0, 3600.0)


@dataclass(frozen=True)
class Jumped:
    """What became of a drive: its first estimate after the jump, then its last one.

    Attributes:
        error: (2,) distance from the truth [m]; inf where nothing was used after the jump.
        nees: (2,) of the pose.
        driven: way since the last odometry before the jump, until the first after it [m].
    """

    error: Array
    nees: Array
    driven: float


def drive(
    model: SimulatorModel,
    simulator: FastSimulator,
    made: Middleware,
    seed: int,
    moving: bool,
) -> Jumped:
    """Drives with data that are late, and lost at times, and sets the clock once.

    Args:
        model: of the robot, with its noise.
        simulator: that moves it.
        made: what estimates.
        seed: of all that is random.
        moving: whether it drives at all.
    """
    rng = np.random.default_rng(seed)
    start = np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    simulator.reset([seed], starts=start[None, None])
    made.reset(0, start)
    when = int(rng.integers(30, 100))
    shift = round(JUMPS_S[seed % len(JUMPS_S)] * SECOND)
    truth = [start]
    underway = deque[tuple[int, Any]]()
    found = list[tuple[int, float, float]]()
    command = _command(model, rng, moving)
    for k in range(1, PERIODS):
        if k % 8 == 0:
            command = _command(model, rng, moving)
        made.command((k - 1) * PERIOD + (shift if k > when else 0), command)
        simulator.step(command[None, None])
        truth.append(simulator.data.pose[0, 0].copy())
        told = simulator.data.odom[0, 0].copy(), simulator.data.twist[0, 0].copy()
        if rng.random() >= LOST:
            underway.append((k, told))
        while underway and underway[0][0] + LATE <= k:
            at, (odom, twist) = underway.popleft()
            stamp = at * PERIOD + (shift if at >= when else 0)
            if made.odometry(stamp, k * PERIOD, odom, twist) and at >= when:
                found.append((at, *_error(made, stamp, truth[at])))
    return _jumped(found, np.array(truth), when)


def _command(model: SimulatorModel, rng: np.random.Generator, moving: bool) -> Array:
    """Straight on at full speed, turning at random."""
    command = rng.uniform(model.robot.command_low, model.robot.command_high)
    command[0] = model.robot.command_high[0]
    return np.asarray(command * moving)


def _error(made: Middleware, stamp_ns: int, truth: Array) -> tuple[float, float]:
    """Distance [m] and NEES of what is estimated for the stamp of an odometry just used."""
    belief = made.estimator.belief
    view = made.view(stamp_ns)
    error = view.pose - truth
    error[2] = geometry.wrap_angle(error[2])
    nees = float(error @ np.linalg.solve(belief.covariance[:3, :3], error))
    return float(np.hypot(*error[:2])), nees


def _jumped(found: list[tuple[int, float, float]], truth: Array, when: int) -> Jumped:
    if not found:
        return Jumped(np.full(2, np.inf), np.full(2, np.inf), 0.0)
    first = found[0]
    last = found[-1]
    way = np.diff(truth[when - 1 : first[0] + 1, :2], axis=0)
    ends = np.array([first[1:], last[1:]])
    return Jumped(ends[:, 0], ends[:, 1], float(np.hypot(*way.T).sum()))


def campaign(
    model: SimulatorModel,
    simulator: FastSimulator,
    make: Callable[[SimulatorModel], Middleware],
    seeds: range,
    moving: bool,
) -> list[Jumped]:
    """One drive for each seed, by turns with each of `JUMPS_S`."""
    return [drive(model, simulator, make(model), seed, moving) for seed in seeds]


def summary(drives: list[Jumped]) -> dict[str, Any]:
    """What the drives show together."""
    error = np.array([d.error for d in drives])
    nees = np.array([d.nees for d in drives])
    return {
        "drives": len(drives),
        "driven_unseen_m": float(np.mean([d.driven for d in drives])),
        "error_p50_m": float(np.median(error[:, 0])),
        "error_p99_m": float(np.quantile(error[:, 0], 0.99)),
        "nees_mean": float(np.mean(nees[:, 0])),
        "nees_p99": float(np.quantile(nees[:, 0], 0.99)),
        "end_error_p99_m": float(np.quantile(error[:, 1], 0.99)),
        "end_nees_mean": float(np.mean(nees[:, 1])),
        "end_nees_p99": float(np.quantile(nees[:, 1], 0.99)),
    }
