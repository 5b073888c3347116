"""Compiled parts of the estimator: prediction under the logged commands, and odometry's update.

Shared arguments: `mean` is (3 + S,), `covariance` (3 + S, 3 + S); `begin`, `end` and `now` are
times [ns]; `motion` is the `MotionModel`, `log` the `CommandLog`. A `transition` (3 + S, 3 + 2 S)
is the Jacobian of a predicted mean with respect to the mean before and to a constant error in the
state's S rates. See `ekf` for how the parts work together.

Matrices are multiplied by loops, because numba compiles them far faster than `@`, slices of arrays
and `np.linalg`.
"""

import math
from typing import NamedTuple

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
NEVER_NS = 2**63 - 1


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


def insert_command(
    log: CommandLog, effective_ns: int, command: Array, needed_ns: int
) -> CommandLog | None:
    """Returns a log with one more command (C,), without those that ended before `needed_ns`.

    Returns None if a command already takes effect at the same time.
    """
    place, needed = np.searchsorted(log.effective, (effective_ns, needed_ns)).tolist()
    if effective_ns in log.effective[place : place + 1]:
        return None
    first = min(place, max(needed - 1, 0))
    times = np.insert(log.effective[first:], place - first, effective_ns)
    commands = np.insert(log.commands[first:], place - first, command, axis=0)
    return CommandLog(times, commands)


@kernel(allocates=True)
def multiply(left: Array, right: Array) -> Array:
    """Returns the product (m, n) of two matrices, (m, k) and (k, n)."""
    product = np.zeros((left.shape[0], right.shape[1]))
    for i in range(product.shape[0]):
        for j in range(product.shape[1]):
            for k in range(left.shape[1]):
                product[i, j] += left[i, k] * right[k, j]
    return product


@kernel(allocates=True)
def transpose(matrix: Array) -> Array:
    """Returns the transpose (n, m) of a matrix (m, n)."""
    transposed = np.empty((matrix.shape[1], matrix.shape[0]))
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            transposed[j, i] = matrix[i, j]
    return transposed


@kernel
def add_to(total: Array, part: Array, factor: float) -> None:
    """Adds a matrix (m, n) times a factor to the upper left of another one in place."""
    for i in range(part.shape[0]):
        for j in range(part.shape[1]):
            total[i, j] += factor * part[i, j]


@kernel(allocates=True)
def project(covariance: Array, jacobian: Array, noise: Array) -> Array:
    """Returns jacobian (n, m) @ covariance (m, m) @ jacobian.T + noise (n, n)."""
    projected: Array = multiply(multiply(jacobian, covariance), transpose(jacobian))
    add_to(projected, noise, 1.0)
    return projected


@kernel(allocates=True)
def compute_gain(shared: Array, spread: Array) -> Array:
    """Returns the Kalman gain (m, n), shared @ inverse(spread), by Gaussian elimination.

    `shared` (m, n) is the covariance of m variables with an innovation, `spread` (n, n) that of the
    innovation.
    """
    gain = shared.copy()
    rest = spread.copy()
    size = spread.shape[0]
    for i in range(size):
        for j in range(i + 1, size):
            factor = rest[j, i] / rest[i, i]
            for k in range(i, size):
                rest[j, k] -= factor * rest[i, k]
            for row in range(gain.shape[0]):
                gain[row, j] -= factor * gain[row, i]
    for row in range(gain.shape[0]):
        for i in range(size - 1, -1, -1):
            for k in range(i + 1, size):
                gain[row, i] -= rest[i, k] * gain[row, k]
            gain[row, i] /= rest[i, i]
    return gain


@kernel
def correct_mean(mean: Array, gain: Array, innovation: Array) -> None:
    """Adds gain (m, n) @ innovation (n,) to the first m variables of a mean in place."""
    for i in range(gain.shape[0]):
        for k in range(gain.shape[1]):
            mean[i] += gain[i, k] * innovation[k]


