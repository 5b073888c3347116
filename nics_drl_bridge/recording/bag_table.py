"""Topics of a bag as tables: any numeric field of any message type."""

import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from nics_drl_bridge.errors import RecordingError, suggest
from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.recording import mapping as mapped
from nics_drl_bridge.recording import topic_roles as roles
from nics_drl_bridge.recording.bag_file import BagFile, Message, read_times
from nics_drl_bridge.recording.bag_reader import measure_latency, select_transforms
from nics_drl_bridge.recording.recording import Stream
from nics_drl_bridge.recording.stamping import (
    ROBOT_STREAMS,
    TopicData,
    has_continuous_headers,
    stamp_streams,
)
from nics_drl_bridge.recording.table import Column, Source, Table
from nics_drl_bridge.robot.noise import Latency

LONGEST_ARRAY = 64  # elements of longer arrays are not listed
# Message types that are not read as columns of numbers
SCENES = re.compile(r"/(Compressed)?Image$|/PointCloud2?$|/LaserScan$")
PART = re.compile(r"[^.\[\]]+")
STAMPS: dict[str, roles.Stamps] = {
    "": "auto",
    mapped.HEADER: "header",
    mapped.ARRIVAL: "receive",
}
NAMES = "name"  # field of JointState with a name for each element of the other arrays


def list_fields(message: Any, path: str = "") -> Iterator[str]:
    """Yields the paths of all numbers and texts in a message: `pose.position.x`, `data[0]`."""
    if isinstance(message, (bool, int, float, str, np.generic)) or hasattr(
        message, "nanosec"
    ):
        yield path
    elif isinstance(message, (list, tuple, np.ndarray)):
        if len(message) <= LONGEST_ARRAY:
            for k, element in enumerate(message):
                yield from list_fields(element, f"{path}[{k}]")
    else:
        labels: Any = getattr(message, NAMES, None)
        for name in vars(message):
            if name.startswith("__"):
                continue
            inner = getattr(message, name)
            where = f"{path}.{name}".lstrip(".")
            listed = isinstance(labels, list) and isinstance(inner, (list, np.ndarray))
            if listed and name != NAMES and len(inner) == len(labels) > 0:
                yield from (f"{where}[{label}]" for label in labels)
            else:
                yield from list_fields(inner, where)


def make_field_reader(path: str) -> Callable[[Any], Any]:
    """Returns a function that reads a field of messages; NaN where a message lacks it."""
    parts = PART.findall(path)

    def read(message: Any) -> Any:
        within = message
        for part in parts:
            if isinstance(message, (list, tuple, np.ndarray)):
                labels = getattr(within, NAMES, [])
                if part.isdecimal():
                    k = int(part)
                elif part in labels:
                    k = labels.index(part)
                else:
                    k = -1
                if not 0 <= k < len(message):
                    return np.nan
                message = message[k]
            else:
                within = message
                message = getattr(message, part)
        if hasattr(message, "nanosec"):
            return message.sec + message.nanosec * S_PER_NS
        return message

    return read


def read_column(
    place: str, names: Sequence[str], messages: Sequence[Message], which: str | int
) -> Column:
    """Returns a field of all messages (T,).

    Raises RecordingError if there is no such field, or if it is not a single number or text.
    """
    if isinstance(which, int):
        which = names[which]
    path = which
    hint = suggest(path, names)
    inner = next((name for name in names if name.startswith(path)), None)
    if inner is not None:
        hint = f"say which, as {inner!r}."
    read = make_field_reader(path)
    try:
        values = [read(message.content) for message in messages]
    except AttributeError:
        raise RecordingError(f"{place}: has no {path!r}; {hint}") from None
    if isinstance(values[0], str):
        return np.array(values, dtype=np.str_)
    try:
        column = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        column = np.zeros((0, 0))
    if column.ndim != 1:
        raise RecordingError(f"{place}: {path!r} is no single number; {hint}")
    return column


