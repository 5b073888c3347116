"""Faults around processes of gate and policy, as `nics assure` injects them."""

from __future__ import annotations

import math
import os
import signal
import time
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from gate.assurance.samples import PROTOCOL

from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.nodes import conversions, gate_faults
from nics_drl_bridge.nodes.faulty_robot import Robot
from nics_drl_bridge.nodes.gate_faults import (
    CONTROLS,
    FAULTS,
    Fault,
    Setup,
    find_reach,
    inject_all,
    inject_trials,
)
from nics_drl_bridge.robot.spec import load_robot

pytestmark = pytest.mark.ros
TWO = replace(PROTOCOL, faults=2, fault_kinds=tuple(FAULTS), fault_controls=CONTROLS)


def inject(tmp_path, *trials):
    lines = []
    rows = list(inject_trials(TWO, tmp_path, lines.append, list(trials)))
    assert len(rows) == len(trials), lines
    return rows


@pytest.mark.process
@pytest.mark.slow
def test_a_gate_stops_a_robot_whose_policy_dies_in_time_and_without_it_nothing_does(
    tmp_path,
):
    (killed, *_), (silent, *_) = (
        replace(TWO, fault_kinds=(kind,)).list_faults()
        for kind in ("policy_killed", "scan_silent")
    )
    kept, control = inject(tmp_path, killed, silent._replace(gated=False))
    assert kept["in_time"]
    assert kept["time_s"] <= kept["limit_s"] == 0.4
    assert kept["unsafe"] == 0
    assert (tmp_path / "policy_killed" / str(killed.seed) / "policy_node.log").exists()
    assert not control["in_time"]
    assert control["unsafe"] > 0


@pytest.mark.parametrize("textbook", ["ackermann", "tricycle"])
def test_what_a_car_may_be_told_by_turn_rate_is_within_reach(textbook):
    car = load_robot(textbook).model_copy(update={"angular_is": "turn_rate"})
    limits = load_limits(textbook, car)
    low, high = find_reach(car, limits)
    shares = np.random.default_rng(0).uniform(size=(100, 2))
    told = car.to_cmd_vel(limits.low + shares * (limits.high - limits.low))
    assert ((low <= told) & (told <= high)).all()
    assert low[2] == -high[2] < 0.0


class Process(AbstractContextManager):
    """A process that a fault can end."""

    pid = os.getpid()

    def __init__(self, node, folder, parameters, domain_id):
        self.ended = False
        self.folder = folder
        self.log = Path(os.devnull)

    def poll(self):
        return 1 if self.ended else None

    def check(self):
        if self.ended:
            raise BackendError("ended")

    def close(self):
        self.ended = True

    def __exit__(self, *_):
        self.close()


class StandIn:
    """A robot that is told to stop as soon as it is broken."""

    def __init__(self, failing=()):
        self.failing = list(failing)
        self.heard = []

    def drive(self, patience_s, phase_s):
        if self.failing:
            raise self.failing.pop()

    def until(self, done, seconds):
        self.heard = [(time.monotonic(), np.zeros(3))]

    def close(self):
        pass


@pytest.fixture
def injected(monkeypatch):
    """Injects with stand-ins: results, lines that were told, and processes."""

    def run(inject, robot, numbers):
        lines, processes = [], []

        def start(*words):
            processes.append(Process(*words))
            return processes[-1]

        monkeypatch.setattr(gate_faults, "NodeProcess", start)
        monkeypatch.setattr(gate_faults, "Robot", lambda *_, **__: robot)
        monkeypatch.setitem(FAULTS, "ours", Fault(0.4, inject))
        setup = Setup("differential", "differential", Path("logs"), np.zeros(3))
        results = list(inject_all(setup, "ours", numbers, lines.append))
        return results, lines, processes

    return run


def test_a_fault_that_ends_the_gate_has_failed_and_another_gate_is_started(injected):
    def end_gate(around):
        around.processes["command_gate"].ended = True

    results, lines, processes = injected(end_gate, StandIn(), range(2))
    assert [one.time_s for one in results] == [math.inf] * 2
    assert len(processes) == 2
    assert "the gate has ended" in lines[0]
    folders = [str(process.folder) for process in processes]
    assert folders == ["logs/0", "logs/1"]  # so that no log is lost


def test_a_gate_without_an_answer_is_asked_again_and_not_for_ever(injected):
    once = StandIn([TimeoutError("no answer")])
    results, lines, _ = injected(lambda around: None, once, [0])
    assert results[0].time_s < 0.4
    assert "no answer" in lines[0]
    never = StandIn([TimeoutError("no answer")] * 3)
    assert injected(lambda around: None, never, [0])[0] == []


def test_a_fault_that_the_gate_does_not_answer_is_judged_by_what_is_heard(injected):
    def ask(around):
        raise TimeoutError

    results, _, _ = injected(ask, StandIn(), [0])
    assert results[0].time_s < 0.4


def test_the_controls_are_faults_that_are_injected():
    assert set(CONTROLS) <= FAULTS.keys()


def test_a_command_that_a_frozen_gate_had_written_before_does_not_count(monkeypatch):
    """The middleware may send it when the gate goes on."""
    robot = Robot.__new__(Robot)
    robot.repair()
    robot.heard = []
    robot.until = Mock()
    clock = SimpleNamespace(time_ns=lambda: 500)
    monkeypatch.setattr(gate_faults, "time", clock)
    monkeypatch.setattr(gate_faults, "FROZEN_S", 0.0)
    told = []
    monkeypatch.setattr(os, "kill", lambda _, number: told.append(number))
    gate_faults._freeze_gate(
        SimpleNamespace(robot=robot, processes={"command_gate": Mock()})
    )
    assert told == [signal.SIGSTOP, signal.SIGCONT]
    robot._hear(conversions.twist_to_ros([0.5, 0.0, 0.0]), {"source_timestamp": 499})
    robot._hear(conversions.twist_to_ros(np.zeros(3)), {"source_timestamp": 501})
    ((_, twist),) = robot.heard
    assert not twist.any()
