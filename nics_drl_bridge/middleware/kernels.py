"""Compiled parts of the estimator: prediction under the logged commands, and odometry's update.

Shared arguments: `mean` is (3 + S,), `covariance` (3 + S, 3 + S); `begin`, `end` and `now` are
times [ns]; `motion` is the `MotionModel`, `log` the `CommandLog`. A `transition` (3 + S, 3 + 2 S)
is the Jacobian of a predicted mean with respect to the mean before and to a constant error in the
state's S rates. See `ekf` for how the parts work together.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.interface import NS_PER_S, Array
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.robot import kernels as robot

DIVERGED = 1e9  # bound on means and Jacobians; beyond, the model has diverged
# Longest time between two odometries over which the mean of their twists gives the displacement [s]
MAX_ARC_S = 0.25
# Lower bound on a variable's variance given the preceding ones, as a fraction of its variance
MIN_PIVOT = 1e-12
MIN_VARIANCE = 1e-18  # absolute lower bound on that variance


class Odometry(NamedTuple):
    """One odometry message."""

    time_ns: int  # stamp
    pose: Array  # (3,) in `odom`
    twist: Array  # (3,) in the robot's frame


class Clone(NamedTuple):
    """Copy of the state at the newest odometry used (stochastic cloning).

    Later measurements correct the copy as well. It is no longer `correlated` once the
    pose has been set directly, because its covariance with the current state is then
    unknown.
    """

    odometry: Odometry
    mean: Array
    covariance: Array
    cross: Array  # (3 + S, 3) covariance of the current state with the cloned pose
    correlated: bool = True


class OdometryModel(NamedTuple):
    """Error model of odometry's relative poses."""

    random_walk: Array  # (3, 3) covariance that wheel noise adds in a second
    slip: Array  # (3, 3) covariance of motion that wheels miss in a second
    gate: float  # maximum normalised innovation squared (NIS) of a relative pose
    state_low: Array  # (S,) limits of the state
    state_high: Array


class MotionModel(NamedTuple):
    """The fitted model and its time step."""

    terms: robot.Terms  # `terms`, `series`: see `robot.kernels`
    series: Array
    step_ns: int  # the model's step [ns]
    longest_ns: int  # longest gap that is predicted [ns]


class CommandLog(NamedTuple):
    """Commands in the order in which they take effect; the first one also holds before its time."""

    effective: NDArray[np.int64]  # (K,) times without individual delays [ns]
    commands: Array  # (K, C)


def make_log(command: ArrayLike) -> CommandLog:
    """Returns a log in which one command (C,) holds at all times."""
    times = np.full(1, np.iinfo(np.int64).min)
    return CommandLog(times, np.array([command], np.float64))


@kernel(allocates=True)
def compute_rates_jacobian(jacobian: Array, x: Array, terms: robot.Terms) -> None:
    """Writes the Jacobian (3 + S, S + C) of `robot.kernels.rates` by state and command."""
    jacobian[:] = 0.0
    for k in range(terms.dof.shape[0]):
        for position in range(terms.degree[k]):
            product = terms.coefficient[k]
            for factor in range(terms.degree[k]):
                if factor != position:
                    product *= x[terms.factors[k, factor]]
            jacobian[terms.dof[k], terms.factors[k, position]] += product
    for i in range(terms.emf.shape[0]):
        jacobian[3 + i, i] -= robot.sum_back_emf(i, x, terms)


@kernel
def compute_drag_slope(value: float, dt: float, drag: float) -> float:
    """Returns the derivative of a state after a step's drag with respect to the state before."""
    return 1.0 / (1.0 + dt * drag * abs(value)) ** 2


