"""Joins recordings of one robot into one, as episodes on one time axis that no window crosses.

Each recording is split: its first part is for training, the rest is held out. All
training parts come first, so that one time separates them from the held-out parts.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording.recording import STREAMS, Episode, Recording, Stream

LEARNT_SHARE = 2.0 / 3.0  # fraction of each recording
# Time between two episodes, longer than any prediction and any search for a delay
APART_S = 30.0
LEAD_S = 2.0  # commands kept before an episode, so that states can follow them
SETTLE_S = 5.0  # time for which the first of these commands is held before them
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
    aligned = [_align_clocks(*pair) for pair in zip(recordings, offsets, strict=True)]
    _check_alike(aligned)
    parts: list[_Part] = []
    for recording in aligned:
        parts += _split_recording(recording)
    learnt = [part for part in parts if part.is_learnt]
    held_out = [part for part in parts if not part.is_learnt]
    return _place_parts(aligned, learnt, held_out)


def split_at(
    recording: Recording, starts: Sequence[float], names: Sequence[str]
) -> Recording:
    """Splits a recording into episodes that start at times [s] on the clock of its streams."""
    ends = [*starts[1:], np.inf]
    parts = []
    for start, end, name in zip(starts, ends, names, strict=True):
        t = recording.pose.t
        pose = recording.pose.rows((t >= start) & (t < end))
        if len(pose.t) > 1:
            parts.append(replace(recording, pose=pose, source=name))
    if len(parts) > 1:
        return replace(join(parts), source=recording.source)
    return recording


def _align_clocks(recording: Recording, offset: float) -> Recording:
    pose = recording.pose
    command = recording.command
    if pose.clock == command.clock:
        return recording
    note = f"{recording.source}: the clock of its pose was aligned by {offset:.3f} s."
    pose = replace(pose, t=pose.t + offset, clock=command.clock)
    return replace(recording, pose=pose, repairs=(*recording.repairs, note))


def _check_alike(recordings: Sequence[Recording]) -> None:
    """Refuses recordings of different robots (RecordingError)."""
    first = recordings[0]
    for recording in recordings[1:]:
        counts = [drive.command.values.shape[1] for drive in (first, recording)]
        if counts[0] != counts[1] or first.variables != recording.variables:
            names = ", ".join(recording.variables) or f"{counts[1]} commands"
            first_names = ", ".join(first.variables) or f"{counts[0]} commands"
            raise RecordingError(
                f"{recording.source}: has {names}, {first.source} has {first_names}; "
                "join only drives of one robot, by one mapping."
            )


def _split_recording(recording: Recording) -> list[_Part]:
    """Splits a recording into the part to learn from and the rest; episodes stay as they are."""
    if recording.episodes:
        until = recording.learn_until_s
        learnt_until = np.inf if until is None else float(recording.pose.t[0]) + until
        return [
            _Part(recording, e.start_s, e.end_s, e.start_s <= learnt_until, e.source)
            for e in recording.episodes
        ]
    pose = recording.pose.t
    begin = max(float(pose[0]), float(recording.command.t[0]))
    end = float(pose[-1])
    if not begin < end:
        raise RecordingError(
            f"{recording.source}: its commands and poses share no time; check that "
            "they are of one drive."
        )
    if end - begin < SHORTEST_SPLIT_S:
        return [_Part(recording, begin, end, True, recording.source)]
    middle = begin + LEARNT_SHARE * (end - begin)
    last = float(pose[pose <= middle][-1])
    first = float(pose[pose > middle][0])
    return [
        _Part(recording, begin, last, True, recording.source),
        _Part(recording, first, end, False, recording.source),
    ]


def _place_parts(
    recordings: Sequence[Recording], learnt: Sequence[_Part], held_out: Sequence[_Part]
) -> Recording:
    """Arranges parts on one time axis; each pose begins where the previous one ended."""
    shared = [
        name for name in STREAMS if all(name in drive.streams for drive in recordings)
    ]
    parts = (*learnt, *held_out)
    streams, episodes = _line_up(parts, shared)
    joined: dict[str, Any] = dict.fromkeys(STREAMS)
    joined |= {name: _append_streams(name, some) for name, some in streams.items()}
    sources = list(dict.fromkeys(part.source for part in parts))
    robots = [drive.robot for drive in recordings if drive.robot is not None]
    return replace(
        recordings[0],
        **joined,
        source=", ".join(dict.fromkeys(drive.source for drive in recordings)),
        repairs=(
            _describe_join(sources, bool(held_out)),
            *_collect_repairs(recordings, shared),
        ),
        robot=next(iter(robots), None),
        episodes=tuple(episodes),
        learn_until_s=episodes[len(learnt) - 1].end_s,
    )


def _line_up(
    parts: Sequence[_Part], names: Sequence[str]
) -> tuple[dict[str, list[Stream]], list[Episode]]:
    """Returns the streams of parts one after another, by name, and the parts as episodes."""
    streams: dict[str, list[Stream]] = {name: [] for name in names}
    episodes = []
    start = 0.0
    place = np.zeros(3)
    for part in parts:
        shift = start - part.start_s
        cut = _cut_part(part, names)
        cut["pose"] = _move_pose(cut["pose"], place)
        place = cut["pose"].values[-1]
        for name, stream in cut.items():
            streams[name].append(replace(stream, t=stream.t + shift))
        episodes.append(Episode(part.source, start, part.end_s + shift))
        start = part.end_s + shift + APART_S
    return streams, episodes


def _cut_part(part: _Part, names: Sequence[str]) -> dict[str, Stream]:
    """Returns the streams of a part, with further commands before and after it."""
    cut = {}
    for name in names:
        stream = part.recording.streams[name]
        if name == "command":
            cut[name] = _cut_commands(stream, part)
            continue
        rows = (stream.t >= part.start_s) & (stream.t <= part.end_s)
        if rows.sum() < 2:
            raise RecordingError(
                f"{part.source}: has no {name} between {part.start_s:.1f} and "
                f"{part.end_s:.1f} s; remove this recording, or its {name}."
            )
        cut[name] = stream.rows(rows)
    return cut


def _cut_commands(command: Stream, part: _Part) -> Stream:
    """Returns a part's commands, and before them the one in effect, so that states can settle."""
    lead = part.start_s - LEAD_S
    first = max(int(np.searchsorted(command.t, lead, side="right")) - 1, 0)
    last = int(np.searchsorted(command.t, part.end_s + AFTER_S, side="right"))
    rows = command.rows(slice(first, max(last, first + 1)))
    t = np.maximum(rows.t, lead)
    t = np.append(t[0] - SETTLE_S, t)
    values = np.concatenate([rows.values[:1], rows.values])
    sigma = rows.sigma
    if sigma is not None:
        sigma = np.concatenate([sigma[:1], sigma])
    return replace(rows, t=t, values=values, sigma=sigma)


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
    moved_x = np.hypot(cosine * x, sine * y)
    moved_y = np.hypot(sine * x, cosine * y)
    sigma = np.stack([moved_x, moved_y, heading], axis=1)
    return replace(pose, values=values, sigma=sigma)


