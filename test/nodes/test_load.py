"""What a vehicle's nodes take of a machine is measured beside a robot that nobody hears."""

import json
import math
import os
import subprocess
import sys

import pytest

from nics_drl_bridge.commands.doctor import doctor
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.nodes import load, processes
from nics_drl_bridge.nodes.load import read_memory_mb
from nics_drl_bridge.nodes.processes import unused_domain_id

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="needs Linux")
pytestmark = [pytest.mark.ros, pytest.mark.process, LINUX]
NODES = ["middleware_node", "policy_node", "command_gate"]
LATE_S = 0.03
SLOW = f"""
import time
from nics_drl_bridge.policy.policies import StraightToGoal
act = StraightToGoal.act
StraightToGoal.act = lambda self, seen: time.sleep({LATE_S}) or act(self, seen)
"""
HOLD = "held = bytearray(b'x') * 100_000_000\nprint(flush=True)\ninput()"
PARENT = f"""
import subprocess, sys
with subprocess.Popen([sys.executable, "-c", {HOLD!r}]) as child:
    child.wait()
"""


def test_each_node_is_measured_while_commands_of_a_slow_policy_go_to_the_robot(
    monkeypatch,
):
    slow_down_policy(monkeypatch)
    cores = os.sched_getaffinity(0)
    model = builtin_model("differential")
    ((measured,), _) = load.measure_load(model, "straight", 2.0, (1.0,), (10.0,))
    assert list(measured.cpu) == list(measured.memory_mb) == NODES
    assert all(0.0 < part < 1.0 for part in measured.cpu.values())
    assert all(30.0 < part < 1000.0 for part in measured.memory_mb.values())
    assert measured.scans == pytest.approx(20, abs=3)
    assert measured.answered > 0.5
    assert 1e3 * LATE_S < measured.policy.median_ms < measured.gate.median_ms
    assert os.sched_getaffinity(0) == cores


def slow_down_policy(monkeypatch):
    made = processes.make_module_command

    def make_slow(module):
        *words, code = made(module)
        path, _, run = code.partition("; from runpy")
        return [*words, f"{path}\n{SLOW}\nfrom runpy{run}"]

    monkeypatch.setattr(processes, "make_module_command", make_slow)


def test_the_doctor_prints_what_was_measured(monkeypatch, capsys):
    told = load.Load(
        0.25,
        20.0,
        100,
        0.5,
        dict(zip(NODES, (0.1, 0.2, 0.3), strict=True)),
        dict(zip(NODES, (100.0, 120.0, 90.0), strict=True)),
        load.Latency(5.25, 9.75),
        load.Latency(math.nan, math.nan),
    )
    denied = "/sys/fs/cgroup: Permission denied"
    monkeypatch.setattr(load, "measure_load", lambda *_, **__: ([told], denied))
    doctor(load=True)
    printed = capsys.readouterr().out
    for words in ("0.25", "50%", "10 + 20 + 30 = 60", "= 310", "5.2, 9.8", denied):
        assert words in printed
    doctor(load=True, as_json=True)
    (row,) = json.loads(capsys.readouterr().out)["loads"]
    assert row["policy"] == {"median_ms": 5.25, "p99_ms": 9.75}
    assert row["gate"]["p99_ms"] is None


def test_no_robot_hears_it(monkeypatch):
    """Whatever domain the robot is in."""
    for domain_id in range(1, 102):
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain_id))
        assert unused_domain_id() != domain_id


def test_the_memory_of_a_process_includes_that_of_its_children():
    with subprocess.Popen(
        [sys.executable, "-c", PARENT], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as parent:
        parent.stdout.readline()
        measured = read_memory_mb(parent.pid)
        parent.stdin.close()
    assert 100.0 < measured < 200.0
