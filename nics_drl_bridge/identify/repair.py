"""Repair of a recording: repeated rows, jumps of single samples, commands beyond the limits.

Dropped rows leave gaps. A recording without such faults is returned unchanged.

Stamps: conversion of bursts of arrivals to sample times.
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
"""A jump is measured by the median difference from this many samples on either side."""
STEPS = 6.0
"""It is larger than this many usual changes from sample to sample,"""
USUAL = 60.0
"""(the percentile of changes that counts as usual: jumps in 20 % of the rows spoil 40 % of them)"""
REACH = 1.5
"""than this many times the distance that the robot's greatest command allows in that time,"""
HEADING_REACH = 0.1
"""than this angle [rad], for a heading,"""
STATE_SHARE = 0.2
"""and than this share of the usual range, for a state."""
MOST = 0.15
"""Jumps in more than this share of the rows are not faults of single samples."""
EXCESS = 0.01
"""Commands may exceed their limits by this share of their range."""


@dataclass(frozen=True)
class Repaired:
    """A repaired recording.

    Attributes:
        recording: without the faults.
        notes: one sentence per kind of fault.
    """

    recording: Recording
    notes: tuple[str, ...]


def repair(recording: Recording, spec: RobotSpec) -> Repaired:
    """Drops repeated rows and jumps, and clips commands to the robot's limits."""
    recording, repeated = _without_repetitions(recording)
    recording, jumps = _without_jumps(recording, spec)
    recording, beyond = _within_limits(recording, spec)
    return Repaired(recording, (*repeated, *jumps, *beyond))


def _with_rows(recording: Recording, name: str, keep: NDArray[np.bool_]) -> Recording:
    """Returns the recording with only the rows `keep` (T,) of one stream."""
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
    """Selects the poses (T,) that jump in position or heading."""
    if len(pose.t) <= 2 * NEIGHBOURS:
        return np.zeros(len(pose.t), dtype=np.bool_)
    t = spread(pose.t, find_bursts(pose.t))
    span = np.zeros(len(t))
    span[NEIGHBOURS:] = t[NEIGHBOURS:] - t[:-NEIGHBOURS]
    span[:-NEIGHBOURS] = np.maximum(span[:-NEIGHBOURS], t[NEIGHBOURS:] - t[:-NEIGHBOURS])
    speeds = [abs(v) for c in spec.command if not c.turns for v in (c.min, c.max)]
    reach = np.maximum(REACH * max(speeds, default=0.0) * span, 1e-6)
    out = [_stands_out(pose.values[:, i], reach) for i in (0, 1)]
    turns = np.maximum(HEADING_REACH, reach / max(spec.footprint_radius, 1e-3) / 2.0)
    return out[0] | out[1] | _stands_out(pose.values[:, 2], turns, turning=True)


def _jumps_of_state(state: Stream) -> NDArray[np.bool_]:
    """Selects the states (T,) that jump in any component."""
    out = np.zeros(len(state.t), dtype=np.bool_)
    if len(state.t) <= 2 * NEIGHBOURS:
        return out
    for column in state.values.T:
        low, high = np.percentile(column, (5.0, 95.0))
        out |= _stands_out(column, np.full(len(column), max(STATE_SHARE * (high - low), 1e-9)))
    return out


def _stands_out(values: Array, least: Array, turning: bool = False) -> NDArray[np.bool_]:
    """Selects the values (T,) that differ from both sides, in the same direction.

    Args:
        values: (T,) of one component.
        least: (T,) minimum difference, in addition to `STEPS` times the usual change.
        turning: True for angles, whose differences are wrapped.
    """
    back, ahead = _differences(values, turning)
    usual = float(np.percentile(np.abs(back[0][1:]), USUAL))
    before, after = np.median(back, axis=0), np.median(ahead, axis=0)
    apart = np.minimum(np.abs(before), np.abs(after))
    return np.asarray((before * after > 0.0) & (apart > np.maximum(STEPS * usual, least)))


def _differences(values: Array, turning: bool) -> tuple[Array, Array]:
    """Returns differences (NEIGHBOURS, T) from the samples before and after; zero at the ends."""
    count = len(values)
    back, ahead = np.zeros((NEIGHBOURS, count)), np.zeros((NEIGHBOURS, count))
    for n in range(1, NEIGHBOURS + 1):
        difference = values[n:] - values[:-n]
        difference = wrap_angle(difference) if turning else difference
        back[n - 1, n:], ahead[n - 1, :-n] = difference, -difference
    return back, ahead


def _within_limits(recording: Recording, spec: RobotSpec) -> tuple[Recording, list[str]]:
    """Clips commands to the robot's limits, unless it followed them beyond."""
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
    """Returns the share of the state's rates that commands (T, C) leave unexplained.

    0 without a measured state.
    """
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
"""In bursts the mean interval is more than this many times the 30th percentile."""
WITHIN_BURST = 0.25
"""Stamps less than this share of the period apart belong to one burst."""


@dataclass(frozen=True)
class Bursts:
    """Bursts of arrivals.

    Attributes:
        period_s: usual time between two bursts [s].
        size: usual number of samples per burst.
        of: (T,) index of the burst of each sample.
        newest: (K,) index of the last sample of each burst, the freshest on arrival.
    """

    period_s: float
    size: float
    of: NDArray[np.intp]
    newest: NDArray[np.intp]


def find_bursts(t: Array) -> Bursts | None:
    """Finds bursts in stamps (T,) [s]; None if the samples arrive one by one."""
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
    """Estimates sample times (T,) from arrival stamps (T,) [s].

    The samples of a burst were taken one after the other since the previous burst, the newest
    just before its arrival. After a gap they are assumed to fill one period, or more if the
    burst is larger than usual.
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
    """Returns indices of the samples with the best known time: the newest per burst, or all."""
    return np.arange(len(t)) if bursts is None else bursts.newest
