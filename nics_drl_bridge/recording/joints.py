"""Joints: a robot's state and wheel speeds from its joint messages."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import RecordingError, nearest
from nics_drl_bridge.recording.stamping import Nanoseconds, TopicData
from nics_drl_bridge.recording.topic_roles import JointSource, TopicRoles
from nics_drl_bridge.robot.spec import RobotSpec, StateVariable

Array = NDArray[np.float64]
POSITION_UNITS = ("rad", "m")
WHEELS = ("left_wheel", "right_wheel")


@dataclass(frozen=True)
class Joints:
    """Messages about joints.

    Attributes:
        topic: their topic.
        receive_ns: (T,) times of receipt [ns].
        header_ns: (T,) their stamps [ns].
        names: of the J joints in any of the messages.
        position: (T, J) [rad or m], NaN if missing in a message.
        velocity: (T, J) [rad/s or m/s], likewise.
    """

    topic: str
    receive_ns: Nanoseconds
    header_ns: Nanoseconds
    names: tuple[str, ...]
    position: Array
    velocity: Array


@dataclass(frozen=True)
class JointMessage:
    """One message.

    Attributes:
        receive_ns: time of receipt [ns].
        header_ns: its stamp [ns].
        names: of the joints in it.
        position: of each, or empty.
        velocity: of each, or empty.
    """

    receive_ns: int
    header_ns: int
    names: Sequence[str]
    position: Sequence[float]
    velocity: Sequence[float]


def gather(topic: str, messages: Sequence[JointMessage]) -> Joints:
    """Collects messages, which may contain different joints, in one table."""
    names = tuple(dict.fromkeys(name for message in messages for name in message.names))
    place = {name: j for j, name in enumerate(names)}
    position, velocity = np.full((2, len(messages), len(names)), np.nan)
    for row, message in enumerate(messages):
        columns = [place[name] for name in message.names]
        for table, values in ((position, message.position), (velocity, message.velocity)):
            if len(values) == len(columns):
                table[row, columns] = values
    receive = np.array([m.receive_ns for m in messages], dtype=np.int64)
    header = np.array([m.header_ns for m in messages], dtype=np.int64)
    return Joints(topic, receive, header, names, position, velocity)


def state_of(joints: Joints, spec: RobotSpec, roles: TopicRoles, place: str) -> TopicData | None:
    """Returns the measured state (T, S), from the messages that contain all of it.

    Args:
        joints: of the robot.
        spec: the robot.
        roles: may name the joint of each state variable.
        place: the recording's name, for errors.

    Returns:
        The state; None if joints of some state variables are missing, but no state has to be
        measured because each follows a command.

    Raises:
        RecordingError: a named joint does not exist, or a required state was not measured.
    """
    there = f"the joints of {joints.topic!r} are {', '.join(joints.names) or 'none'}"
    known = [v.name for v in spec.state]
    for name in roles.state:
        if name not in known:
            raise RecordingError(
                f"{place}: topics: robot {spec.name!r} has no state {name!r}; "
                f"{nearest(name, known)}"
            )
    sources = [_source(joints, variable, roles, place) for variable in spec.state]
    found = [source for source in sources if source is not None]
    if spec.state and len(found) == len(sources):
        columns = [_column(joints, v, s) for v, s in zip(spec.state, found, strict=True)]
        return _complete(joints, np.stack(columns, axis=1), [s.joint for s in found], place)
    missing = [v.name for v, s in zip(spec.state, sources, strict=True) if s is None]
    if roles.state or any(v.follows is None for v in spec.state):
        raise RecordingError(
            f"{place}: no joint is known for the state {missing[0]!r}; {there}: name it in the "
            f"topics file, as in state: {{{missing[0]}: JOINT}}."
        )
    return None


def wheels_of(joints: Joints, roles: TopicRoles, place: str) -> TopicData | None:
    """Returns the speeds (T, 2) of the left and right wheel; None without such joints."""
    guesses = (_alike(joints.names, wheel) for wheel in WHEELS)
    chosen = list(roles.wheels or (name for name in guesses if name is not None))
    if len(chosen) < len(WHEELS):
        return None
    for name in chosen:
        _require(joints, name, place)
    values = joints.velocity[:, [joints.names.index(name) for name in chosen]]
    if roles.wheels is None and not np.isfinite(values).all(axis=1).any():
        return None
    return _complete(joints, values, chosen, place)


def _source(
    joints: Joints, variable: StateVariable, roles: TopicRoles, place: str
) -> JointSource | None:
    named = roles.state.get(variable.name)
    if named is None:
        guess = _alike(joints.names, variable.name)
        return None if guess is None else JointSource(joint=guess)
    source = JointSource(joint=named) if isinstance(named, str) else named
    _require(joints, source.joint, place)
    return source


def _require(joints: Joints, name: str, place: str) -> None:
    if name not in joints.names:
        raise RecordingError(
            f"{place}: topic {joints.topic!r} has no joint {name!r}; {nearest(name, joints.names)}"
        )


def _alike(names: Iterable[str], wanted: str) -> str | None:
    """Returns the only joint whose name has all words of the wanted name, in any order."""
    words = set(wanted.split("_"))
    found = [name for name in names if words <= set(re.split(r"[^a-z]+", name.lower()))]
    return wanted if wanted in found else found[0] if len(found) == 1 else None


def _column(joints: Joints, variable: StateVariable, source: JointSource) -> Array:
    usual = "position" if variable.unit in POSITION_UNITS else "velocity"
    table = joints.position if (source.field or usual) == "position" else joints.velocity
    return np.asarray(source.scale * table[:, joints.names.index(source.joint)])


def _complete(joints: Joints, values: Array, names: Sequence[str], place: str) -> TopicData:
    """Drops the messages about other joints."""
    keep = np.asarray(np.isfinite(values).all(axis=1))
    if not keep.any():
        raise RecordingError(
            f"{place}: topic {joints.topic!r}: no message tells the position or velocity that is "
            f"needed of {', '.join(names)}; check what the joints' driver publishes."
        )
    return TopicData(joints.topic, joints.receive_ns, joints.header_ns, values).rows(keep)
