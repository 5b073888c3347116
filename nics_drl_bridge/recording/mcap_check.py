"""Integrity check of an MCAP file."""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from zlib import crc32

from nics_drl_bridge.recording.mcap import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    FOOTER_BYTES,
    HEADER,
    INSIDE,
    MAGIC,
    MESSAGE_INDEX,
    PREFIX,
    SCHEMA,
    STATISTICS,
    DamageError,
    McapSummary,
    Record,
    chunk_of,
    inner_records,
    mapped,
    message_index_of,
    records,
)


@dataclass
class _Walk:
    """Contents found while walking through a file."""

    data: McapSummary = field(default_factory=McapSummary)
    summary: McapSummary = field(default_factory=McapSummary)
    chunks: dict[tuple[int, int], tuple[int, int]] = field(default_factory=dict)
    indexed: list[tuple[int, int, int, int]] = field(default_factory=list)
    statistics: Record | None = None
    places: dict[int, list[tuple[int, int]]] = field(default_factory=dict)


def check_mcap(path: Path) -> None:
    """Checks a file from its first byte to its last.

    Raises:
        DamageError: it is truncated, a checksum is wrong, or two of its parts disagree.
    """
    if path.stat().st_size < len(MAGIC):
        raise DamageError(0, "the file is empty or ends at once")
    try:
        _check(mapped(path))
    except struct.error:
        raise DamageError(0, "a record is shorter than its fields") from None


def _check(data: memoryview) -> None:
    if data[: len(MAGIC)] != MAGIC:
        raise DamageError(0, "it does not begin as an MCAP file")
    end = len(data) - len(MAGIC)
    if end <= len(MAGIC) or data[end:] != MAGIC:
        raise DamageError(
            len(data), "it does not end as an MCAP file: it is cut off or was not closed"
        )
    walk, section = _Walk(), 0
    for record in records(data, len(MAGIC), end):
        if record.offset == len(MAGIC) and record.op != HEADER:
            raise DamageError(record.offset, "the header is missing")
        if record.op == DATA_END:
            if section:
                raise DamageError(record.offset, "its data end twice")
            section = record.end
            (crc,) = struct.unpack_from("<I", record.content)
            if crc and crc32(data[: record.offset]) != crc:
                raise DamageError(record.offset, "the checksum of its data is wrong")
        elif section:
            _summary(walk, record)
        else:
            _data(walk, record)
    _footer(data, end, section)
    _agree(walk, section)


def _data(walk: _Walk, record: Record) -> None:
    if record.op in INSIDE:
        walk.data.see(record)
    elif record.op == CHUNK:
        try:
            _chunk(walk, record)
        except DamageError as damage:
            raise DamageError(record.offset, damage.what) from None
    elif record.op == MESSAGE_INDEX:
        channel, entries = message_index_of(record)
        if sorted(entries) != sorted(walk.places.pop(channel, [])):
            raise DamageError(record.offset, "the index of a chunk does not fit its messages")
    elif record.op in (FOOTER, CHUNK_INDEX, STATISTICS):
        raise DamageError(record.offset, "the summary begins before the data end")


def _chunk(walk: _Walk, record: Record) -> None:
    """Walks through a chunk and keeps its messages for the index records that follow it."""
    chunk, inside = chunk_of(record), McapSummary(walk.data.schemas, walk.data.channels)
    walk.places = {}
    for inner in inner_records(record):
        message = inside.see(inner)
        if message is not None:
            entries = walk.places.setdefault(message.channel, [])
            entries.append((message.time_ns, inner.offset))
    if inside.span is not None:
        if inside.span != (chunk.start_ns, chunk.end_ns):
            raise DamageError(record.offset, "a chunk's messages are not of the time that it names")
        first, last = walk.data.span or inside.span
        walk.data.span = min(first, inside.span[0]), max(last, inside.span[1])
    walk.data.counts.update(inside.counts)
    walk.chunks[record.offset, record.end - record.offset] = chunk.start_ns, chunk.end_ns


def _summary(walk: _Walk, record: Record) -> None:
    if record.op in (SCHEMA, CHANNEL):
        walk.summary.see(record)
    elif record.op == CHUNK_INDEX:
        start, end, offset, length = struct.unpack_from("<QQQQ", record.content)
        walk.indexed.append((offset, length, start, end))
    elif record.op == STATISTICS:
        walk.statistics = record
    elif record.op in (CHUNK, *INSIDE):
        raise DamageError(record.offset, "there are data behind their end")


def _footer(data: memoryview, end: int, section: int) -> None:
    place = end - FOOTER_BYTES
    if not section or struct.unpack_from("<BQ", data, place) != (FOOTER, 20):
        raise DamageError(place, "its end has no footer")
    summary, _, crc = struct.unpack_from("<QQI", data, place + PREFIX)
    if summary and not section <= summary <= place:
        raise DamageError(place, "the footer points to no summary")
    if summary and crc and crc32(data[summary : end - 4]) != crc:
        raise DamageError(place, "the checksum of its summary is wrong")


def _agree(walk: _Walk, place: int) -> None:
    """Compares the summary, if there is one, with the data."""
    told, summary = walk.data, walk.summary
    for name, ours, theirs in (
        ("schemas", told.schemas, summary.schemas),
        ("channels", told.channels, summary.channels),
    ):
        if theirs and any(theirs.get(key) != value for key, value in ours.items()):
            raise DamageError(place, f"the {name} of its summary are not those of its data")
    for channel in told.channels.values():
        if channel.schema and channel.schema not in told.schemas:
            raise DamageError(place, f"the channel {channel.topic!r} has no schema")
    if walk.indexed:
        wanted = {(at, size, *span) for (at, size), span in walk.chunks.items()}
        if set(walk.indexed) != wanted:
            raise DamageError(place, "the index of its chunks does not fit them")
    if walk.statistics is not None:
        _statistics(walk, walk.statistics)


def _statistics(walk: _Walk, record: Record) -> None:
    total, _, _, _, _, chunks, first, last, size = struct.unpack_from("<QHIIIIQQI", record.content)
    pairs = struct.iter_unpack("<HQ", record.content[46 : 46 + size // 10 * 10])
    counts = Counter({channel: count for channel, count in pairs if count})
    fits = (
        total == walk.data.counts.total()
        and (not counts or counts == walk.data.counts)
        and chunks in (0, len(walk.chunks))
        and walk.data.span in (None, (first, last))
    )
    if not fits:
        raise DamageError(record.offset, "its statistics do not fit its messages")
