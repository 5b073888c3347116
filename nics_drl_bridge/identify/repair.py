"""Repairs a recording: repeated rows, jumps of single samples, commands beyond the limits.

What is left out is a gap afterwards. A recording without such faults comes back as it is.

Stamps: bursts of arrivals become sample times.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.geometry import wrap_angle
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.robot.spec import RobotSpec

Array = NDArray[np.float64]

NEIGHBOURS = 3
"""A jump stands out from the median of this many samples on either side."""
STEPS = 6.0
"""It is larger than this many usual changes from sample to sample,"""
USUAL = 60.0
"""(the percentile of the changes that counts as usual: jumps in 20 % of the rows spoil 40 %)"""
REACH = 1.5
"""than this many times what the robot's greatest command could do meanwhile,"""
HEADING_REACH = 0.1
"""than this angle [rad],"""
STATE_SHARE = 0.2
"""and, of a state, than this share of its usual range."""
MOST = 0.15
"""More jumps than this share of the rows are no faults of single samples."""
EXCESS = 0.01
"""A command this share of its range beyond its limits is beyond them."""


@dataclass(frozen=True)
class Repaired:
    """A recording that was repaired.

    Attributes:
        recording: without the faults.
        notes: a sentence for each kind of fault.
    """

    recording: Recording
    notes: tuple[str, ...]


def repair(recording: Recording, spec: RobotSpec) -> Repaired:
    """Leaves out repeated rows and jumps, and holds commands at the robot's limits."""
    recording, repeated = _without_repetitions(recording)
    recording, jumps = _without_jumps(recording, spec)
    recording, beyond = _within_limits(recording, spec)
    return Repaired(recording, (*repeated, *jumps, *beyond))


def _with_rows(recording: Recording, name: str, keep: NDArray[np.bool_]) -> Recording:
    """The recording with some rows (T,) only of one stream."""
    stream = recording.streams[name]
    some: Any = {name: replace(stream, t=stream.t[keep], values=stream.values[keep])}
    return replace(recording, **some)


def _without_repetitions(recording: Recording) -> tuple[Recording, list[str]]:
    notes = []
    for name, stream in recording.streams.items():
        again = (np.diff(stream.t) == 0.0) & (np.diff(stream.values, axis=0) == 0.0).all(axis=1)
        if again.any():
            recording = _with_rows(recording, name, np.append(True, ~again))
            notes.append(
                f"{name}: {int(again.sum())} of {len(stream.t)} rows repeat the row before them, "
                "stamp and all, and were left out."
            )
    return recording, notes


def _without_jumps(recording: Recording, spec: RobotSpec) -> tuple[Recording, list[str]]:
    notes = []
    found = {"pose": _jumps_of_pose(recording.pose, spec)}
    if recording.state is not None and spec.state:
        found["state"] = _jumps_of_state(recording.state)
    for name, jump in found.items():
        share = float(jump.mean()) if len(jump) else 0.0
        if share > MOST:
            raise RecordingError(
                f"{recording.source}: {name}: {share:.0%} of the rows jump away from their "
                "neighbours and back; look for two sources that are mixed in one stream."
            )
        if jump.any():
            recording = _with_rows(recording, name, ~jump)
            notes.append(
                f"{name}: {int(jump.sum())} of {len(jump)} rows ({share:.1%}) jump away from "
                "their neighbours and back, and were left out as outliers."
            )
    return recording, notes


def _jumps_of_pose(pose: Stream, spec: RobotSpec) -> NDArray[np.bool_]:
    """Which poses (T,) jump in position or heading."""
    if len(pose.t) <= 2 * NEIGHBOURS:
        return np.zeros(len(pose.t), dtype=np.bool_)
    t = spread(pose.t, find_bursts(pose.t))
    span = np.zeros(len(t))
    span[NEIGHBOURS:] = t[NEIGHBOURS:] - t[:-NEIGHBOURS]
    span[:-NEIGHBOURS] = np.maximum(span[:-NEIGHBOURS], t[NEIGHBOURS:] - t[:-NEIGHBOURS])
    speeds = [abs(v) for c in spec.command if c.cmd_vel != "angular.z" for v in (c.min, c.max)]
    reach = np.maximum(REACH * max(speeds, default=0.0) * span, 1e-6)
    out = [_stands_out(pose.values[:, i], reach) for i in (0, 1)]
    turns = np.maximum(HEADING_REACH, reach / max(spec.footprint_radius, 1e-3) / 2.0)
    return out[0] | out[1] | _stands_out(pose.values[:, 2], turns, turning=True)


def _jumps_of_state(state: Stream) -> NDArray[np.bool_]:
    """Which states (T,) jump in any component."""
    out = np.zeros(len(state.t), dtype=np.bool_)
    if len(state.t) <= 2 * NEIGHBOURS:
        return out
    for column in state.values.T:
        low, high = np.percentile(column, (5.0, 95.0))
        out |= _stands_out(column, np.full(len(column), max(STATE_SHARE * (high - low), 1e-9)))
    return out