@kernel(allocates=True)
def step_mean(
    mean: Array,
    transition: Array,
    command: Array,
    dt: float,
    steps: int,
    motion: MotionModel,
) -> None:
    """Moves a mean and its transition in place by `steps` of `dt` [s] under a command (C,)."""
    size = mean.shape[0] - 3
    width = command.shape[0]
    x = np.ones(size + width + 1)
    dq = np.zeros(3 + size)
    jacobian = np.zeros((3 + size, size + width))
    step = np.eye(3 + size)
    robot.put_command(x, command, motion.terms)
    for _ in range(steps):
        x[:size] = mean[3:]
        robot.rates(dq, x, motion.terms)
        compute_rates_jacobian(jacobian, x, motion.terms)
        # The arc is short, so the derivative at its middle heading is good to second order.
        middle = mean[2] + dq[2] * dt / 2.0
        c = math.cos(middle)
        s = math.sin(middle)
        step[:] = np.eye(3 + size)
        step[0, 2] = -dt * (s * dq[0] + c * dq[1])
        step[1, 2] = dt * (c * dq[0] - s * dq[1])
        for i in range(size):
            turn = dt / 2.0 * jacobian[2, i]
            step[0, 3 + i] = (
                dt * (c * jacobian[0, i] - s * jacobian[1, i]) + step[0, 2] * turn
            )
            step[1, 3 + i] = (
                dt * (s * jacobian[0, i] + c * jacobian[1, i]) + step[1, 2] * turn
            )
            step[2, 3 + i] = dt * jacobian[2, i]
            for d in range(size):
                slope = 1.0 if d == i else 0.0
                # A limited rate does not depend on the state.
                if motion.terms.fall[d] <= dq[3 + d] <= motion.terms.rise[d]:
                    slope += dt * jacobian[3 + d, i]
                free = mean[3 + d] + dt * dq[3 + d]
                drag_slope = compute_drag_slope(free, dt, motion.terms.drag[d])
                step[3 + d, 3 + i] = drag_slope * slope
        transition[:] = step @ transition
        for i in range(size):
            transition[3 + i, 3 + size + i] += dt
        robot.advance(mean[:3], dq, dt, motion.series)
        for i in range(size):
            bounds = robot.get_bounds(motion.terms, i)
            mean[3 + i] = robot.advance_state(mean[3 + i], dq[3 + i], dt, bounds)


@kernel(allocates=True)
def find_command(log: CommandLog, time: int) -> int:
    """Returns the index of the last command that took effect before a time; 0 if there is none."""
    following = int(np.searchsorted(log.effective, time))
    return max(following - 1, 0)


@kernel(allocates=True)
def insert_command(
    log: CommandLog,
    effective_ns: int,
    command: Array,
    low: Array,
    high: Array,
    needed_ns: int,
) -> tuple[NDArray[np.int64], Array]:
    """Returns the fields of a log with one more command (C,), clipped to [low, high].

    Commands that ended before `needed_ns` are dropped. The result is empty for a duplicate time.
    """
    count = log.effective.shape[0]
    place = int(np.searchsorted(log.effective, effective_ns))
    if place < count and log.effective[place] == effective_ns:
        return np.empty(0, np.int64), np.empty((0, command.shape[0]))
    first = min(place, find_command(log, needed_ns))
    times = np.empty(count - first + 1, np.int64)
    values = np.empty((count - first + 1, command.shape[0]))
    middle = place - first
    times[:middle] = log.effective[first:place]
    times[middle] = effective_ns
    times[middle + 1 :] = log.effective[place:]
    values[:middle] = log.commands[first:place]
    values[middle] = np.minimum(np.maximum(command, low), high)
    values[middle + 1 :] = log.commands[place:]
    return times, values


@kernel(allocates=True)
def read_commands(
    command: Array, time: int, motion: MotionModel, log: CommandLog
) -> int:
    """Writes the commands (C,) in effect just before a time; returns when they change next [ns]."""
    following = np.iinfo(np.int64).max
    for c in range(command.shape[0]):
        delay = motion.terms.extra_delays[c] * motion.step_ns
        k = find_command(log, time - delay)
        command[c] = log.commands[k, c]
        if k + 1 < log.effective.shape[0]:
            following = min(following, log.effective[k + 1] + delay)
    return following


@kernel(allocates=True)
def make_transition(width: int, time: float) -> Array:
    """Returns the transition (3 + S, 3 + 2 S) over a time [s] in which the robot did not move."""
    size = width - 3
    transition = np.zeros((width, width + size))
    transition[:, :width] = np.eye(width)
    for i in range(size):
        transition[3 + i, width + i] = time
    return transition


