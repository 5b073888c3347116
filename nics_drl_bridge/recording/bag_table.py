"""Topics of a bag as tables: any numeric field of any message type."""

import json
import re
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import chain
from typing import Any

import numpy as np

from nics_drl_bridge.errors import RecordingError, suggest
from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.recording import mapping as mapped
from nics_drl_bridge.recording import topic_roles as roles
from nics_drl_bridge.recording.bag_file import BagFile, Message, read_times
from nics_drl_bridge.recording.messages import get_frames
from nics_drl_bridge.recording.recording import Stream
from nics_drl_bridge.recording.stamping import (
    ROBOT_STREAMS,
    SAME_CLOCK_S,
    TopicData,
    has_continuous_headers,
    stamp_streams,
)
from nics_drl_bridge.recording.table import Column, Source, Table
from nics_drl_bridge.robot.noise import Delay, Latency

SCAN = "sensor_msgs/msg/LaserScan"
FEWEST_MESSAGES = 20  # minimum number of messages that show a delay
PERCENTILES = (5.0, 50.0, 95.0)
SPANNED = 0.9  # fraction of a uniform distribution between the outer percentiles
LONGEST_ARRAY = 64  # elements of longer arrays are not listed
# Message types that are not read as columns of numbers
SCENES = re.compile(r"/(Compressed)?Image$|/PointCloud2?$|/LaserScan$")
# a name, or what is between brackets, which end the path or precede a dot or another bracket
STEPS = re.compile(r"([^.\[\]]+)|\[(.*?)\](?=[.\[]|$)")
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


def read_field(message: Any, path: str) -> Any:
    """Returns a field of a message; NaN where it lacks one.

    Brackets contain the number of an element, or its name if the message names them, even if the
    name is a number or has dots. Raises AttributeError for an unknown field.
    """
    owner = message
    field = ""
    for name, element in STEPS.findall(path):
        label = name or element
        if not isinstance(message, (list, tuple, np.ndarray)):
            owner = message
            field = label
            message = getattr(message, label)
            continue
        labels = getattr(owner, NAMES, None)
        k = int(label) if label.isdecimal() else -1
        if isinstance(labels, list) and label in labels and field != NAMES:
            k = labels.index(label)
        if not 0 <= k < len(message):
            return np.nan
        message = message[k]
    if hasattr(message, "nanosec"):
        return message.sec + message.nanosec * S_PER_NS
    return message


def make_message_table(place: str, messages: Sequence[Message], **other: Any) -> Table:
    """Makes a table of the fields of messages; `other` fields of the table may be given."""
    # Messages about joints may each hold other ones.
    kinds: dict[Any, Any] = {}
    for message in messages:
        content = message.content
        labels = getattr(content, NAMES, None)
        kind = None
        if isinstance(labels, list):
            arrays = (v for v in vars(content).values() if isinstance(v, np.ndarray))
            kind = (*labels, *map(len, arrays))
        kinds[kind] = content
    fields = chain.from_iterable(map(list_fields, kinds.values()))
    names = tuple(dict.fromkeys(fields))
    column = partial(read_column, place, names, messages)
    return Table(place, names, column, "message {}".format, **other)


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
        hint = f"choose one, such as {inner!r}."
    try:
        values = [read_field(message.content, path) for message in messages]
    except AttributeError:
        raise RecordingError(f"{place}: has no {path!r}; {hint}") from None
    if isinstance(values[0], str):
        return np.array(values, dtype=np.str_)
    try:
        column = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        column = np.zeros((0, 0))
    if column.ndim != 1:
        raise RecordingError(f"{place}: {path!r} is not a single number; {hint}")
    return column