def _stands_out(values: Array, least: Array, turning: bool = False) -> NDArray[np.bool_]:
    """Which of values (T,) are further than `least` (T,) from both sides, the same way.

    Args:
        values: of one component.
        least: by how much, beside `STEPS` times the usual change.
        turning: whether they are angles; differences are then wrapped.
    """
    back, ahead = _differences(values, turning)
    usual = float(np.percentile(np.abs(back[0][1:]), USUAL))
    before, after = np.median(back, axis=0), np.median(ahead, axis=0)
    apart = np.minimum(np.abs(before), np.abs(after))
    return np.asarray((before * after > 0.0) & (apart > np.maximum(STEPS * usual, least)))


def _differences(values: Array, turning: bool) -> tuple[Array, Array]:
    """Differences (NEIGHBOURS, T) from the samples before and after; at the ends, zero."""
    count = len(values)
    back, ahead = np.zeros((NEIGHBOURS, count)), np.zeros((NEIGHBOURS, count))
    for n in range(1, NEIGHBOURS + 1):
        difference = values[n:] - values[:-n]
        difference = wrap_angle(difference) if turning else difference
        back[n - 1, n:], ahead[n - 1, :-n] = difference, -difference
    return back, ahead


def _within_limits(recording: Recording, spec: RobotSpec) -> tuple[Recording, list[str]]:
    """Holds commands at the limits that the robot holds them at."""
    command, margin = recording.command, EXCESS * (spec.command_high - spec.command_low)
    values = command.values
    beyond = (values < spec.command_low - margin) | (values > spec.command_high + margin)
    if not beyond.any():
        return recording, []
    clipped = np.where(beyond, np.clip(values, spec.command_low, spec.command_high), values)
    if _unexplained(recording, values) < _unexplained(recording, clipped):
        return recording, [
            "Commands were beyond the limits in the robot's YAML file, and the robot followed them "
            "there: widen the limits, or the simulator will not go so far."
        ]
    notes = [
        f"{c.name} was beyond the robot's limits, {c.min:g} to {c.max:g} {c.unit}, in {share:.0%} "
        "of the rows: it was taken as held at them; the model says nothing of the range beyond."
        for c, share in zip(spec.command, beyond.mean(axis=0), strict=True)
        if share > 0.0
    ]
    return replace(recording, command=replace(command, values=clipped)), notes


def _unexplained(recording: Recording, command: Array) -> float:
    """What commands (T, C) leave unexplained of the measured state's rates; 0 without a state."""
    state = recording.state
    if state is None or len(state.t) < 2:
        return 0.0
    span = np.diff(state.t)
    keep = span > 0.0
    rates = np.diff(state.values, axis=0)[keep] / span[keep, None]
    row = np.searchsorted(recording.command.t, state.t[:-1][keep] + 1e-9, "right") - 1
    u = command[np.clip(row, 0, len(command) - 1)]
    chi = np.concatenate([np.ones((len(u), 1)), state.values[:-1][keep], u], axis=1)
    rest = rates - chi @ np.linalg.lstsq(chi, rates, rcond=None)[0]
    return float(((rest / np.maximum(rates.std(axis=0), 1e-9)) ** 2).mean())


MIN_STAMPS = 20
BURSTY = 5.0
"""In bursts the mean interval is this many times the 30th percentile of the intervals."""
WITHIN_BURST = 0.25
"""Share of the period below which two stamps belong to one burst."""


@dataclass(frozen=True)
class Bursts:
    """Arrivals that come several at a time.

    Attributes:
        period_s: usual time between two bursts [s].
        size: usual number of samples in one.
        of: (T,) the burst that each sample belongs to.
        newest: (K,) index of the last sample of each burst, the freshest on arrival.
    """

    period_s: float
    size: float
    of: NDArray[np.intp]
    newest: NDArray[np.intp]


def find_bursts(t: Array) -> Bursts | None:
    """Finds bursts in stamps (T,) [s]; None when the samples come one by one."""
    if len(t) < MIN_STAMPS:
        return None
    gaps = np.diff(t)
    if gaps.mean() <= BURSTY * np.percentile(gaps, 30):
        return None
    period = float(np.median(gaps[gaps > gaps.mean()]))
    starts = np.concatenate([[True], gaps > WITHIN_BURST * period])
    of = np.cumsum(starts) - 1
    newest = np.append(np.flatnonzero(starts)[1:] - 1, len(t) - 1)
    return Bursts(period, float(np.median(np.bincount(of))), of, newest)


def spread(t: Array, bursts: Bursts | None) -> Array:
    """Sample times (T,) of arrival stamps (T,) [s].

    The samples of a burst were taken one after the other since the burst before, the newest
    just before its arrival. After a gap they are taken to fill one period, or more if there
    are more of them than usual.
    """
    if bursts is None:
        return t
    count = np.bincount(bursts.of)
    arrival = t[np.concatenate([[0], bursts.newest[:-1] + 1])]
    since = np.diff(arrival, prepend=arrival[0] - bursts.period_s)
    span = np.minimum(since, bursts.period_s * np.maximum(1.0, count / bursts.size))
    behind = bursts.newest[bursts.of] - np.arange(len(t))
    return np.asarray(arrival[bursts.of] - span[bursts.of] * behind / count[bursts.of])


def newest(t: Array, bursts: Bursts | None) -> NDArray[np.intp]:
    """Indices of the samples whose time is known best: the newest of each burst, or all."""
    return np.arange(len(t)) if bursts is None else bursts.newest