@kernel(allocates=True)
def propagate_mean(
    mean: Array,
    transition: Array,
    begin: int,
    end: int,
    motion: MotionModel,
    log: CommandLog,
) -> None:
    """Moves a mean and its transition in place from `begin` to `end`, command by command.

    After a gap that is too long, or if the model diverges, the pose is kept and the state is zero.
    """
    step = motion.step_ns
    if end - begin > motion.longest_ns:
        mean[3:] = 0.0
        transition[:] = make_transition(mean.shape[0], (end - begin) / NS_PER_S)
        return
    start_pose = mean[:3].copy()
    command = np.empty(log.commands.shape[1])
    now = begin
    while now < end:
        # "just before" the next nanosecond: also a command that takes effect now
        until = min(read_commands(command, now + 1, motion, log), end)
        steps = (until - now) // step
        rest = (until - now) % step
        step_mean(mean, transition, command, step / NS_PER_S, steps, motion)
        if rest > 0:
            step_mean(mean, transition, command, rest / NS_PER_S, 1, motion)
        now = until
    if not (np.all(np.abs(mean) < DIVERGED) and np.all(np.abs(transition) < DIVERGED)):
        mean[:3] = start_pose
        mean[3:] = 0.0
        transition[:] = make_transition(mean.shape[0], (end - begin) / NS_PER_S)


@kernel(allocates=True)
def predict_twist(
    mean: Array, now: int, motion: MotionModel, log: CommandLog
) -> tuple[Array, Array]:
    """Returns the expected body twist (3,) at the time of a mean, and its Jacobian (3, 3 + S)."""
    command = np.empty(log.commands.shape[1])
    read_commands(command, now, motion, log)
    size = mean.shape[0] - 3
    width = command.shape[0]
    x = np.ones(size + width + 1)
    dq = np.zeros(3 + size)
    rates_jacobian = np.zeros((3 + size, size + width))
    jacobian = np.zeros((3, 3 + size))
    x[:size] = mean[3:]
    robot.put_command(x, command, motion.terms)
    robot.rates(dq, x, motion.terms)
    compute_rates_jacobian(rates_jacobian, x, motion.terms)
    jacobian[:, 3:] = rates_jacobian[:3, :size]
    return dq[:3].copy(), jacobian


@kernel(allocates=True)
def predict_estimate(
    mean: Array,
    covariance: Array,
    process: Array,
    begin: int,
    end: int,
    motion: MotionModel,
    log: CommandLog,
) -> tuple[Array, Array, tuple[Array, Array], Array, Array]:
    """Predicts an estimate from `begin` to `end`; `process` (3 + S, 3 + S) is its noise per second.

    Returns mean, covariance, the result of `predict_twist`, and the Jacobians of the mean with
    respect to an error in the state's rates (3 + S, S) and to the mean before (3 + S, 3 + S).
    """
    # A wrong model stays wrong for a while, so the error in the state's rates is taken as constant.
    # It then moves the pose too, and a correction of the state also corrects the pose.
    # Its covariance, `process` / time, lets the variance of the state grow by `process` * time.
    moved = mean.copy()
    width = mean.shape[0]
    time = (end - begin) / NS_PER_S
    transition = make_transition(width, 0.0)
    propagate_mean(moved, transition, begin, end, motion, log)
    by_mean = transition[:, :width].copy()
    by_rates = transition[:, width:].copy()
    predicted = (
        by_mean @ covariance @ by_mean.T
        + by_rates @ (process[3:, 3:] / time) @ by_rates.T
    )
    predicted[:3, :3] += process[:3, :3] * time
    predicted = (predicted + predicted.T) * 0.5
    twist = predict_twist(moved, end, motion, log)
    return moved, predicted, twist, by_rates, by_mean


@kernel(allocates=True)
def look_ahead(
    mean: Array, begin: int, end: int, motion: MotionModel, log: CommandLog
) -> tuple[Array, Array]:
    """Predicts mean and body twist (3,) at `end`; returns the current ones if that is earlier."""
    moved = mean.copy()
    if end > begin:
        transition = make_transition(mean.shape[0], 0.0)
        propagate_mean(moved, transition, begin, end, motion, log)
    return moved, predict_twist(moved, max(begin, end), motion, log)[0]


@kernel(allocates=True)
def compute_nis(
    innovation: Array, jacobian: Array, covariance: Array, noise: Array
) -> float:
    """Returns the normalised innovation squared: chi-squared if the filter is consistent."""
    spread = jacobian @ covariance @ jacobian.T + noise
    return float(innovation @ np.linalg.solve(spread, innovation))


