from __future__ import annotations

import multiprocessing
import os
import signal
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from nics_drl_bridge.nodes import faulty_robot, gate_faults
from nics_drl_bridge.nodes.faulty_robot import Robot

pytestmark = pytest.mark.ros


def test_the_base_ends_with_the_process_that_started_it(monkeypatch):
    base = Mock()
    base.spin.side_effect = [None, None]  # not more often
    parent = Mock()
    parent.is_alive.side_effect = [True, True, False]
    monkeypatch.setattr(multiprocessing, "parent_process", lambda: parent)
    monkeypatch.setattr(faulty_robot, "SpunNode", lambda *_: base)
    faulty_robot.hear(None, Mock())
    for call in base.spin.call_args_list:
        assert call.kwargs["timeout_s"] <= 1.0


def test_a_command_that_a_frozen_gate_had_written_before_does_not_count(monkeypatch):
    """The middleware may send it when the gate goes on."""
    ear, base = multiprocessing.Pipe(duplex=False)
    robot = Robot.__new__(Robot)
    robot.repair()
    robot.heard = []
    robot._ear = ear
    robot.spin = Mock()
    clock = SimpleNamespace(time_ns=lambda: 500)
    monkeypatch.setattr(gate_faults, "time", clock)
    monkeypatch.setattr(gate_faults, "FROZEN_S", 0.0)
    told = []
    monkeypatch.setattr(os, "kill", lambda _, number: told.append(number))
    gate_faults._freeze_gate(gate_faults.Around(robot, None, Mock()))
    assert told == [signal.SIGSTOP, signal.SIGCONT]
    base.send((1.0, np.array([0.5, 0.0, 0.0]), 499))
    base.send((1.1, np.zeros(3), 501))
    assert robot.until(lambda: robot.heard, 1.0)
    assert [when for when, _ in robot.heard] == [1.1]
