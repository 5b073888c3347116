"""Integrity check of an MCAP file: every byte is read, and all parts must agree.

MCAP readers follow the index at the end of the file: messages that a damaged index omits are lost
silently. Here the file is read from its first byte to its last (https://mcap.dev/spec); counts,
times and index must agree, and every checksum present must match.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from zlib import crc32

from mcap import records as kinds

from nics_drl_bridge.recording.mcap import (
    INSIDE,
    MAGIC,
    DamageError,
    McapSummary,
    Record,
    mapped,
    records,
    unpacked,
)


@dataclass
class _Walk:
    """Contents found while walking through a file.

    Attributes:
        data, summary: contents of the data section and of the summary.
        data_end: offset of the summary; 0 within the data.
        chunks, indexed: offset, length and time span of each chunk, by the data and the summary.
        places: time and offset in the last chunk of its messages, by channel.
    """

    data: McapSummary = field(default_factory=McapSummary)
    summary: McapSummary = field(default_factory=McapSummary)
    data_end: int = 0
    chunks: set[tuple[int, ...]] = field(default_factory=set)
    indexed: set[tuple[int, ...]] = field(default_factory=set)
    statistics: Record | None = None
    places: dict[int, list[tuple[int, int]]] = field(default_factory=dict)


def check_mcap(path: Path) -> None:
    """Checks a file from its first byte to its last.

    Raises:
        DamageError: it is truncated, a checksum is wrong, or two of its parts disagree.
    """
    if path.stat().st_size < len(MAGIC):
        raise DamageError(0, "the file is empty or ends at once")
    data, walk = mapped(path), _Walk()
    end = len(data) - len(MAGIC)
    if data[: len(MAGIC)] != MAGIC:
        raise DamageError(0, "it does not begin as an MCAP file")
    if end <= len(MAGIC) or data[end:] != MAGIC:
        raise DamageError(
            len(data), "it does not end as an MCAP file: it is cut off or was not closed"
        )
    for record in records(data[:end], len(MAGIC)):
        if record.offset == len(MAGIC) and not isinstance(record.content, kinds.Header):
            raise DamageError(record.offset, "the header is missing")
        if walk.data_end:
            _in_summary(walk, record)
        else:
            _in_data(walk, record, data)
    footer = record.content
    if not isinstance(footer, kinds.Footer) or record.end != end:
        raise DamageError(record.offset, "its end has no footer")
    summary = data[footer.summary_start : record.end - 4]
    if footer.summary_start and not walk.data_end <= footer.summary_start <= record.offset:
        raise DamageError(record.offset, "the footer points to no summary")
    if footer.summary_start and footer.summary_crc and crc32(summary) != footer.summary_crc:
        raise DamageError(record.offset, "the checksum of its summary is wrong")
    _agree(walk)


def _in_data(walk: _Walk, record: Record, data: memoryview) -> None:
    found = record.content
    if isinstance(found, INSIDE):
        walk.data.see(record)
    elif isinstance(found, kinds.Chunk):
        try:
            _in_chunk(walk, record)
        except DamageError as damage:
            raise DamageError(record.offset, damage.what) from None
    elif isinstance(found, kinds.MessageIndex):
        if sorted(found.records) != sorted(walk.places.pop(found.channel_id, [])):
            raise DamageError(record.offset, "the index of a chunk does not fit its messages")
    elif isinstance(found, kinds.DataEnd):
        if found.data_section_crc and crc32(data[: record.offset]) != found.data_section_crc:
            raise DamageError(record.offset, "the checksum of its data is wrong")
        walk.data_end = record.end
    elif isinstance(found, (kinds.Footer, kinds.ChunkIndex, kinds.Statistics)):
        raise DamageError(record.offset, "the summary begins before the data end")


def _in_chunk(walk: _Walk, record: Record) -> None:
    """Walks through a chunk and keeps its messages for the index records that follow it."""
    walk.places = {}
    times: list[int] = []
    for inner in records(unpacked(record)):
        if not isinstance(inner.content, INSIDE):
            kind = type(inner.content).__name__
            raise DamageError(record.offset, f"a chunk holds a record of kind {kind}")
        message = walk.data.see(inner)
        if message is not None:
            times.append(message.log_time)
            entries = walk.places.setdefault(message.channel_id, [])
            entries.append((message.log_time, inner.offset))
    span = record.content.message_start_time, record.content.message_end_time
    if times and (min(times), max(times)) != span:
        raise DamageError(record.offset, "a chunk's messages are not of the time that it names")
    walk.chunks.add((record.offset, record.end - record.offset, *span))


def _in_summary(walk: _Walk, record: Record) -> None:
    found = record.content
    if isinstance(found, (kinds.Chunk, kinds.Message)):
        raise DamageError(record.offset, "there are data behind their end")
    if isinstance(found, kinds.DataEnd):
        raise DamageError(record.offset, "its data end twice")
    if isinstance(found, (kinds.Schema, kinds.Channel)):
        walk.summary.see(record)
    elif isinstance(found, kinds.ChunkIndex):
        span = found.message_start_time, found.message_end_time
        walk.indexed.add((found.chunk_start_offset, found.chunk_length, *span))
    elif isinstance(found, kinds.Statistics):
        walk.statistics = record


def _agree(walk: _Walk) -> None:
    """Compares the summary, if there is one, with the data."""
    told, summary = walk.data, walk.summary
    for name in ("schemas", "channels"):
        ours, theirs = getattr(told, name), getattr(summary, name)
        if theirs and any(theirs.get(key) != value for key, value in ours.items()):
            raise DamageError(walk.data_end, f"the {name} of its summary are not those of its data")
    for channel in told.channels.values():
        if channel.schema_id and channel.schema_id not in told.schemas:
            raise DamageError(walk.data_end, f"the channel {channel.topic!r} has no schema")
    if walk.indexed and walk.indexed != walk.chunks:
        raise DamageError(walk.data_end, "the index of its chunks does not fit them")
    if walk.statistics is not None and not _fits(walk.statistics.content, walk):
        raise DamageError(walk.statistics.offset, "its statistics do not fit its messages")


def _fits(statistics: kinds.Statistics, walk: _Walk) -> bool:
    counts = Counter({key: n for key, n in statistics.channel_message_counts.items() if n})
    return (
        statistics.message_count == walk.data.counts.total()
        and (not counts or counts == walk.data.counts)
        and statistics.chunk_count in (0, len(walk.chunks))
        and walk.data.span in (None, (statistics.message_start_time, statistics.message_end_time))
    )
