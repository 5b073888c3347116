"""Joins recordings of one robot into one, as episodes on one time axis with gaps between them.

Each recording is split: its first part is for training, the rest is held out. All
training parts come first, so that one time separates them from the held-out parts.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, cast

import numpy as np

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording.recording import STREAMS, Episode, Recording, Stream

LEARNT_SHARE = 2.0 / 3.0  # fraction of each recording
# Time between two episodes, longer than any prediction and any search for a delay
APART_S = 30.0
LEAD_S = 2.0  # commands kept before an episode, so that states can follow them
SETTLE_S = 5.0  # the first of these commands begins this much earlier
AFTER_S = 5.0  # commands kept after an episode, for searches of a delay
SHORTEST_SPLIT_S = 6.0  # shorter recordings are learnt from as a whole


@dataclass(frozen=True)
class _Part:
    """A part of a recording that becomes an episode."""

    recording: Recording
    start_s: float  # time of the first pose, and of the last [s]
    end_s: float
    is_learnt: bool
    source: str


def join(recordings: Sequence[Recording], offsets: Sequence[float] = ()) -> Recording:
    """Joins recordings of one robot. Raises RecordingError if their variables differ.

    `offsets` [s], by default 0, are added to the pose stamps of recordings whose pose and commands
    have different clocks.
    """
    offsets = offsets or [0.0] * len(recordings)
    drives = [_align_clocks(*pair) for pair in zip(recordings, offsets, strict=True)]
    first = drives[0]
    for drive in drives[1:]:
        _check_alike(first, drive)
    parts = list(chain.from_iterable(map(_split_recording, drives)))
    parts.sort(key=lambda part: not part.is_learnt)
    learnt = sum(part.is_learnt for part in parts)
    shared = [
        name for name in STREAMS if all(name in drive.streams for drive in drives)
    ]
    streams, episodes = _line_up(parts, shared)
    lost = {*chain.from_iterable(drive.streams for drive in drives)}.difference(shared)
    repairs = [_describe_join(parts, learnt < len(parts))]
    for name in sorted(lost):
        repairs.append(f"{name} was left out because not all recordings have it.")
    for drive in drives:
        repairs += drive.repairs
    return replace(
        first,
        **cast(Any, dict.fromkeys(STREAMS) | streams),
        source=", ".join(dict.fromkeys(drive.source for drive in drives)),
        repairs=tuple(dict.fromkeys(repairs)),
        robot=next((drive.robot for drive in drives if drive.robot is not None), None),
        episodes=tuple(episodes),
        learn_until_s=episodes[learnt - 1].end_s,
    )


def split_at(
    recording: Recording, starts: Sequence[float], names: Sequence[str]
) -> Recording:
    """Splits a recording into episodes that start at times [s] on the clock of its streams."""
    t = recording.pose.t
    parts = []
    for start, end, name in zip(starts, [*starts[1:], np.inf], names, strict=True):
        pose = recording.pose.rows((t >= start) & (t < end))
        if len(pose.t) > 1:
            parts.append(replace(recording, pose=pose, source=name))
    if len(parts) > 1:
        return replace(join(parts), source=recording.source)
    return recording


def _align_clocks(recording: Recording, offset: float) -> Recording:
    pose = recording.pose
    clock = recording.command.clock
    if pose.clock == clock:
        return recording
    note = f"{recording.source}: the clock of its pose was aligned by {offset:.3f} s."
    pose = replace(pose, t=pose.t + offset, clock=clock)
    return replace(recording, pose=pose, repairs=(*recording.repairs, note))


def _check_alike(first: Recording, other: Recording) -> None:
    """Refuses a recording of another robot (RecordingError)."""
    counts = [drive.command.values.shape[1] for drive in (first, other)]
    if counts[0] != counts[1] or first.variables != other.variables:
        names = ", ".join(other.variables) or f"{counts[1]} commands"
        first_names = ", ".join(first.variables) or f"{counts[0]} commands"
        raise RecordingError(
            f"{other.source}: has {names}, {first.source} has {first_names}; join only "
            "drives of one robot, by one mapping."
        )


def _split_recording(recording: Recording) -> list[_Part]:
    """Splits a recording into the part to learn from and the rest; episodes stay as they are."""
    pose = recording.pose.t
    if recording.episodes:
        until = recording.learn_until_s
        learnt_until = np.inf if until is None else float(pose[0]) + until
        return [
            _Part(recording, e.start_s, e.end_s, e.start_s <= learnt_until, e.source)
            for e in recording.episodes
        ]
    source = recording.source
    begin = max(float(pose[0]), float(recording.command.t[0]))
    end = float(pose[-1])
    if not begin < end:
        raise RecordingError(
            f"{source}: its commands and poses share no time; check that they are of "
            "one drive."
        )
    if end - begin < SHORTEST_SPLIT_S:
        return [_Part(recording, begin, end, True, source)]
    middle = begin + LEARNT_SHARE * (end - begin)
    last = float(pose[pose <= middle][-1])
    first = float(pose[pose > middle][0])
    return [
        _Part(recording, begin, last, True, source),
        _Part(recording, first, end, False, source),
    ]


def _line_up(
    parts: Sequence[_Part], names: Sequence[str]
) -> tuple[dict[str, Stream], list[Episode]]:
    """Returns the streams of parts one after another, by name, and the parts as episodes.

    Each pose begins where the previous one ended.
    """
    streams: dict[str, list[Stream]] = {name: [] for name in names}
    episodes = []
    start = 0.0
    place = np.zeros(3)
    for part in parts:
        shift = start - part.start_s
        for name in names:
            stream = _cut_stream(name, part)
            if name == "pose":
                stream = _move_pose(stream, place)
                place = stream.values[-1]
            streams[name].append(replace(stream, t=stream.t + shift))
        episodes.append(Episode(part.source, start, part.end_s + shift))
        start = part.end_s + shift + APART_S
    return {name: _append_streams(some) for name, some in streams.items()}, episodes


def _cut_stream(name: str, part: _Part) -> Stream:
    """Returns a stream of a part; commands begin before it, so that states can settle."""
    stream = part.recording.streams[name]
    if name == "command":
        lead = part.start_s - LEAD_S
        first = max(int(np.searchsorted(stream.t, lead, side="right")) - 1, 0)
        last = int(np.searchsorted(stream.t, part.end_s + AFTER_S, side="right"))
        commands = stream.rows(np.r_[first, first : max(last, first + 1)])
        t = np.maximum(commands.t, lead)
        t[0] -= SETTLE_S
        return replace(commands, t=t)
    rows = (stream.t >= part.start_s) & (stream.t <= part.end_s)
    if rows.sum() < 2:
        raise RecordingError(
            f"{part.source}: has no {name} between {part.start_s:.1f} and "
            f"{part.end_s:.1f} s; remove this recording, or its {name}."
        )
    return stream.rows(rows)


def _move_pose(pose: Stream, place: Array) -> Stream:
    """Moves poses (T, 3) rigidly so that the first lies at a place (3,).

    The robot's motion does not depend on its position. Between two episodes the pose is
    then at rest, regardless of their frames.
    """
    first = pose.values[0]
    values = geometry.compose(place, geometry.between(first, pose.values))
    if pose.sigma is None:
        return replace(pose, values=values)
    cosine = np.cos(place[2] - first[2])
    sine = np.sin(place[2] - first[2])
    x, y, heading = pose.sigma.T
    sigma = [np.hypot(cosine * x, sine * y), np.hypot(sine * x, cosine * y), heading]
    return replace(pose, values=values, sigma=np.stack(sigma, axis=1))


def _append_streams(parts: Sequence[Stream]) -> Stream:
    """Appends streams; deviations are kept only if all of them have some."""
    sigmas = [part.sigma for part in parts if part.sigma is not None]
    return Stream(
        np.concatenate([part.t for part in parts]),
        np.concatenate([part.values for part in parts]),
        parts[0].clock,
        np.concatenate(sigmas) if len(sigmas) == len(parts) else None,
    )


def _describe_join(parts: Sequence[_Part], is_split: bool) -> str:
    sources = list(dict.fromkeys(part.source for part in parts))
    names = f"{sources[0]} to {sources[-1]}"
    if len(sources) <= 10:
        names = ", ".join(sources)
    split = "all of them were fitted because they are too short to hold out a part"
    if is_split:
        split = "the last third of each was held out of the first fit"
    return (
        f"{len(sources)} drives were joined ({names}): {split}; no prediction crosses "
        "from one to the next."
    )
