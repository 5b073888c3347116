"""Checks guessed commands against the motion: whether it follows them, and how late."""

from collections.abc import Iterator

import numpy as np

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording.guesses import Candidate, CommandGuess

STEP_S = 0.1
SMOOTHED = 3  # steps over which measured rates are averaged
LONGEST_LATENCY_S = 3.0  # maximum delay of the motion that is tried
EARLIEST_S = -1.0  # minimum delay that is tried
IMPLAUSIBLE_LATENCY_S = 1.0
PRECEDES_S = -0.3  # a motion this early precedes its command
LEAST_CORRELATION = 0.3
CLEAR_CORRELATION = 0.6  # minimum at which a latency is reported
MIN_STEPS = 100  # steps


def find_doubts(guess: CommandGuess, stamps: Array, poses: Array) -> Iterator[str]:
    """Yields sentences on commands that the motion ignores, or follows much too early or late.

    `stamps` are those (T,) of `poses` (T, 3) [s].
    """
    if guess.of_wheels:
        return
    motion = _compute_rates(stamps, poses)
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
        name = f"{command.column.table.name}:{command.column.name}"
        best = int(np.argmax(likeness))
        lag = lags[best]
        if likeness[best] < LEAST_CORRELATION:
            problem = f"the motion hardly follows {name}"
            yield f"{problem}; check that it was sent to the robot"
        elif likeness[best] > CLEAR_CORRELATION and lag > IMPLAUSIBLE_LATENCY_S:
            problem = f"the motion follows {name} after {lag:.1f} s"
            yield f"{problem}, which no latency explains; check `time:` and the command"
        elif likeness[best] > CLEAR_CORRELATION and lag < PRECEDES_S:
            problem = f"the motion precedes {name} by {-lag:.1f} s"
            yield f"{problem}, like a measurement; check `time:` and the command"


def _compute_rates(t: Array, pose: Array) -> tuple[Array, Array, Array] | None:
    """Returns times (K,) [s], speeds (K,) along the heading and turn rates (K,) of a pose."""
    order = np.argsort(t, kind="stable")
    t = t[order]
    pose = pose[order]
    grid = np.arange(t[0], t[-1], STEP_S)
    if len(grid) < MIN_STEPS or len(grid) > 10 * len(t) + MIN_STEPS:
        return None
    heading = np.unwrap(pose[:, 2])
    mean = np.ones(SMOOTHED) / SMOOTHED
    rates = []
    for column in (pose[:, 0], pose[:, 1], heading):
        steps = np.diff(np.interp(grid, t, column))
        rates.append(np.convolve(steps / STEP_S, mean, "same"))
    vx, vy, turn_rate = rates
    middle = np.interp(grid[:-1] + STEP_S / 2.0, t, heading)
    speed = vx * np.cos(middle) + vy * np.sin(middle)
    sideways = -vx * np.sin(middle) + vy * np.cos(middle)
    # A tracked body may be mounted across the robot.
    if np.abs(sideways).sum() > np.abs(speed).sum():
        speed = sideways
    return grid[:-1] + STEP_S / 2.0, speed, turn_rate


def _compute_likeness(
    candidate: Candidate, t: Array, signal: Array, lags: Array
) -> Array | None:
    """Returns the correlation of a signal (K,) at t (K,) with a command, for each lag (L,) [s]."""
    column = candidate.column
    table = column.table
    values = column.numbers
    if table.t is None or len(table.t) != len(values) or not column.moves:
        return None
    order = np.argsort(table.t, kind="stable")
    stamps = table.t[order]
    values = np.nan_to_num(values[order])
    if stamps[0] > t[-1] or stamps[-1] < t[0]:
        return None  # they are on another clock
    likeness = []
    for lag in lags:
        row = np.searchsorted(stamps, t - lag, side="right") - 1
        known = row >= 0
        command = values[np.clip(row, 0, None)]
        if known.sum() < MIN_STEPS:
            return None
        sent = command[known]
        measured = signal[known]
        if sent.std() < 1e-9 or measured.std() < 1e-9:
            return None
        likeness.append(abs(float(np.corrcoef(sent, measured)[0, 1])))
    return np.array(likeness)