@kernel(allocates=True)
def measure_nis(innovation: Array, spread: Array) -> float:
    """Returns the normalised innovation squared of an innovation (n,) with covariance (n, n)."""
    row = np.empty((1, innovation.shape[0]))
    for k in range(innovation.shape[0]):
        row[0, k] = innovation[k]
    gain = compute_gain(row, spread)
    nis = 0.0
    for k in range(innovation.shape[0]):
        nis += gain[0, k] * innovation[k]
    return nis


@kernel
def compute_rates_jacobian(jacobian: Array, x: Array, terms: robot.Terms) -> None:
    """Writes the Jacobian (3 + S, S + C) of `robot.kernels.rates` by state and command."""
    jacobian.fill(0.0)
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


@kernel
def write_step_jacobian(
    step: Array,
    mean: Array,
    dq: Array,
    jacobian: Array,
    dt: float,
    terms: robot.Terms,
) -> None:
    """Writes the Jacobian (3 + S, 3 + S) of the mean after `dt` [s] by the mean before.

    The rates are `dq` (3 + S,) with the `jacobian` of `compute_rates_jacobian`.
    """
    # The arc is short, so the derivative at its middle heading is good to second order.
    middle = mean[2] + dq[2] * dt / 2.0
    c = math.cos(middle)
    s = math.sin(middle)
    step.fill(0.0)
    for i in range(3):
        step[i, i] = 1.0
    step[0, 2] = -dt * (s * dq[0] + c * dq[1])
    step[1, 2] = dt * (c * dq[0] - s * dq[1])
    for i in range(mean.shape[0] - 3):
        turn = dt / 2.0 * jacobian[2, i]
        ahead = c * jacobian[0, i] - s * jacobian[1, i]
        aside = s * jacobian[0, i] + c * jacobian[1, i]
        step[0, 3 + i] = dt * ahead + step[0, 2] * turn
        step[1, 3 + i] = dt * aside + step[1, 2] * turn
        step[2, 3 + i] = dt * jacobian[2, i]
        for d in range(3, mean.shape[0]):
            slope = 1.0 if d == 3 + i else 0.0
            # A limited rate does not depend on the state.
            if terms.fall[d - 3] <= dq[d] <= terms.rise[d - 3]:
                slope += dt * jacobian[d, i]
            free = mean[d] + dt * dq[d]
            step[d, 3 + i] = slope * compute_drag_slope(free, dt, terms.drag[d - 3])


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
    width = mean.shape[0]
    size = width - 3
    x = np.ones(size + command.shape[0] + 1)
    dq = np.zeros(width)
    jacobian = np.zeros((width, size + command.shape[0]))
    step = np.zeros((width, width))
    robot.put_command(x, command, motion.terms)
    for _ in range(steps):
        for i in range(size):
            x[i] = mean[3 + i]
        robot.rates(dq, x, motion.terms)
        compute_rates_jacobian(jacobian, x, motion.terms)
        write_step_jacobian(step, mean, dq, jacobian, dt, motion.terms)
        moved = multiply(step, transition)
        for i in range(size):
            moved[3 + i, width + i] += dt
        transition.fill(0.0)
        add_to(transition, moved, 1.0)
        robot.advance(mean, dq, dt, motion.series)
        for i in range(size):
            bounds = robot.get_bounds(motion.terms, i)
            mean[3 + i] = robot.advance_state(mean[3 + i], dq[3 + i], dt, bounds)


@kernel
def find_command(log: CommandLog, time: int) -> int:
    """Returns the index of the last command that took effect before a time; 0 if there is none."""
    index: int = log.effective.shape[0] - 1
    while index > 0 and log.effective[index] >= time:
        index -= 1
    return index


@kernel
def read_commands(
    command: Array, time: int, motion: MotionModel, log: CommandLog
) -> int:
    """Writes the commands (C,) in effect just before a time; returns when they change next [ns]."""
    following = NEVER_NS
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
    transition = np.zeros((width, 2 * width - 3))
    write_standstill(transition, time)
    return transition