@kernel(allocates=True)
def compute_update(
    covariance: Array, jacobian: Array, noise: Array
) -> tuple[NDArray[np.floating[Any]], Array]:
    """Returns the Kalman gain (3 + S, n) and the updated covariance, computed as in filterpy."""
    shared: Array = covariance @ jacobian.T
    gain = np.linalg.solve(jacobian @ shared + noise, shared.T).T.copy()
    left = np.eye(covariance.shape[0]) - gain @ jacobian
    return gain, left @ covariance @ left.T + gain @ noise @ gain.T


@kernel(allocates=True)
def correct_clone(
    clone: Clone, innovation: Array, jacobian: Array, covariance: Array, noise: Array
) -> Clone:
    """Returns the clone after a measurement of the current state, which has the `covariance`.

    The measurement has innovation (n,), Jacobian (n, 3 + S) and noise (n, n).
    """
    seen = jacobian @ clone.cross
    gain = np.linalg.solve(jacobian @ covariance @ jacobian.T + noise, seen)
    cross = clone.cross - covariance @ (jacobian.T @ gain)
    mean = clone.mean.copy()
    mean[:3] += innovation @ gain.copy()
    corrected = clone.covariance.copy()
    corrected[:3, :3] -= seen.T @ gain
    return Clone(clone.odometry, mean, corrected, cross, True)


@kernel
def compute_displacement(start: Array, end: Array) -> tuple[float, float]:
    """Returns the displacement from `start` to `end`, forward and left [m]."""
    c = math.cos(start[2])
    s = math.sin(start[2])
    x = end[0] - start[0]
    y = end[1] - start[1]
    return c * x + s * y, c * y - s * x


@kernel(allocates=True)
def agrees_with_twists(
    relative: Array,
    slack: Array,
    clone: Clone,
    odometry: Odometry,
    model: OdometryModel,
) -> bool:
    """Returns True if a relative pose (3,) matches the arc given by the twists at its ends.

    `slack` (3, 3) is its variance because the robot may have had either twist in between.
    """
    seconds = (odometry.time_ns - clone.odometry.time_ns) / NS_PER_S
    if seconds > MAX_ARC_S:
        return False
    ahead = relative[0]
    left = relative[1]
    turn = relative[2]
    arc = np.array([ahead + 0.5 * turn * left, left - 0.5 * turn * ahead, turn])
    residual = arc - 0.5 * seconds * (odometry.twist + clone.odometry.twist)
    spread = model.random_walk * seconds + 0.25 * slack
    # It is unknown where along the path the robot turned.
    spread += np.diag((0.25 * turn * np.array([left, ahead, 0.0])) ** 2)
    return bool(residual @ np.linalg.solve(spread, residual) <= model.gate)


@kernel(allocates=True)
def replace_pose(
    mean: Array,
    covariance: Array,
    clone: Clone,
    relative: Array,
    random_walk: Array,
) -> tuple[Array, Array]:
    """Returns an estimate whose pose is the clone's, moved by a relative pose (3,).

    `random_walk` (3, 3) is the covariance of the relative pose.
    """
    start = clone.mean
    c = math.cos(start[2])
    s = math.sin(start[2])
    moved = mean.copy()
    moved[0] = start[0] + c * relative[0] - s * relative[1]
    moved[1] = start[1] + s * relative[0] + c * relative[1]
    moved[2] = start[2] + relative[2]
    jacobian = np.eye(3)
    jacobian[0, 2] = start[1] - moved[1]
    jacobian[1, 2] = moved[0] - start[0]
    start_covariance = clone.covariance[:3, :3].copy()
    replaced = covariance.copy()
    replaced[:3, 3:] = 0.0
    replaced[3:, :3] = 0.0
    replaced[:3, :3] = jacobian @ start_covariance @ jacobian.T + random_walk
    return moved, replaced


