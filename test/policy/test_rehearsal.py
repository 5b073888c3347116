"""What a policy file costs is measured where it can do no harm, before it is opened here."""

from __future__ import annotations

import itertools
import subprocess
import sys

import numpy as np
import onnx
import pytest
from extras.foreign_policies import nets
from extras.foreign_policies.nets import write
from onnx import helper, numpy_helper

from nics_drl_bridge.errors import PolicyError
from nics_drl_bridge.policy.file import onnx_graph, rehearsal
from nics_drl_bridge.policy.file.policy_file import load_policy
from policy.policy_rig import bytes_of, export, signed

MOST_RSS = 1000 * 2**10  # of any process [kB]; without a limit it is 8.8 GB
MOST_S = 25.0  # of a processor; without a limit 31 s, of which most is swapped or refused here
MEASURE = """
import resource, sys, time
from pathlib import Path
from nics_drl_bridge.errors import PolicyError
from nics_drl_bridge.policy.file.policy_file import load_policy
begun = time.process_time()
for path in sys.argv[1:]:
    try:
        load_policy(path)
    except PolicyError as error:
        print(error.field, error.reason)
# ru_maxrss would count what the process that started this one holds.
status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
print(status["VmHWM"].split()[0])
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime + time.process_time() - begun)
"""


def doubled(proto, times: int, kind=np.float32):
    """Concatenations of a constant with itself, which nothing else of the graph uses."""
    proto.graph.initializer.append(numpy_helper.from_array(np.ones(1, kind), "c0"))
    for k in range(times):
        node = helper.make_node("Concat", [f"c{k}", f"c{k}"], [f"c{k + 1}"], axis=0)
        proto.graph.node.append(node)
    return proto


def wide(proto):
    """Sixteen observations fit into the memory, the 256 that may be run at once do not."""
    names = ["observation", *(f"d{k}" for k in range(15))]
    for a, b in itertools.pairwise(names):
        proto.graph.node.append(helper.make_node("Concat", [a, a], [b], axis=1))
    return proto


def crowded(proto):
    """Operators that are nothing but two bytes each."""
    nodes = b"\x0a\x00" * 1_000_000
    return proto.SerializeToString() + field(7, nodes)


def nested(proto):
    """Graphs in operators in graphs."""
    content = b""
    for _ in range(300):
        content = field(1, field(5, field(6, content)))
    return proto.SerializeToString() + field(7, content)


def field(number: int, content: bytes) -> bytes:
    """A message in a field, as protobuf writes it."""
    size = len(content)
    length = b""
    while size >= 0x80:
        length = length + bytes([size & 0x7F | 0x80])
        size = size >> 7
    return bytes([number << 3 | 2]) + length + bytes([size]) + content


BOMBS = {
    "doubled": lambda proto: bytes_of(signed(doubled(proto, 31))),
    "wide": lambda proto: bytes_of(signed(wide(proto))),
    "crowded": lambda proto: onnx_graph.add_seal(crowded(proto)),
    "nested": lambda proto: onnx_graph.add_seal(nested(proto)),
}


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "go.onnx"
    export(path)
    return path


@pytest.fixture
def forgetful(monkeypatch):
    """A process that has rehearsed nothing yet."""
    monkeypatch.setattr(rehearsal, "_remembered", {})


@pytest.mark.slow
@pytest.mark.process
def test_no_policy_takes_gigabytes_or_minutes_of_any_process(file):
    paths = []
    for name, spoil in BOMBS.items():
        paths.append(file.parent / f"{name}.onnx")
        paths[-1].write_bytes(spoil(onnx.load(file)))
    command = [sys.executable, "-c", MEASURE, *map(str, paths)]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=300, check=True
    )
    *sentences, own, childs, seconds = done.stdout.splitlines()
    assert len(sentences) == len(BOMBS), sentences
    assert "takes more than" in sentences[0]
    assert int(own) < MOST_RSS
    assert int(childs) < MOST_RSS
    assert float(seconds) < MOST_S


def test_a_network_of_somebody_else_takes_no_gigabytes(tmp_path, forgetful):
    mapping = write(tmp_path, "three")
    onnx.save(doubled(nets.three(), 31), tmp_path / "net.onnx")
    with pytest.raises(PolicyError, match=r"bad_alloc|takes more than"):
        load_policy(mapping)


def test_a_file_is_rehearsed_once_and_one_of_this_process_never(
    file, forgetful, monkeypatch
):
    asked = []
    answer = rehearsal._answer_of
    monkeypatch.setattr(
        rehearsal, "_answer_of", lambda one: asked.append(one) or answer(one)
    )
    for _ in range(3):
        load_policy(file)
    assert len(asked) == 1
    load_policy("differential")  # shipped, as the code is
    other = file.parent / "other.onnx"
    export(other, scan=12)
    load_policy(other)
    assert len(asked) == 1


def test_what_takes_too_long_or_ends_the_process_is_one_sentence(
    file, forgetful, monkeypatch
):
    for code, words in (
        ("import time; time.sleep(60)", "takes more than 0 s to open; not opened."),
        ("import os; os.abort()", "takes more than 512 MB of memory or 10 s to open"),
        ("raise SystemExit('no onnx here')", "failed (no onnx here); not opened."),
    ):
        monkeypatch.setattr(rehearsal, "_CODE", code)
        monkeypatch.setattr(rehearsal, "WALL_S", 0.2 if "sleep" in code else 60.0)
        with pytest.raises(PolicyError) as refused:
            load_policy(file)
        assert words in str(refused.value)
        assert "\n" not in str(refused.value)


def test_the_working_folder_holds_no_modules_for_a_rehearsal(
    file, forgetful, monkeypatch
):
    canary = file.parent / "canary"
    for name in ("json", "numpy", "onnx", "onnxruntime"):
        (file.parent / f"{name}.py").write_text(f"open({str(canary)!r}, 'w')\n")
    monkeypatch.chdir(file.parent)
    load_policy(file)
    assert not canary.exists()


def test_a_damaged_file_is_refused_before_anything_of_it_is_parsed(
    file, forgetful, monkeypatch
):
    data = bytearray(file.read_bytes())
    data[200] ^= 1
    file.write_bytes(bytes(data))
    monkeypatch.setattr(rehearsal, "_answer_of", lambda _: pytest.fail("it was opened"))
    with pytest.raises(PolicyError):
        load_policy(file)