@kernel
def write_standstill(transition: Array, time: float) -> None:
    """Writes the transition over a time [s] in which the robot did not move."""
    width = transition.shape[0]
    transition.fill(0.0)
    for i in range(width):
        transition[i, i] = 1.0
    for i in range(3, width):
        transition[i, width + i - 3] = time


@kernel
def has_diverged(mean: Array, transition: Array) -> bool:
    """True if a mean or its transition is NaN or beyond `DIVERGED`."""
    for i in range(mean.shape[0]):
        if not abs(mean[i]) < DIVERGED:
            return True
        for k in range(transition.shape[1]):
            if not abs(transition[i, k]) < DIVERGED:
                return True
    return False


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
    start = mean.copy()
    is_predictable = end - begin <= motion.longest_ns
    if is_predictable:
        command = np.empty(log.commands.shape[1])
        now = begin
        while now < end:
            # "just before" the next nanosecond: also a command that takes effect now
            until = min(read_commands(command, now + 1, motion, log), end)
            steps = (until - now) // motion.step_ns
            rest = (until - now) % motion.step_ns
            step_s = motion.step_ns / NS_PER_S
            step_mean(mean, transition, command, step_s, steps, motion)
            if rest > 0:
                step_mean(mean, transition, command, rest / NS_PER_S, 1, motion)
            now = until
    if not is_predictable or has_diverged(mean, transition):
        for i in range(mean.shape[0]):
            mean[i] = start[i] if i < 3 else 0.0
        write_standstill(transition, (end - begin) / NS_PER_S)


@kernel(allocates=True)
def predict_twist(
    mean: Array, now: int, motion: MotionModel, log: CommandLog
) -> tuple[Array, Array]:
    """Returns the expected body twist (3,) at the time of a mean, and its Jacobian (3, 3 + S)."""
    command = np.empty(log.commands.shape[1])
    read_commands(command, now, motion, log)
    size = mean.shape[0] - 3
    x = np.ones(size + command.shape[0] + 1)
    for i in range(size):
        x[i] = mean[3 + i]
    robot.put_command(x, command, motion.terms)
    dq = np.zeros(3 + size)
    rates_jacobian = np.zeros((3 + size, size + command.shape[0]))
    robot.rates(dq, x, motion.terms)
    compute_rates_jacobian(rates_jacobian, x, motion.terms)
    twist = np.empty(3)
    jacobian = np.zeros((3, 3 + size))
    for d in range(3):
        twist[d] = dq[d]
        for i in range(size):
            jacobian[d, 3 + i] = rates_jacobian[d, i]
    return twist, jacobian


@kernel(allocates=True)
def predict_estimate(
    mean: Array,
    covariance: Array,
    process: Array,
    begin: int,
    end: int,
    motion: MotionModel,
    log: CommandLog,
) -> tuple[Array, Array, tuple[Array, Array], Array]:
    """Predicts an estimate from `begin` to `end`; `process` (3 + S, 3 + S) is its noise per second.

    Returns mean, covariance, the result of `predict_twist`, and the transition.
    """
    # A wrong model stays wrong for a while, so the error in the state's rates is taken as constant.
    # It then moves the pose too, and a correction of the state also corrects the pose.
    # Its covariance, `process` / time, lets the variance of the state grow by `process` * time.
    moved = mean.copy()
    width = mean.shape[0]
    time = (end - begin) / NS_PER_S
    transition = make_transition(width, 0.0)
    propagate_mean(moved, transition, begin, end, motion, log)
    joint = np.zeros((transition.shape[1], transition.shape[1]))
    add_to(joint, covariance, 1.0)
    pose_noise = np.zeros((width, width))
    for i in range(width):
        for k in range(width):
            if i < 3 and k < 3:
                pose_noise[i, k] = process[i, k] * time
            elif i >= 3 and k >= 3:
                joint[width + i - 3, width + k - 3] = process[i, k] / time
    predicted = project(joint, transition, pose_noise)
    make_symmetric(predicted)
    twist = predict_twist(moved, end, motion, log)
    return moved, predicted, twist, transition


