from __future__ import annotations

import onnx
import pytest

from nics_drl_bridge.errors import PolicyError
from nics_drl_bridge.policy.onnx_graph import MOST_NESTED, MOST_PACKED, MOST_PARTS, check_wire
from nics_drl_bridge.policy.policy_file import load_policy, shipped

GRAPH, NODE, ATTRIBUTE, SUBGRAPH = 7, 1, 5, 6
"""Numbers of the fields of onnx.proto."""


def field(number: int, content: bytes) -> bytes:
    size, length = len(content), b""
    while size >= 0x80:
        length, size = length + bytes([size & 0x7F | 0x80]), size >> 7
    return bytes([number << 3 | 2]) + length + bytes([size]) + content


def many() -> bytes:
    return field(GRAPH, field(NODE, b"") * 3_000_000)


def deep() -> bytes:
    content = b""
    for _ in range(MOST_NESTED):
        content = field(NODE, field(ATTRIBUTE, field(SUBGRAPH, content)))
    return field(GRAPH, content)


def packed() -> bytes:
    return field(GRAPH, field(5, field(1, bytes(MOST_PACKED + 1))))


BAD = {
    "millions of operators": (many, f"more than {MOST_PARTS} parts"),
    "a graph in a graph in a graph": (deep, f"more than {MOST_NESTED} levels"),
    "a million sizes": (packed, "'dims'"),
    "a group": (lambda: b"\x0b\x0c", "no ONNX model"),
    "an endless number": (lambda: b"\x08" + b"\xff" * 11, "no ONNX model"),
    "cut off": (lambda: field(GRAPH, b"abc")[:-1], "cut off"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_grows_when_it_is_parsed_is_not_parsed(tmp_path, monkeypatch, name):
    make, words = BAD[name]
    path = tmp_path / "bad.onnx"
    path.write_bytes(make())
    monkeypatch.setattr(onnx, "load_model_from_string", lambda _: pytest.fail("it was parsed"))
    with pytest.raises(PolicyError, match=words) as refused:
        load_policy(path)
    assert refused.value.field == "file"


def test_policies_as_they_are_exported_have_few_parts():
    for path in shipped().glob("*.onnx"):
        check_wire(path.read_bytes())