class Bag(Source):
    """The topics of an open bag as tables; of transforms, only those between two frames."""

    def __init__(self, bag: BagFile, mapping: mapped.Mapping | None) -> None:
        topics = [
            topic
            for topic, kind in sorted(bag.types.items())
            if topic not in bag.empty and not SCENES.search(kind)
        ]
        super().__init__(bag.place, [t for t in topics if bag.can_decode(t)])
        self._bag = bag
        self._frames: tuple[str | None, str | None] = (None, None)
        # topics that are stamped together, and whether they come from the robot's computer
        self._used: dict[str, bool] = {}
        if mapping is not None:
            self._frames = mapping.pose.frames
            self._used = list_topics_used(mapping, self.names)
        self._messages: dict[str, Sequence[Message]] = {}
        self._notes: dict[str, list[str]] = {}  # by topic
        self._stamps: dict[tuple[str, ...], Stream] = {}

    @property
    def latency(self) -> Latency:
        """Delays of scan and odometry, as far as the bag shows them."""
        return measure_latency(self._bag)

    def read(self, name: str) -> Table:
        """Reads a topic."""
        messages = self._read_messages(name)
        place = f"{self.place}: topic {name!r}"
        names = tuple(dict.fromkeys(list_fields(messages[0].content)))
        column = partial(read_column, place, names, messages)
        stamps = partial(self._stamp_rows, name)
        notes = self._notes.setdefault(name, [])
        kind = self._bag.types[name]
        return Table(place, names, column, "message {}".format, notes, stamps, kind)

    def _read_messages(self, topic: str) -> Sequence[Message]:
        if topic not in self._messages:
            messages: Sequence[Message] = self._bag.read_messages(topic)
            if self._bag.types[topic] == roles.TRANSFORMS:
                messages = select_transforms(self._bag, topic, messages, *self._frames)
            self._messages[topic] = messages
        return self._messages[topic]

    def _stamp_rows(self, topic: str, which: str) -> Stream:
        """Stamps a topic with all topics in use: only together do they show their clocks."""
        topics = tuple(self._used) or (topic,)
        key = (which, topic, *topics)
        if key not in self._stamps:
            self._stamps[key] = self._stamp_topics(topic, topics, which)
        return self._stamps[key]

    def _stamp_topics(self, topic: str, topics: Sequence[str], which: str) -> Stream:
        data = {}
        for name in topics:
            messages = self._read_messages(name)
            rows = np.arange(len(messages), dtype=np.float64)[:, None]
            data[name] = TopicData(name, *read_times(messages), rows)
        # If other topics lack headers, these are compared with the arrival, as by default.
        bare = [name for name, part in data.items() if not np.any(part.header_ns)]
        stamps = STAMPS[which]
        if which == mapped.HEADER and bare and topic not in bare:
            stamps = "auto"
        robot = [name for name, is_robots in self._used.items() if is_robots]
        try:
            return stamp_streams(data, stamps, self.place, robot)[topic]
        except RecordingError as error:
            if which:
                raise
            stamps = "receive"
            origin = "arrival"
            if has_continuous_headers(data.values()):
                stamps = "header"
                origin = "headers, which go on together"
            note = f"{error.reason}; all messages were stamped by their {origin}."
            self._notes.setdefault(topic, []).append(note)
            return stamp_streams(data, stamps, self.place, robot)[topic]


def list_topics_used(mapping: mapped.Mapping, topics: Sequence[str]) -> dict[str, bool]:
    """Returns the topics that a mapping names, and whether `ROBOT_STREAMS` use them."""
    used: dict[str, bool] = {}

    def walk(part: Any, is_robots: bool) -> None:
        if isinstance(part, dict):
            for key, value in part.items():
                walk(value, is_robots or key in ROBOT_STREAMS)
                walk(key, is_robots)
        elif isinstance(part, (list, tuple)):
            for item in part:
                walk(item, is_robots)
        elif isinstance(part, str):
            names = {part[:k] for k, sign in enumerate(part) if sign == ":"}
            names.add(part)
            for topic in topics:
                if topic in names or topic.removeprefix("/") in names:
                    used[topic] = used.get(topic, False) or is_robots

    walk(mapping.model_dump(by_alias=True, exclude={"robot"}, exclude_none=True), False)
    return used