@kernel
def make_symmetric(matrix: Array) -> None:
    """Replaces a matrix (n, n) by the mean of itself and its transpose, in place."""
    for i in range(matrix.shape[0]):
        for j in range(i):
            entry = 0.5 * (matrix[i, j] + matrix[j, i])
            matrix[i, j] = entry
            matrix[j, i] = entry


@kernel(allocates=True)
def look_ahead(
    mean: Array, begin: int, end: int, motion: MotionModel, log: CommandLog
) -> tuple[Array, tuple[Array, Array]]:
    """Predicts mean and `predict_twist` at `end`; returns the current ones if that is earlier."""
    moved = mean.copy()
    if end > begin:
        transition = make_transition(mean.shape[0], 0.0)
        propagate_mean(moved, transition, begin, end, motion, log)
    return moved, predict_twist(moved, max(begin, end), motion, log)


@kernel(allocates=True)
def compute_nis(
    innovation: Array, jacobian: Array, covariance: Array, noise: Array
) -> float:
    """Returns the normalised innovation squared: chi-squared if the filter is consistent."""
    return float(measure_nis(innovation, project(covariance, jacobian, noise)))


@kernel(allocates=True)
def compute_update(
    covariance: Array, jacobian: Array, noise: Array
) -> tuple[Array, Array]:
    """Returns the Kalman gain (3 + S, n) and the updated covariance, computed as in filterpy."""
    shared = multiply(covariance, transpose(jacobian))
    gain = compute_gain(shared, project(covariance, jacobian, noise))
    left = multiply(gain, jacobian)
    for i in range(left.shape[0]):
        for k in range(left.shape[1]):
            left[i, k] = (1.0 if i == k else 0.0) - left[i, k]
    added = project(noise, gain, np.zeros(covariance.shape))
    return gain, project(covariance, left, added)


@kernel(allocates=True)
def correct_clone(
    clone: Clone, innovation: Array, jacobian: Array, covariance: Array, noise: Array
) -> Clone:
    """Returns the clone after a measurement of the current state, which has the `covariance`.

    The measurement has innovation (n,), Jacobian (n, 3 + S) and noise (n, n).
    """
    seen = transpose(multiply(jacobian, clone.cross))
    gain = compute_gain(seen, project(covariance, jacobian, noise))
    by_state = multiply(covariance, transpose(jacobian))
    cross = clone.cross.copy()
    add_to(cross, multiply(by_state, transpose(gain)), -1.0)
    mean = clone.mean.copy()
    correct_mean(mean, gain, innovation)
    corrected = clone.covariance.copy()
    add_to(corrected, multiply(gain, transpose(seen)), -1.0)
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
    residual = np.empty(3)
    residual[0] = ahead + 0.5 * turn * left
    residual[1] = left - 0.5 * turn * ahead
    residual[2] = turn
    spread = np.zeros((3, 3))
    add_to(spread, model.random_walk, seconds)
    add_to(spread, slack, 0.25)
    for d in range(3):
        residual[d] -= 0.5 * seconds * (odometry.twist[d] + clone.odometry.twist[d])
    # It is unknown where along the path the robot turned.
    spread[0, 0] += (0.25 * turn * left) ** 2
    spread[1, 1] += (0.25 * turn * ahead) ** 2
    return bool(measure_nis(residual, spread) <= model.gate)


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
    jacobian = np.zeros((3, mean.shape[0]))
    for d in range(3):
        jacobian[d, d] = 1.0
    jacobian[0, 2] = start[1] - moved[1]
    jacobian[1, 2] = moved[0] - start[0]
    pose_covariance = project(clone.covariance, jacobian, random_walk)
    replaced = covariance.copy()
    for d in range(3):
        for i in range(3, mean.shape[0]):
            replaced[d, i] = 0.0
            replaced[i, d] = 0.0
        for k in range(3):
            replaced[d, k] = pose_covariance[d, k]
    return moved, replaced


