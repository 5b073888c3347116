"""Takes what is intact out of a damaged MCAP file."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from mmap import mmap
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

from nics_drl_bridge.kinematics.mcap_records import (
    CHUNK,
    COMPRESSIONS,
    INSIDE,
    MAGIC,
    MESSAGE,
    PREFIX,
    STATISTICS,
    DamageError,
    Message,
    Record,
    Told,
    chunk_of,
    inner_records,
    mapped,
    records,
)

CHUNK_OP = bytes([CHUNK])


class Intact(NamedTuple):
    """What was found in a file.

    Attributes:
        told: its schemas and channels.
        messages: those that are intact.
        promised: messages of each channel, by the file's own statistics; empty where it has none.
    """

    told: Told
    messages: list[Message]
    promised: dict[int, int]


def intact(path: Path) -> Intact:
    """All messages that are intact.

    A chunk with a checksum counts as a whole; of one without, what comes before the damage. Behind
    a damage the file is searched for the next chunk.
    """
    if path.stat().st_size <= len(MAGIC):
        return Intact(Told(), [], {})
    data = mapped(path)
    told, promised, waiting = Told(), {}, []
    place: int | None = len(MAGIC)
    while place is not None and place < len(data):
        try:
            record = next(iter(records(data, place, len(data))))
            if record.op == CHUNK:
                waiting += _inside(record)
            elif record.op in INSIDE:
                waiting.append(record)
            elif record.op == STATISTICS:
                promised = _promised(record)
        except (DamageError, struct.error):
            waiting += _cut_chunk(data, place)
            place = _next_chunk(data, place + 1, len(data))
            continue
        # The length of a record that is no chunk may be the damage: it must not swallow one.
        swallowed = None if record.op == CHUNK else _next_chunk(data, place + 1, record.end)
        place = record.end if swallowed is None else swallowed
    return Intact(told, _messages(told, waiting), promised)


def _inside(record: Record) -> list[Record]:
    """The records of a chunk until its first damage."""
    chunk = chunk_of(record)
    return _until_damage(inner_records(record), chunk.start_ns, chunk.end_ns)


def _cut_chunk(data: memoryview, place: int) -> list[Record]:
    """The records of a chunk that the end of the file cuts off, or whose length is wrong."""
    start = place + PREFIX + 40
    if data[place] != CHUNK or start >= len(data):
        return []
    first, last, size, crc, letters = struct.unpack_from("<QQQII", data, place + PREFIX)
    if letters:
        return []  # compressed
    content = data[start : min(start + size, len(data))]
    if len(content) == size and crc and crc32(content) != crc:
        return []
    return _until_damage(records(content, 0, len(content)), first, last)


def _until_damage(inner: Iterator[Record], first_ns: int, last_ns: int) -> list[Record]:
    """Records in front of the first damage; messages only of the time that their chunk names."""
    found: list[Record] = []
    while True:
        try:
            each = next(inner, None)
        except DamageError:
            return found
        if each is None or each.op not in INSIDE:
            return found
        if each.op == MESSAGE and len(each.content) >= 14:
            (time_ns,) = struct.unpack_from("<Q", each.content, 6)
            if not first_ns <= time_ns <= last_ns:
                continue
        found.append(each)


def _messages(told: Told, waiting: list[Record]) -> list[Message]:
    """Messages, once all channels are known: that of the first may stand at the end alone."""
    messages = []
    for record in sorted(waiting, key=lambda each: each.op == MESSAGE):
        try:
            message = told.see(record)
        except (DamageError, struct.error):
            continue
        if message is not None:
            messages.append(message)
    return messages


def _promised(record: Record) -> dict[int, int]:
    (size,) = struct.unpack_from("<I", record.content, 42)
    return dict(struct.iter_unpack("<HQ", record.content[46 : 46 + size // 10 * 10]))


def _next_chunk(data: memoryview, start: int, end: int) -> int | None:
    """Where the next thing stands that is a chunk by all its lengths; None if there is none."""
    file = data.obj
    if not isinstance(file, mmap):
        return None
    place = file.find(CHUNK_OP, start, end)
    while place >= 0:
        if _looks_like_chunk(data, place):
            return place
        place = file.find(CHUNK_OP, place + 1, end)
    return None


def _looks_like_chunk(data: memoryview, place: int) -> bool:
    head = PREFIX + 32
    if place + head > len(data):
        return False
    (length,) = struct.unpack_from("<Q", data, place + 1)
    (letters,) = struct.unpack_from("<I", data, place + PREFIX + 28)
    if not 40 <= length <= len(data) - place - PREFIX or letters > 4:
        return False
    if bytes(data[place + head : place + head + letters]) not in map(str.encode, COMPRESSIONS):
        return False
    (packed,) = struct.unpack_from("<Q", data, place + head + letters)
    return bool(packed + letters + 40 == length)
