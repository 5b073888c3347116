"""Compiled parts of the estimator: motion under the commands of the recent past, gates, health.

Shared arguments: `mean` (3 + S,) and `transition` (3 + S, 3 + S), the Jacobian of its motion;
`begin`, `end` and `now` are times [ns]; `motion` is `MotionModel`, `log` is `Log`.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.interface import NS_PER_S, Array
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.robot import kernels as robot

# Bound on poses, states and their derivatives; beyond, the model has diverged
RUNAWAY = 1e9
SHORT_S = 0.25  # longest time in which the way is that of the twists at its ends
# Lower bound on a variance given the variables before, as a share of its own
LEAST_PIVOT = 1e-12
LEAST_VARIANCE = 1e-18  # Absolute lower bound on that variance


class Anchor(NamedTuple):
    """The newest odometry used: time [ns], pose in `odom`, twist, mean and covariance after it.

    What was measured since corrects them, too. `cross` (3 + S, 3) is the covariance of the present
    mean with that pose; None if the pose was set anew since.
    """

    time_ns: int
    odom: Array  # (3,)
    twist: Array  # (3,)
    mean: Array
    covariance: Array
    cross: Array | None = None


class Wheels(NamedTuple):
    """Odometry's noise and slip (3, 3) in a second, and limits (S,) of the state."""

    walk: Array
    slip: Array
    low: Array
    high: Array


class MotionModel(NamedTuple):
    """Model of the motion."""

    terms: robot.Terms  # `terms`, `series`: see `robot.kernels`
    series: Array
    step_ns: int  # the model's step [ns]
    longest_ns: int  # longest gap that is predicted [ns]


class Log(NamedTuple):
    """Commands in the order in which they take effect; the first is in effect before, too."""

    effective: NDArray[np.int64]  # (K,) of those that are not delayed further [ns]
    commands: Array  # (K, C)


def log_of(command: ArrayLike) -> Log:
    """Returns the log of one command (C,), which is always in effect."""
    return Log(np.full(1, np.iinfo(np.int64).min), np.array([command], np.float64))


@kernel(allocates=True)
def rates_jacobian(jacobian, x, terms):  # type: ignore[no-untyped-def]
    """Computes the derivative (3 + S, V) of `rates` with respect to X."""
    dof = terms.dof
    coefficient = terms.coefficient
    factors = terms.factors
    count = terms.degree
    jacobian[:] = 0.0
    for k in range(dof.shape[0]):
        for f in range(count[k]):
            product = coefficient[k]
            for other in range(count[k]):
                if other != f:
                    product *= x[factors[k, other]]
            jacobian[dof[k], factors[k, f]] += product
    for i in range(terms.emf.shape[0]):
        jacobian[3 + i, i] -= robot.sum_back_emf(i, x, terms)


@kernel
def _kept(value, dt, drag):  # type: ignore[no-untyped-def]
    """Returns the share of a change of a state that drag leaves in a step."""
    return 1.0 / (1.0 + dt * drag * abs(value)) ** 2


@kernel(allocates=True)
def predict(mean, transition, command, dt, steps, motion):  # type: ignore[no-untyped-def]
    """Moves the mean by `steps` of `dt` [s] under a command (C,), and its `unmoved` derivative."""
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
        rates_jacobian(jacobian, x, motion.terms)
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
            for d in range(size):  # a limited rate does not depend on the state
                free = motion.terms.fall[d] <= dq[3 + d] <= motion.terms.rise[d]
                slope = dt * jacobian[3 + d, i] if free else 0.0
                kept = _kept(mean[3 + d] + dt * dq[3 + d], dt, motion.terms.drag[d])
                step[3 + d, 3 + i] = kept * ((1.0 if d == i else 0.0) + slope)
        transition[:] = step @ transition
        for i in range(size):
            transition[3 + i, 3 + size + i] += dt
        robot.advance(mean[:3], dq, dt, motion.series)
        for i in range(size):
            bounds = robot.get_bounds(motion.terms, i)
            mean[3 + i] = robot.advance_state(mean[3 + i], dq[3 + i], dt, bounds)