@kernel(allocates=True)
def compare_relative_pose(
    mean: Array, clone: Clone, odometry: Odometry
) -> tuple[Array, Array]:
    """Returns odometry's pose relative to the clone's (3,), and its innovation (3,)."""
    start = clone.odometry.pose
    relative = np.empty(3)
    relative[0], relative[1] = compute_displacement(start, odometry.pose)
    relative[2] = robot.wrap(odometry.pose[2] - start[2])
    ahead, left = compute_displacement(clone.mean, mean)
    innovation = np.empty(3)
    innovation[0] = relative[0] - ahead
    innovation[1] = relative[1] - left
    innovation[2] = robot.wrap(relative[2] - mean[2] + clone.mean[2])
    return relative, innovation


@kernel(allocates=True)
def join_clone(mean: Array, covariance: Array, clone: Clone) -> tuple[Array, Array]:
    """Returns the covariance (6 + S, 6 + S) of state and cloned pose, and a Jacobian (3, 6 + S).

    The Jacobian is that of the current pose in the frame of the cloned one.
    """
    width = mean.shape[0]
    joint = np.zeros((width + 3, width + 3))
    add_to(joint, covariance, 1.0)
    for k in range(3):
        for i in range(width):
            joint[i, width + k] = clone.cross[i, k]
            joint[width + k, i] = clone.cross[i, k]
        for i in range(3):
            joint[width + i, width + k] = clone.covariance[i, k]
    c = math.cos(clone.mean[2])
    s = math.sin(clone.mean[2])
    ahead, left = compute_displacement(clone.mean, mean)
    jacobian = np.zeros((3, width + 3))
    jacobian[0, 0] = c
    jacobian[0, 1] = s
    jacobian[1, 0] = -s
    jacobian[1, 1] = c
    jacobian[2, 2] = 1.0
    for d in range(3):
        for k in range(3):
            jacobian[d, width + k] = -jacobian[d, k]
    jacobian[0, width + 2] = left
    jacobian[1, width + 2] = -ahead
    return joint, jacobian


@kernel(allocates=True)
def update_with_clone(
    mean: Array,
    covariance: Array,
    joint: Array,
    jacobian: Array,
    innovation: Array,
    noise: Array,
) -> tuple[Array, Array]:
    """Returns an estimate after the usual update by a relative pose, with `join_clone`'s result."""
    shared = multiply(joint, transpose(jacobian))[: mean.shape[0]]
    gain = compute_gain(shared, project(joint, jacobian, noise))
    moved = mean.copy()
    correct_mean(moved, gain, innovation)
    corrected = covariance.copy()
    add_to(corrected, multiply(gain, transpose(shared)), -1.0)
    make_symmetric(corrected)
    return moved, corrected


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
    relative, innovation = compare_relative_pose(mean, clone, odometry)
    joint, jacobian = join_clone(mean, covariance, clone)
    noise = np.zeros((3, 3))
    add_to(noise, model.random_walk, seconds)
    # Between two odometries the robot may have had either twist.
    slack = np.zeros((3, 3))
    for d in range(3):
        change = odometry.twist[d] - clone.odometry.twist[d]
        slack[d, d] = (0.5 * seconds * change) ** 2
    spread = project(joint, jacobian, noise)
    add_to(spread, slack, 1.0)
    if measure_nis(innovation, spread) <= model.gate:
        moved, corrected = update_with_clone(
            mean, covariance, joint, jacobian, innovation, noise
        )
    elif agrees_with_twists(relative, slack, clone, odometry, model):
        moved, corrected = replace_pose(mean, covariance, clone, relative, noise)
    else:
        return mean, covariance
    add_to(corrected, model.slip, seconds)
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
    moved = mean.copy()
    correct_mean(moved, gain, innovation)
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
