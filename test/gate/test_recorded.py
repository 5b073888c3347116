from __future__ import annotations

import json

import numpy as np
import pytest
from numba import typeof

from gate.recorded import DRIVES, FILE, RECORDS, FaultyDrive
from nics_drl_bridge.gate import (
    evidence_kernels,
    ground_kernels,
    scan_motion,
    scan_motion_kernels,
    shield,
    shield_kernels,
)

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
CHECKED = {"car", "half blind"}  # together they have every fault
PASSING = {"scan_silent", "odom_silent", "command_silent", "sensor_silent"}
PASSING |= {"command_malformed", "scan_behind_unknown"}


def check_stop(drive, fault, stopped):
    """A fault stops the robot in time, and for good if it latches."""
    rule = STOPPING.get(fault)
    if rule is None:
        return
    assert stopped
    assert rule in {line.split(":")[0].split()[-1] for line in drive.lines}
    assert drive.state.armed == (rule in PASSING)
    latched = drive.state.latched
    assert (latched is None) if rule in PASSING else (latched.rule == rule)
    assert all(not each.twist.any() for each in drive.decisions if each.cause)


@pytest.mark.slow
@pytest.mark.parametrize("name", RECORDS)
def test_the_gate_decides_and_computes_what_it_did_before(name):
    """A change on purpose is recorded anew, see `recorded`."""
    kept = json.loads(FILE.read_text())[name]
    checked = {"check": check_stop} if name in CHECKED else {}
    for part, (lines, numbers) in enumerate(RECORDS[name](**checked)):
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
    drive.break_down("wild")
    assert called == rehearsed
    assert {name for name, _ in called} == {
        n for names in KERNELS.values() for n in names
    }