def _append_streams(name: str, parts: Sequence[Stream]) -> Stream:
    """Appends streams; deviations are kept only if all of them have some."""
    for before, after in pairwise(parts):
        if after.t[0] < before.t[-1]:
            raise RecordingError(
                f"{name}: two episodes overlap in time; please report this bug."
            )
    sigma = None
    sigmas = [part.sigma for part in parts if part.sigma is not None]
    if len(sigmas) == len(parts):
        sigma = np.concatenate(sigmas)
    t = np.concatenate([part.t for part in parts])
    values = np.concatenate([part.values for part in parts])
    return Stream(t, values, parts[0].clock, sigma)


def _describe_join(sources: Sequence[str], is_split: bool) -> str:
    names = f"{sources[0]} to {sources[-1]}"
    if len(sources) <= 10:
        names = ", ".join(sources)
    split = "all of them were fitted because they are too short to hold out a part"
    if is_split:
        split = "the last third of each was held out of the first fit"
    return (
        f"{len(sources)} drives were joined ({names}): {split}; no prediction crosses "
        "over."
    )


def _collect_repairs(
    recordings: Sequence[Recording], shared: Sequence[str]
) -> tuple[str, ...]:
    lost: set[str] = set()
    for recording in recordings:
        lost.update(recording.streams)
    lost.difference_update(shared)
    repairs = [
        f"{name} was left out because not all recordings have it."
        for name in sorted(lost)
    ]
    for recording in recordings:
        repairs += recording.repairs
    return tuple(dict.fromkeys(repairs))
