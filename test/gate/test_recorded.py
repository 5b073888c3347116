from __future__ import annotations

import json

import numpy as np
import pytest
from numba import typeof

from gate.recorded import DRIVES, FAULTS, FILE, RECORDS, FaultyDrive
from nics_drl_bridge.gate import (
    evidence_kernels,
    ground_kernels,
    scan_motion,
    scan_motion_kernels,
    shield,
    shield_kernels,
)


@pytest.mark.slow
@pytest.mark.parametrize("name", RECORDS)
def test_the_gate_decides_and_computes_what_it_did_before(name):
    """A change on purpose is recorded anew, see `recorded`."""
    kept = json.loads(FILE.read_text())[name]
    for part, (lines, numbers) in enumerate(RECORDS[name]()):
        assert lines == kept[part][0]
        for row, known in zip(numbers, kept[part][1], strict=True):
            np.testing.assert_allclose(row, known, rtol=1e-6, atol=1e-5)
    assert len(kept) == part + 1


KERNELS = {
    evidence_kernels: ("mark_entered", "mark_agreeing"),
    ground_kernels: (
        *("shift_cells", "forget_old", "mark_seen", "mark_covered", "find_unseen"),
    ),
    scan_motion_kernels: ("reduce_scan", "predict_scan", "compare_sectors"),
    shield_kernels: ("is_free", "fill_grid"),
}


def test_a_drive_calls_no_kernel_that_was_not_compiled_in_the_rehearsal(monkeypatch):
    called = set()

    def spy_on(kernel):
        def spy(*values):
            called.add((kernel.__name__, tuple(map(typeof, values))))
            return kernel(*values)

        return spy

    for module, names in KERNELS.items():
        for name in names:
            monkeypatch.setattr(module, name, spy_on(getattr(module, name)))
    drive = FaultyDrive(*DRIVES["half blind"])
    shield.warm_up()
    scan_motion.warm_up(drive.config)
    rehearsed = frozenset(called)
    drive.break_down("wild", 40)
    assert called == rehearsed
    assert {name for name, _ in called} == {
        n for names in KERNELS.values() for n in names
    }


STOPPING = {
    "scan": "scan_silent",
    "odom": "odom_silent",
    "e_stop": "e_stop_silent",
    "command": "command_silent",
    "rear": "sensor_silent",
    "pressed": "e_stop_pressed",
    "called": "e_stop_pressed",
    "held": "body_held",
    "stuck": "no_motion",
    "frozen": "scan_frozen",
    "ahead": "stamps_jumped",
    "back": "scan_silent",
    "lost": "estimate_lost",
    "uncertain": "estimate_lost",
    "leap": "odom_jumped",
    "wild": "command_malformed",
    "unknown": "scan_behind_unknown",
    "broken": "command_malformed",
    "two": "two_policies",
    "many": "two_policies",
}
PASSING = {"scan_silent", "odom_silent", "command_silent", "sensor_silent"}
PASSING |= {"command_malformed", "scan_behind_unknown"}
SLOW = {"body_held": 70, "no_motion": 70, "scan_frozen": 128}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_stops_the_robot_in_time_and_for_good_if_it_latches(fault):
    robot = "car" if fault == "frozen" else "half blind"
    drive = FaultyDrive(*DRIVES[robot])
    rule = STOPPING.get(fault, "")
    drive.run(32)  # it stands for as long as by default
    drive.break_down(fault, SLOW.get(rule, 32))
    if not rule:
        return
    assert rule in {line.split(":")[0].split()[-1] for line in drive.lines}
    assert not drive.decisions[-1].twist.any()
    drive.fault = "stopped"
    drive.run(32)
    assert drive.state.armed == (rule in PASSING)
    latched = drive.state.latched
    assert ("" if latched is None else latched.rule) == (
        "" if rule in PASSING else rule
    )
    assert all(not each.twist.any() for each in drive.decisions if each.cause)