@kernel(allocates=True)
def in_effect(log, time):  # type: ignore[no-untyped-def]
    """Index of the command in effect just before a time: the last that took effect earlier."""
    low = 0
    high = log.effective.shape[0]
    while low < high:
        middle = (low + high) // 2
        if log.effective[middle] < time:
            low = middle + 1
        else:
            high = middle
    return max(low - 1, 0)


@kernel(allocates=True)
def logged(log, effective_ns, command, low, high, needed_ns):  # type: ignore[no-untyped-def]
    """Adds a command (C,), clipped; drops those over before `needed_ns`; empty for a duplicate."""
    effective = log.effective
    commands = log.commands
    place = count = effective.shape[0]
    while place > 0 and effective[place - 1] >= effective_ns:
        place -= 1
    first = min(place, in_effect(log, needed_ns))
    size = count - first + 1
    if place < count and effective[place] == effective_ns:
        size = 0
    times = np.empty(size, np.int64)
    values = np.empty((size, command.shape[0]))
    for i in range(size):
        k = first + i
        if k == place:
            times[i], values[i] = (
                effective_ns,
                np.minimum(np.maximum(command, low), high),
            )
        else:
            k -= 1 if k > place else 0
            times[i], values[i] = effective[k], commands[k]
    return times, values


@kernel(allocates=True)
def take(command, time, motion, log):  # type: ignore[no-untyped-def]
    """Writes the commands (C,) in effect just before a time; returns when the next one is [ns]."""
    following = np.iinfo(np.int64).max
    for c in range(command.shape[0]):
        late = motion.terms.late[c] * motion.step_ns
        k = in_effect(log, time - late)
        command[c] = log.commands[k, c]
        if k + 1 < log.effective.shape[0]:
            following = min(following, log.effective[k + 1] + late)
    return following


@kernel(allocates=True)
def unmoved(width, time):  # type: ignore[no-untyped-def]
    """Derivative (3 + S, 3 + 2 S) to the mean (3 + S,) and to a constant error of the S rates."""
    size = width - 3
    derivative = np.zeros((width, width + size))
    derivative[:, :width] = np.eye(width)
    for i in range(size):  # after a time [s] for which nothing else moved
        derivative[3 + i, width + i] = time
    return derivative


@kernel(allocates=True)
def carry(mean, transition, begin, end, motion, log):  # type: ignore[no-untyped-def]
    """Moves a mean between two times, command by command, in place, see `predict`.

    Over a gap that is too long, or if the model diverges, the pose is kept and the state zero.
    """
    step = motion.step_ns
    if end - begin > motion.longest_ns:
        mean[3:] = 0.0
        transition[:] = unmoved(mean.shape[0], (end - begin) / NS_PER_S)
        return
    before = mean[:3].copy()
    command = np.empty(log.commands.shape[1])
    now = begin
    while now < end:
        until = min(take(command, now + 1, motion, log), end)
        steps = (until - now) // step
        rest = (until - now) % step
        predict(mean, transition, command, step / NS_PER_S, steps, motion)
        if rest > 0:
            predict(mean, transition, command, rest / NS_PER_S, 1, motion)
        now = until
    if not (np.all(np.abs(mean) < RUNAWAY) and np.all(np.abs(transition) < RUNAWAY)):
        mean[:3] = before
        mean[3:] = 0.0
        transition[:] = unmoved(mean.shape[0], (end - begin) / NS_PER_S)


@kernel(allocates=True)
def expect(mean, now, motion, log):  # type: ignore[no-untyped-def]
    """Expected body twist (3,) at the time of the mean, and its derivative (3, 3 + S)."""
    command = np.empty(log.commands.shape[1])
    take(command, now, motion, log)
    size = mean.shape[0] - 3
    width = command.shape[0]
    x = np.ones(size + width + 1)
    dq = np.zeros(3 + size)
    jacobian = np.zeros((3 + size, size + width))
    derivative = np.zeros((3, 3 + size))
    x[:size] = mean[3:]
    robot.put_command(x, command, motion.terms)
    robot.rates(dq, x, motion.terms)
    rates_jacobian(jacobian, x, motion.terms)
    derivative[:, 3:] = jacobian[:3, :size]
    return dq[:3].copy(), derivative


