"""Topics of a bag as tables: any numeric field of any message type."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from nics_drl_bridge.errors import RecordingError, nearest
from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.recording import topic_roles as roles
from nics_drl_bridge.recording.bag_file import BagFile, Message, times_of
from nics_drl_bridge.recording.bag_reader import latency_of, of_one_body
from nics_drl_bridge.recording.mapping import ARRIVAL, HEADER
from nics_drl_bridge.recording.recording import Stream
from nics_drl_bridge.recording.stamping import ROBOT_STREAMS, TopicData, streams
from nics_drl_bridge.recording.table import Column
from nics_drl_bridge.robot.noise import Latency

LONGEST_ARRAY = 64  # of which each element is listed
SCENES = re.compile(
    r"/(Compressed)?Image$|/PointCloud2?$|/LaserScan$"
)  # types of no single numbers
PART = re.compile(r"[^.\[\]]+")
STAMPS: dict[str, roles.Stamps] = {"": "auto", HEADER: "header", ARRIVAL: "receive"}
NAMES = "name"  # field of JointState with a name for each element of the other arrays


def fields_of(message: Any, path: str = "") -> Iterator[str]:
    """Yields the paths of all numbers and texts in a message, as `pose.position.x`, `data[0]`."""
    if isinstance(message, (bool, int, float, str, np.generic)) or hasattr(message, "nanosec"):
        yield path
    elif isinstance(message, (list, tuple, np.ndarray)):
        for k in range(len(message) if len(message) <= LONGEST_ARRAY else 0):
            yield from fields_of(message[k], f"{path}[{k}]")
    else:
        labels = getattr(message, NAMES, None)
        for name in (each for each in vars(message) if not each.startswith("__")):
            inner, where = getattr(message, name), f"{path}.{name}".lstrip(".")
            if isinstance(labels, list) and name != NAMES and _is_array(inner, len(labels)):
                yield from (f"{where}[{label}]" for label in labels)
            else:
                yield from fields_of(inner, where)


def _is_array(value: Any, length: int) -> bool:
    return isinstance(value, (list, np.ndarray)) and len(value) == length > 0


def reader_of_field(path: str) -> Callable[[Any], Any]:
    """Returns a function that reads a field of messages; NaN where a message lacks it."""
    parts = PART.findall(path)

    def read(message: Any) -> Any:
        within = message
        for part in parts:
            if isinstance(message, (list, tuple, np.ndarray)):
                labels = getattr(within, NAMES, [])
                k = int(part) if part.isdecimal() else labels.index(part) if part in labels else -1
                if not 0 <= k < len(message):
                    return np.nan
                message = message[k]
            else:
                within, message = message, getattr(message, part)
        if hasattr(message, "nanosec"):
            return message.sec + message.nanosec * S_PER_NS
        return message

    return read


@dataclass(frozen=True)
class TopicTable:
    """Messages of a topic."""

    place: str
    topic: str
    messages: Sequence[Message]
    names: tuple[str, ...]
    stamped: Callable[[str], Stream]
    notes: Sequence[str] = ()

    def column(self, which: str | int) -> Column:
        """Returns a field of all messages; RecordingError if they have none of that name."""
        path = self.names[which] if isinstance(which, int) else which
        read = reader_of_field(path)
        try:
            values = [read(message.content) for message in self.messages]
        except AttributeError:
            raise RecordingError(f"{self.place}: has no {path!r}; {self._hint(path)}") from None
        if isinstance(values[0], str):
            return np.array(values, dtype=np.str_)
        try:
            column = np.array(values, dtype=np.float64)
        except (TypeError, ValueError):
            column = np.zeros((0, 0))
        if column.ndim != 1:
            fault = f"{path!r} is no single number"
            raise RecordingError(f"{self.place}: {fault}; {self._hint(path)}")
        return column

    def _hint(self, path: str) -> str:
        inner = [name for name in self.names if name.startswith(path)]
        return f"say which, as {inner[0]!r}." if inner else nearest(path, self.names)

    def row(self, k: int) -> str:
        """Names a message for errors."""
        return f"message {k}"

    def stamps(self, which: str) -> Stream | None:
        """Returns stamps by header or arrival, and in `values` (T, 1) the message of each."""
        return self.stamped(which)


@dataclass
class Bag:
    """The topics of an opened bag as tables."""

    bag: BagFile
    frames: tuple[str | None, str | None] = (None, None)  # of the transforms to use
    # topics that are read, and whether they come from the robot's computer, for common stamps
    used: Mapping[str, bool] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    _read: dict[str, TopicTable] = field(default_factory=dict)
    _stamps: dict[tuple[str, ...], dict[str, Stream]] = field(default_factory=dict)

    @property
    def place(self) -> str:
        """The bag's path."""
        return self.bag.place

    @property
    def names(self) -> tuple[str, ...]:
        """Topics with messages that can be decoded."""
        known = self.bag.types.keys() - self.bag.empty
        scenes = {topic for topic in known if SCENES.search(self.bag.types[topic])}
        return tuple(sorted(topic for topic in known - scenes if self.bag.knows(topic)))

    @property
    def latency(self) -> Latency:
        """Delays of scan and odometry, as far as the bag shows them."""
        return latency_of(self.bag)

    def table(self, name: str) -> TopicTable:
        """Reads a topic; of transforms those between the wanted frames."""
        if name not in self._read:
            messages: Sequence[Message] = self.bag.messages(name)
            if self.bag.types[name] == roles.TRANSFORMS:
                messages = of_one_body(self.bag, name, messages, *self.frames)
            place = f"{self.place}: topic {name!r}"
            names = tuple(dict.fromkeys(fields_of(messages[0].content)))
            table = TopicTable(
                place, name, messages, names, partial(self._stamps_of, name), self.notes
            )
            self._read[name] = table
        return self._read[name]

    def _stamps_of(self, topic: str, which: str) -> Stream:
        """Stamps a topic with all that are used: only together do they show their clocks."""
        topics = tuple(self.used) or (topic,)
        if (key := (which, *topics)) not in self._stamps:
            data = {}
            for each in topics:
                messages = self.table(each).messages
                receive, header = times_of(messages)
                rows = np.arange(len(messages), dtype=np.float64)[:, None]
                data[each] = TopicData(each, receive, header, rows)
            robot = [each for each, own in self.used.items() if own]
            self._stamps[key] = self._joined(data, STAMPS[which], robot)
        return self._stamps[key][topic]

    def _joined(
        self, data: dict[str, TopicData], stamps: roles.Stamps, robot: Sequence[str]
    ) -> dict[str, Stream]:
        """Stamps topics; by arrival if unasked-for headers are of no use."""
        try:
            return streams(data, stamps, self.place, robot)
        except RecordingError as error:
            if stamps != "auto":
                raise
            fault = str(error).removeprefix(f"{self.place}: ").partition(";")[0]
            self.notes.append(f"{fault}; all messages were stamped by their arrival.")
            return streams(data, "receive", self.place, robot)


def topics_used(mapping: Mapping[str, Any], topics: Sequence[str]) -> dict[str, bool]:
    """Returns the topics that a mapping names, and whether commands or the robot's sensors do."""
    found: dict[str, bool] = {}

    def walk(part: Any, own: bool) -> None:
        if isinstance(part, dict):
            for key, value in part.items():
                walk(value, own or key in ROBOT_STREAMS)
                walk(key, own)
        elif isinstance(part, (list, tuple)):
            for each in part:
                walk(each, own)
        elif isinstance(part, str):
            for topic in (each for each in (part, *_heads(part)) if each in topics):
                found[topic] = found.get(topic, False) or own

    walk(mapping, False)
    return found


def _heads(reference: str) -> Iterator[str]:
    """Yields what may be the topic of a reference."""
    for k, sign in enumerate(reference):
        if sign == ":":
            yield reference[:k]
            yield f"/{reference[:k]}"
    yield f"/{reference}"
