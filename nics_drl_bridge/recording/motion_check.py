"""Checks guessed commands against the motion: whether it follows them, and how late."""

from collections.abc import Iterator

import numpy as np

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording.command_guess import TICKS, Candidate, CommandGuess
from nics_drl_bridge.recording.names import split_words

STEP_S = 0.1
SMOOTHED = 3  # steps over which measured rates are averaged
LONGEST_LATENCY_S = 3.0  # maximum delay of the motion that is tried
EARLIEST_S = -1.0  # minimum delay that is tried
IMPLAUSIBLE_LATENCY_S = 1.0
PRECEDES_S = -0.3  # a motion this early precedes its command
LEAST_CORRELATION = 0.3
CLEAR_CORRELATION = 0.6  # minimum at which a latency is reported
MIN_STEPS = 100  # steps


def find_doubts(guess: CommandGuess, pose: tuple[Array, Array] | None) -> Iterator[str]:
    """Yields sentences on commands that the motion ignores, or follows much too early or late.

    `pose` holds stamps (T,) [s] and poses (T, 3).
    """
    if pose is None or guess.of_wheels:
        return
    motion = _compute_rates(*pose)
    if motion is None:
        return
    t, speed, turn_rate = motion
    commands = {command.meaning: command for command in guess.commands.values()}
    lags = np.arange(EARLIEST_S, LONGEST_LATENCY_S + STEP_S / 2.0, STEP_S)
    for meaning, signal in (("speed", speed), ("turn", turn_rate)):
        command = commands.get(meaning)
        if command is None or signal.std() < 1e-3:
            continue
        likeness = _compute_likeness(command, t, signal, lags)
        if likeness is None:
            continue
        best = int(np.argmax(likeness))
        if likeness[best] < LEAST_CORRELATION:
            said = f"{_name_candidate(command)} hardly goes with the motion"
            yield f"{said}; is it what was sent to the robot?"
        elif likeness[best] > CLEAR_CORRELATION and lags[best] > IMPLAUSIBLE_LATENCY_S:
            late = f"the motion follows {_name_candidate(command)} after {lags[best]:.1f} s"
            yield f"{late}, which no latency explains; check `time:` and the command"
        elif likeness[best] > CLEAR_CORRELATION and lags[best] < PRECEDES_S:
            early = (
                f"the motion precedes {_name_candidate(command)} by {-lags[best]:.1f} s"
            )
            yield f"{early}, as a measurement's would; check `time:` and the command"


def find_reversed_wheels(
    guess: CommandGuess, pose: tuple[Array, Array] | None
) -> list[Candidate]:
    """Returns the measured wheel, left or right, that counts backwards according to the motion.

    Both wheels turn the same way when the robot drives, and the right one turns faster when the
    robot turns counter-clockwise.
    """
    sides = {wheel.meaning: wheel for wheel in guess.commands.values()}
    if pose is None or not guess.of_wheels or sides.keys() != {"left", "right"}:
        return []
    motion = _compute_rates(*pose)
    if motion is None:
        return []
    t, speed, turn_rate = motion
    left, right = (_compute_wheel_rate(sides[side], t) for side in ("left", "right"))
    if left is None or right is None:
        return []
    likeness = [float(np.corrcoef(rate, speed)[0, 1]) for rate in (left, right)]
    if likeness[0] * likeness[1] > 0.0 or min(map(abs, likeness)) < LEAST_CORRELATION:
        return []
    turned_by_left = float(np.corrcoef(right + left, turn_rate)[0, 1])
    if turned_by_left > 0.0:
        return [sides["left"]]
    return [sides["right"]]


def _compute_wheel_rate(wheel: Candidate, t: Array) -> Array | None:
    """Returns the rate (K,) of a wheel at times t (K,) [s]; None if it is unknown or constant."""
    values = wheel.table.data[wheel.column.name].astype(np.float64)
    if wheel.table.t is None or len(wheel.table.t) != len(values):
        return None
    rate = np.interp(t, wheel.table.t, values)
    if not TICKS.isdisjoint(split_words(wheel.column.name)):
        rate = np.gradient(rate, STEP_S)
    rate = np.convolve(rate, np.ones(SMOOTHED) / SMOOTHED, "same")
    if rate.std() <= 1e-9:
        return None
    return np.asarray(rate)


def _name_candidate(candidate: Candidate) -> str:
    return f"{candidate.table.name}:{candidate.column.name}"


def _compute_rates(t: Array, pose: Array) -> tuple[Array, Array, Array] | None:
    """Returns times (K,) [s], speeds (K,) along the heading and turn rates (K,) of a pose."""
    order = np.argsort(t, kind="stable")
    t = t[order]
    pose = pose[order]
    grid = np.arange(t[0], t[-1], STEP_S)
    if len(grid) < MIN_STEPS or len(grid) > 10 * len(t) + MIN_STEPS:
        return None
    heading = np.unwrap(pose[:, 2])
    x, y, turned = (np.interp(grid, t, column) for column in (*pose[:, :2].T, heading))
    mean = np.ones(SMOOTHED) / SMOOTHED
    dx, dy, turn = (
        np.convolve(np.diff(each) / STEP_S, mean, "same") for each in (x, y, turned)
    )
    middle = (turned[1:] + turned[:-1]) / 2.0
    speed = dx * np.cos(middle) + dy * np.sin(middle)
    sideways = -dx * np.sin(middle) + dy * np.cos(middle)
    # A tracked body may be mounted across the robot.
    if np.abs(sideways).sum() > np.abs(speed).sum():
        speed = sideways
    return grid[:-1] + STEP_S / 2.0, speed, turn


def _compute_likeness(
    candidate: Candidate, t: Array, signal: Array, lags: Array
) -> Array | None:
    """Returns the correlation of a signal (K,) at t (K,) with a command, for each lag (L,) [s]."""
    table = candidate.table
    column = candidate.column
    values = table.data[column.name].astype(np.float64)
    if table.t is None or len(table.t) != len(values) or column.low == column.high:
        return None
    order = np.argsort(table.t, kind="stable")
    stamps = table.t[order]
    values = np.nan_to_num(values[order])
    if stamps[0] > t[-1] or stamps[-1] < t[0]:
        return None  # of another clock
    likeness = []
    for lag in lags:
        row = np.searchsorted(stamps, t - lag, side="right") - 1
        known = row >= 0
        command = values[np.clip(row, 0, None)]
        if (
            known.sum() < MIN_STEPS
            or command[known].std() < 1e-9
            or signal[known].std() < 1e-9
        ):
            return None
        likeness.append(abs(float(np.corrcoef(command[known], signal[known])[0, 1])))
    return np.array(likeness)
