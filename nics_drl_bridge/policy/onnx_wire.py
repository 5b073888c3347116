"""A policy file's bytes, counted before they are parsed.

Two bytes of a file can become a message of some hundred bytes in memory, and one byte a number of
eight. So the parts of the file are counted as they lie there, and only a file of few is parsed.
"""

from __future__ import annotations

from typing import Any

import onnx

MOST_PARTS = 50_000
"""Fields of all messages of a file; the weights of a network are one part each."""
MOST_NESTED = 16
"""Messages within messages; an exported graph needs six."""
MOST_PACKED = 2**20
"""Bytes of whole numbers in one part, such as the sizes of an array; weights are no such part."""
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_LONGEST_VARINT = 10


class WireError(ValueError):
    """No message, or one that is too large once parsed; the text says which."""


def check_wire(data: bytes) -> None:
    """Makes sure that the bytes of a ModelProto are few messages.

    Raises:
        WireError: they are no message, or hold more parts or deeper ones than allowed.
    """
    view, parts = memoryview(data), 0
    ahead: list[tuple[int, int, Any, int]] = [(0, len(data), onnx.ModelProto.DESCRIPTOR, 1)]
    while ahead:
        start, end, kind, depth = ahead.pop()
        if depth > MOST_NESTED:
            raise WireError(f"is nested more than {MOST_NESTED} levels deep")
        while start < end:
            parts += 1
            if parts > MOST_PARTS:
                raise WireError(f"has more than {MOST_PARTS} parts")
            key, start = _varint(view, start, end)
            begin, start = _extent(view, start, end, key & 7)
            field = kind.fields_by_number.get(key >> 3)
            if field is None or key & 7 != _BYTES:
                continue
            if field.message_type is not None:
                ahead.append((begin, start, field.message_type, depth + 1))
            elif _is_packed_number(field) and start - begin > MOST_PACKED:
                raise WireError(f"has {start - begin} bytes of {field.name!r}, not weights")


def _is_packed_number(field: Any) -> bool:
    """Whether numbers of variable length lie in a field, which grow when they are parsed."""
    growing = (
        field.TYPE_INT64, field.TYPE_UINT64, field.TYPE_INT32, field.TYPE_UINT32, field.TYPE_ENUM,
    )  # fmt: skip
    return field.type in growing


def _extent(view: memoryview, start: int, end: int, wire: int) -> tuple[int, int]:
    """Where the content of a field begins and ends."""
    if wire == _VARINT:
        return start, _varint(view, start, end)[1]
    if wire == _BYTES:
        size, start = _varint(view, start, end)
    elif wire in (_FIXED64, _FIXED32):
        size = 8 if wire == _FIXED64 else 4
    else:
        raise WireError("is no ONNX model")
    if start + size > end:
        raise WireError("is cut off")
    return start, start + size


def _varint(view: memoryview, start: int, end: int) -> tuple[int, int]:
    value = 0
    for k in range(_LONGEST_VARINT):
        if start + k >= end:
            break
        value |= (view[start + k] & 0x7F) << (7 * k)
        if view[start + k] < 0x80:
            return value, start + k + 1
    raise WireError("is no ONNX model, or is cut off")