@kernel(allocates=True)
def forecast(mean, covariance, process, begin, end, motion, log):  # type: ignore[no-untyped-def]
    """Predicts mean, covariance, `expect`, and derivatives to a rates' error and to the mean.

    `process` is added per second.
    """
    # A model that is wrong stays wrong for a while: the error of the state's rates is constant in
    # between, so that it moves the pose, too. A correction of the state then corrects the pose.
    moved = mean.copy()
    width = mean.shape[0]
    time = (end - begin) / NS_PER_S
    derivative = unmoved(width, 0.0)
    carry(moved, derivative, begin, end, motion, log)
    transition = derivative[:, :width].copy()
    error = derivative[:, width:].copy()
    spread = (
        transition @ covariance @ transition.T
        + error @ (process[3:, 3:] / time) @ error.T
    )
    spread[:3, :3] += process[:3, :3] * time
    return (
        moved,
        (spread + spread.T) * 0.5,
        expect(moved, end, motion, log),
        error,
        transition,
    )


@kernel(allocates=True)
def look_ahead(mean, begin, end, motion, log):  # type: ignore[no-untyped-def]
    """Predicts mean and body twist (3,) at a time; the present ones if that is earlier."""
    moved = mean.copy()
    if end > begin:
        carry(moved, unmoved(mean.shape[0], 0.0), begin, end, motion, log)
    return moved, expect(moved, max(begin, end), motion, log)[0]


@kernel(allocates=True)
def distance(innovation, derivative, covariance, noise):  # type: ignore[no-untyped-def]
    """Squared, normalised innovation (Mahalanobis): chi-squared if the filter is consistent."""
    spread = derivative @ covariance @ derivative.T + noise
    return innovation @ np.linalg.solve(spread, innovation)


@kernel(allocates=True)
def gain(covariance, derivative, noise):  # type: ignore[no-untyped-def]
    """Kalman gain (3 + S, n) of a measurement, and the covariance after it, as filterpy's."""
    shared = covariance @ derivative.T
    weight = np.linalg.solve(derivative @ shared + noise, shared.T).T.copy()
    left = np.eye(covariance.shape[0]) - weight @ derivative
    return weight, left @ covariance @ left.T + weight @ noise @ weight.T


@kernel(allocates=True)
def recall(anchor, derivative, covariance, noise):  # type: ignore[no-untyped-def]
    """Corrects the `Anchor` by a present measurement of `derivative` (n, 3 + S) and noise (n, n).

    Returns the gain (n, 3) of its pose, its covariance, and the present mean's with that pose.
    """
    seen = derivative @ anchor.cross
    gain = np.linalg.solve(derivative @ covariance @ derivative.T + noise, seen)
    less = anchor.cross - covariance @ (derivative.T @ gain)
    spread = anchor.covariance.copy()
    spread[:3, :3] -= seen.T @ gain
    return gain.copy(), spread, less