@kernel(allocates=True)
def correct_by_relative_pose(
    mean: Array,
    covariance: Array,
    clone: Clone,
    odometry: Odometry,
    model: OdometryModel,
) -> tuple[Array, Array]:
    """Corrects an estimate by odometry's pose relative to the clone's.

    Ignores an unlikely relative pose, unless the twists at its ends confirm it. In that case the
    prediction is wrong, and the relative pose replaces it.
    """
    seconds = (odometry.time_ns - clone.odometry.time_ns) / NS_PER_S
    start = clone.odometry.pose
    ahead, left = compute_displacement(start, odometry.pose)
    turn = robot.wrap(odometry.pose[2] - start[2])
    relative = np.array([ahead, left, turn])
    expected_ahead, expected_left = compute_displacement(clone.mean, mean)
    innovation = np.array(
        [
            ahead - expected_ahead,
            left - expected_left,
            robot.wrap(turn - mean[2] + clone.mean[2]),
        ]
    )
    c = math.cos(clone.mean[2])
    s = math.sin(clone.mean[2])
    jacobian = np.zeros((3, mean.shape[0]))
    jacobian[0, 0] = c
    jacobian[0, 1] = s
    jacobian[1, 0] = -s
    jacobian[1, 1] = c
    jacobian[2, 2] = 1.0
    clone_jacobian = np.array(
        [[-c, -s, expected_left], [s, -c, -expected_ahead], [0.0, 0.0, -1.0]]
    )
    clone_covariance = clone.covariance[:3, :3].copy()
    shared = covariance @ jacobian.T + clone.cross @ clone_jacobian.T
    clone_shared = clone.cross.T @ jacobian.T + clone_covariance @ clone_jacobian.T
    random_walk = model.random_walk * seconds
    spread = jacobian @ shared + clone_jacobian @ clone_shared + random_walk
    # Between two odometries the robot may have had either twist.
    slack = np.diag((0.5 * seconds * (odometry.twist - clone.odometry.twist)) ** 2)
    if innovation @ np.linalg.solve(spread + slack, innovation) <= model.gate:
        gain = np.linalg.solve(spread, shared.T)
        moved = mean + innovation @ gain
        corrected = covariance - shared @ gain
        corrected = (corrected + corrected.T) * 0.5
    elif agrees_with_twists(relative, slack, clone, odometry, model):
        moved, corrected = replace_pose(mean, covariance, clone, relative, random_walk)
    else:
        return mean, covariance
    corrected[:3, :3] += model.slip * seconds
    repair_estimate(moved, corrected, model.state_low, model.state_high)
    return moved, corrected


@kernel(allocates=True)
def correct_by_odometry(
    mean: Array,
    covariance: Array,
    innovation: Array,
    jacobian: Array,
    noise: Array,
    clone: Clone,
    odometry: Odometry,
    model: OdometryModel,
) -> tuple[Array, Array]:
    """Corrects an estimate by odometry's twist, then by its pose relative to the clone's.

    The twist has innovation (3,), Jacobian (3, 3 + S) and noise (3, 3). With a zero Jacobian, only
    the relative pose corrects.
    """
    corrected_clone = correct_clone(clone, innovation, jacobian, covariance, noise)
    gain, corrected = compute_update(covariance, jacobian, noise)
    moved = mean + gain @ innovation
    repair_estimate(moved, corrected, model.state_low, model.state_high)
    estimate: tuple[Array, Array] = correct_by_relative_pose(
        moved, corrected, corrected_clone, odometry, model
    )
    return estimate


@kernel(allocates=True)
def repair_estimate(mean: Array, covariance: Array, low: Array, high: Array) -> None:
    """Wraps the heading, clips the state to [low, high] (S,) and repairs the covariance in place.

    Rounding errors are removed: the covariance becomes symmetric, and each pivot of its Cholesky
    factorisation at least `MIN_PIVOT` of its variance.
    """
    size = mean.shape[0]
    mean[2] = robot.wrap(mean[2])
    for i in range(3, size):
        mean[i] = min(max(mean[i], low[i - 3]), high[i - 3])
    factor = np.zeros((size, size))
    for i in range(size):
        for j in range(i + 1):
            entry = 0.5 * (covariance[i, j] + covariance[j, i])
            covariance[i, j] = entry
            covariance[j, i] = entry
            for k in range(j):
                entry -= factor[i, k] * factor[j, k]
            if j < i:
                factor[i, j] = entry / factor[j, j]
                continue
            least = max(MIN_PIVOT * covariance[i, i], MIN_VARIANCE)
            if entry < least:
                covariance[i, i] += least - entry
                entry = least
            factor[i, i] = math.sqrt(entry)