class Bag(Source):
    """The topics of an open bag as tables; of transforms, only those between two frames."""

    def __init__(self, bag: BagFile) -> None:
        topics = [
            topic
            for topic, kind in sorted(bag.types.items())
            if topic not in bag.empty and not SCENES.search(kind)
        ]
        super().__init__(bag.place, [t for t in topics if bag.can_decode(t)])
        self.file = bag
        self._frames: tuple[str | None, str | None] = (None, None)
        # topics that are stamped together; True if they come from the robot's computer
        self._used: dict[str, bool] = {}
        self._messages: dict[str, Sequence[Message]] = {}
        self._notes: dict[str, list[str]] = {}  # by topic
        self._stamps: dict[tuple[str, ...], Stream] = {}

    def use(self, mapping: mapped.DriveMapping) -> None:
        """Stamps the topics of a mapping together."""
        self._frames = mapping.pose.frames
        self._used = list_topics_used(mapping, self.names)

    @property
    def latency(self) -> Latency:
        """Delays of scan and odometry, as far as the bag shows them."""
        types = self.file.types
        odometry = [
            topic
            for topic in self._used
            if types[topic] == roles.ODOMETRY
            and roles.guess_source_by_names((topic,), types[topic]) == "odometry"
        ]
        odom = _find_topic(self.file, roles.ODOMETRY, "odom")
        if len(odometry) == 1:
            odom = odometry[0]
        scan = _find_topic(self.file, SCAN, "scan")
        return Latency(
            scan=_measure_delay(self.file, scan), odom=_measure_delay(self.file, odom)
        )

    def read(self, name: str) -> Table:
        """Reads a topic."""
        messages = self._read_messages(name)
        return make_message_table(
            f"{self.place}: topic {name!r}",
            messages,
            notes=self._notes.setdefault(name, []),
            stamps=partial(self._stamp_rows, name),
            kind=self.file.types[name],
        )

    def add_note(self, topic: str, note: str) -> None:
        """Adds a sentence on a repair of a topic."""
        self._notes.setdefault(topic, []).append(note)

    def _read_messages(self, topic: str) -> Sequence[Message]:
        if topic not in self._messages:
            messages: Sequence[Message] = self.file.read_messages(topic)
            if self.file.types[topic] == roles.TRANSFORMS:
                messages = select_transforms(
                    f"{self.place}: topic {topic!r}", messages, *self._frames
                )
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
        # If other topics lack headers, headers are compared with the arrival, as by
        # default.
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
            self.add_note(topic, note)
            return stamp_streams(data, stamps, self.place, robot)[topic]


def list_topics_used(
    mapping: mapped.DriveMapping, topics: Sequence[str]
) -> dict[str, bool]:
    """Returns the topics that a mapping names, and whether `ROBOT_STREAMS` use them."""
    used: dict[str, bool] = {}
    parts = mapping.model_dump(by_alias=True, exclude={"robot"}, exclude_none=True)
    for key, part in parts.items():
        text = json.dumps(part, ensure_ascii=False)
        for topic in topics:
            name = re.escape(topic.removeprefix("/"))
            if re.search(f'"/?{name}[":]', text):
                used[topic] = used.get(topic, False) or key in ROBOT_STREAMS
    return used


def select_transforms(
    place: str, messages: Sequence[Message], frame: str | None, child: str | None
) -> list[Message]:
    """Returns the transforms between two frames, by default between the only two.

    Raises RecordingError if no pair of frames fits, or several do.
    """
    transforms: dict[tuple[str, str], list[Message]] = {}
    for message in messages:
        for transform in getattr(message.content, "transforms", (message.content,)):
            pair = get_frames(transform)
            part = Message(message.receive_ns, transform)
            transforms.setdefault(pair, []).append(part)
    wanted = [name and name.strip("/") for name in (frame, child)]
    pairs = [
        pair
        for pair in transforms
        if all(name in (None, own) for name, own in zip(wanted, pair, strict=True))
    ]
    if len(pairs) == 1:
        return transforms[pairs[0]]
    problem = "no transform"
    if pairs:
        problem = "several transforms"
    if frame or child:
        problem += " with the given names"
    frames = ", ".join(sorted(" -> ".join(pair) for pair in transforms)) or "none"
    raise RecordingError(
        f"{place} holds {problem}; write those of the robot into "
        "the topics file or the map, as in `frame: world` and `child_frame: "
        f"base_link`; it holds {frames}."
    )


def _find_topic(bag: BagFile, kind: str, name: str) -> str | None:
    """Returns the only topic of a type, or the only one of several with the usual name."""
    topics = [t for t, its in bag.types.items() if its == kind and t not in bag.empty]
    if len(topics) > 1:
        topics = [topic for topic in topics if re.search(rf"(^|/){name}$", topic)]
    return topics[0] if len(topics) == 1 else None


def _measure_delay(bag: BagFile, topic: str | None) -> Delay | None:
    if topic is None:
        return None
    messages = bag.read_messages(topic)
    receive_ns, stamps_ns = read_times(messages)
    if len(messages) < FEWEST_MESSAGES or stamps_ns is None or not stamps_ns.all():
        return None
    delay = (receive_ns - stamps_ns) * S_PER_NS
    if hasattr(messages[0].content, "ranges"):
        # A scan's stamp is the time of its first beam.
        for k, message in enumerate(messages):
            scan = message.content
            increment = max(0.0, float(scan.time_increment))
            delay[k] -= increment * max(len(scan.ranges) - 1, 0)
    low, middle, high = np.percentile(delay, PERCENTILES)
    if not SAME_CLOCK_S[0] <= middle <= SAME_CLOCK_S[1]:
        return None
    jitter = float(high - low) / SPANNED
    return Delay(least=max(0.0, float(middle) - jitter / 2.0), jitter=jitter)