@kernel(allocates=True)
def retrace(  # type: ignore[no-untyped-def]
    mean, covariance, anchor, odom, twist, now, wheels, gate
):
    """Corrects by the way from the `Anchor` to odometry's pose and twist (3,), if that is likely.

    One that is unlikely, but that of the twists at its ends, replaces what was predicted. Returns
    mean and covariance; `wheels` is `Wheels`.
    """
    seconds = (now - anchor.time_ns) / NS_PER_S
    then = anchor.mean
    size = mean.shape[0]
    c = math.cos(anchor.odom[2])
    s = math.sin(anchor.odom[2])
    x = odom[0] - anchor.odom[0]
    y = odom[1] - anchor.odom[1]
    along = c * x + s * y
    aside = c * y - s * x
    turned = robot.wrap(odom[2] - anchor.odom[2])
    c = math.cos(then[2])
    s = math.sin(then[2])
    x = mean[0] - then[0]
    y = mean[1] - then[1]
    ahead = c * x + s * y
    before = c * y - s * x
    here = np.zeros((3, size))
    there = np.zeros((3, 3))
    here[0, 0] = c
    here[0, 1] = s
    here[1, 0] = -s
    here[1, 1] = c
    here[2, 2] = 1.0
    there[0, 0] = -c
    there[0, 1] = -s
    there[1, 0] = s
    there[1, 1] = -c
    there[2, 2] = -1.0
    there[0, 2] = before
    there[1, 2] = -ahead
    shared = covariance @ here.T + anchor.cross @ there.T
    past = anchor.cross.T @ here.T + anchor.covariance[:3, :3].copy() @ there.T
    total = here @ shared + there @ past + wheels.walk * seconds
    innovation = np.array(
        [along - ahead, aside - before, robot.wrap(turned - mean[2] + then[2])]
    )
    # Between two twists the robot may have had either.
    slack = np.diag((0.5 * seconds * (twist - anchor.twist)) ** 2)
    if innovation @ np.linalg.solve(total + slack, innovation) <= gate:
        gain = np.linalg.solve(total, shared.T)
        less = covariance - shared @ gain
        moved = mean + innovation @ gain
        less = (less + less.T) * 0.5
    else:
        arc = np.array(
            [along + 0.5 * turned * aside, aside - 0.5 * turned * along, turned]
        )
        off = arc - 0.5 * seconds * (twist + anchor.twist)
        spread = wheels.walk * seconds + 0.25 * slack
        spread += np.diag(
            (0.25 * turned * np.array([aside, along, 0.0])) ** 2
        )  # where it turned
        if seconds > SHORT_S or not off @ np.linalg.solve(spread, off) <= gate:
            return mean, covariance
        # The way is that of its twists: what was predicted is wrong.
        moved = mean.copy()
        less = covariance.copy()
        turning = np.eye(3)
        moved[0], moved[1] = (
            then[0] + c * along - s * aside,
            then[1] + s * along + c * aside,
        )
        moved[2] = then[2] + turned
        less[:3, 3:] = 0.0
        less[3:, :3] = 0.0
        turning[0, 2], turning[1, 2] = then[1] - moved[1], moved[0] - then[0]
        spread = anchor.covariance[:3, :3].copy()
        less[:3, :3] = turning @ spread @ turning.T + wheels.walk * seconds
    less[:3, :3] += wheels.slip * seconds
    settle(moved, less, wheels.low, wheels.high)
    return moved, less


@kernel(allocates=True)
def follow(  # type: ignore[no-untyped-def]
    mean, innovation, update, recall, anchor, odom, twist, now, wheels, gate
):
    """Corrects by an innovation (3,) of a twist, by `gain` and `recall`, and then by `retrace`."""
    weight = update[0]
    covariance = update[1].copy()
    here = mean + weight @ innovation
    then = anchor.mean.copy()
    settle(here, covariance, wheels.low, wheels.high)
    then[:3] += innovation @ recall[0]
    since = Anchor(
        anchor.time_ns, anchor.odom, anchor.twist, then, recall[1], recall[2]
    )
    return retrace(here, covariance, since, odom, twist, now, wheels, gate)


@kernel(allocates=True)
def settle(mean, covariance, low, high):  # type: ignore[no-untyped-def]
    """Wraps the heading, clips the state to [low, high] (S,), repairs the covariance's rounding."""
    size = mean.shape[0]
    mean[2] = robot.wrap(mean[2])
    for i in range(3, size):
        mean[i] = min(max(mean[i], low[i - 3]), high[i - 3])
    factor = np.zeros((size, size))
    for i in range(size):
        for j in range(i + 1):
            both = 0.5 * (covariance[i, j] + covariance[j, i])
            covariance[i, j] = both
            covariance[j, i] = both
            for k in range(j):
                both -= factor[i, k] * factor[j, k]
            if j < i:
                factor[i, j] = both / factor[j, j]
                continue
            least = max(LEAST_PIVOT * covariance[i, i], LEAST_VARIANCE)
            if both < least:
                covariance[i, i] += least - both
                both = least
            factor[i, i] = math.sqrt(both)
