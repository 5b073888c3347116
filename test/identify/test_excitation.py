from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nics_drl_bridge.identify.fit import (
    measure_coverage,
    split_independent_columns,
)
from nics_drl_bridge.recording.recording import Stream
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.robot.spec import load_robot

CAR = load_robot("ackermann")
DRIVE = record(CAR, np.random.default_rng(0), duration=60.0)


def with_commands(speed, steering):
    t = np.arange(len(speed)) * 0.1
    return replace(DRIVE, command=Stream(t, np.stack([speed, steering], axis=1)))


def test_what_never_moved_or_moved_together_is_named():
    wave = np.sin(np.arange(600) * 0.3)
    still, moved = measure_coverage(with_commands(np.full(600, 0.5), 0.4 * wave), CAR)
    assert still.line() == "speed_command: never moved"
    assert moved.fault == ""
    assert moved.share == pytest.approx(0.8, abs=0.01)
    both = measure_coverage(with_commands(0.5 + 0.5 * wave, 0.4 * wave), CAR)
    assert [each.fault for each in both] == ["moved only together with others"] * 2
    assert max(each.own for each in both) < 1e-6


def test_a_column_of_zeros_counts_as_a_copy():
    chi = np.random.default_rng(0).normal(size=(50, 3)) * [1.0, 0.0, 1.0]
    kept, copies = split_independent_columns(chi)
    assert kept.tolist() == [0, 2]
    assert copies.tolist() == [1]
