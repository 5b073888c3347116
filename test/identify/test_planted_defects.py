"""Each statement on a drive names the defect that was planted, and no other."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from identify import planted
from identify.drives import fit_trial
from nics_drl_bridge import generator
from nics_drl_bridge.errors import BridgeError
from nics_drl_bridge.identify.identify import Identified, refit_model
from nics_drl_bridge.identify.report import conclude, explain_uselessness, format_report
from nics_drl_bridge.recording.recording import Recording
from nics_drl_bridge.robot.spec import RobotSpec

CAUSES = {
    "an axis is reversed": "one of x, y and heading is reversed",
    "commands are swapped": "are swapped: each moves the robot like the other should",
    "a unit is wrong": "must be in|positions must be in|write `unit: ",
    "a scale is wrong": "the scale of this command, or that of the pose, is wrong",
    "an encoder counts backwards": "its encoder counts backwards",
    "the turn has the wrong sign": "The robot turns right where",
    "the speed has the wrong sign": "drives backwards where|faces backwards, or the speed",
    "another clock": "stamped by another clock",
    "the clocks drift": "drift apart",
    "the pose is frozen": "while the commands change",
    "a command is frozen": "[Nn]o command ever changed|no command changed|never (moved|changed)",
    "the pose jumps": "pose: jumps|its pose jumps",
    "the pose has a gap": "has a gap of|more gaps",
    "rows are repeated": "repeat the previous row",
    "two values": "only two values",
    "the drive is too short": "too short|too few|longer than these|record a longer drive",
    "nobody knows": "does not show why|record again|60 s or longer",
}
"""What statements blame, by what they say."""


def describe(recording: Recording, spec: RobotSpec) -> str:
    """Everything that is said of a drive."""
    try:
        return describe_fit(fit_trial(recording, spec, alpha="auto"))
    except BridgeError as error:
        return str(error)


def describe_fit(found: Identified) -> str:
    """Everything that is said of a fit."""
    told = [*conclude(found).lines, *found.notes, explain_uselessness(found)]
    return " ".join(" ".join([*told, format_report("here", found)]).split())


def find_causes(text: str) -> set[str]:
    """Returns the causes that a text names."""
    return {cause for cause, pattern in CAUSES.items() if re.search(pattern, text)}


DEFECTS: dict[str, tuple[planted.Defect, str]] = {
    "nothing": (lambda drive: drive, ""),
    "heading counts clockwise": (
        planted.scaled(pose=[1.0, 1.0, -1.0]),
        "an axis is reversed",
    ),
    "x and y exchanged": (planted.swapped_axes, "an axis is reversed"),
    "pose in millimetres": (planted.scaled(pose=[1e3, 1e3, 1.0]), "a unit is wrong"),
    "pose in feet": (planted.scaled(pose=[3.28, 3.28, 1.0]), "a scale is wrong"),
    "turn in degrees": (planted.scaled(command=[1.0, 57.3]), "a unit is wrong"),
    "turn to the other side": (
        planted.scaled(command=[1.0, -1.0]),
        "the turn has the wrong sign",
    ),
    "speed backwards": (
        planted.scaled(command=[-1.0, 1.0]),
        "the speed has the wrong sign",
    ),
    "commands exchanged": (planted.swapped_commands, "commands are swapped"),
    "left encoder backwards": (
        planted.scaled(state=[-1.0, 1.0]),
        "an encoder counts backwards",
    ),
    "pose frozen": (planted.frozen_pose, "the pose is frozen"),
    "a jump": (planted.jump(20.0, 2.0), "the pose jumps"),
    "a gap": (planted.gap(16.0, 22.0), "the pose has a gap"),
    "2 values": (lambda _: planted.wheeled_drive(two_values=True), "two values"),
    "12 s": (lambda _: planted.wheeled_drive(duration=12.0), "the drive is too short"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", DEFECTS)
def test_a_defect_is_named_and_no_other(name):
    defect, cause = DEFECTS[name]
    text = describe(defect(planted.wheeled_drive(duration=45.0)), planted.wheeled())
    assert find_causes(text) == {cause} - {""}, text


def without_wheels() -> RobotSpec:
    """The robot with two wheels, of which neither wheel is recorded."""
    return planted.wheeled().model_copy(update={"state": ()})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("defect", "cause"),
    [
        (planted.stamped(-0.5), "another clock"),
        (planted.stamped(0.0, 1.01), "the clocks drift"),
    ],
)
def test_a_clock_is_named_where_only_commands_and_poses_are_known(defect, cause):
    drive = replace(defect(planted.wheeled_drive()), state=None)
    text = describe(drive, without_wheels())
    assert find_causes(text) == {cause}, text


@pytest.fixture(scope="module")
def commanded() -> Identified:
    """A fit to a drive without a defect, of which only commands and poses are known."""
    recording = replace(planted.wheeled_drive(), state=None)
    return fit_trial(recording, without_wheels(), alpha="auto")


@pytest.mark.slow
def test_no_defect_is_named_where_there_is_none(commanded):
    text = describe_fit(commanded)
    assert not find_causes(text), text


@pytest.mark.slow
def test_a_model_that_loses_to_its_textbook_is_not_written_but_the_textbook(
    commanded, tmp_path, monkeypatch
):
    assert commanded.findings.replacement
    doubts = " ".join(conclude(commanded).doubts)
    assert "the model written is the textbook" in doubts
    (at,) = [at for at in commanded.judgement if at.horizon_s == 5.0]
    assert at.model.position_m < 0.03
    identified = "nics_drl_bridge.identify.identify.identify"
    monkeypatch.setattr(identified, lambda *_, **__: commanded)
    spec = without_wheels()
    model, _ = generator.generate(
        commanded.recording, spec, generator.mount_lidar(spec)
    )
    generator.save_model(model, tmp_path / "model")
    kinematics = generator.load_model(tmp_path / "model").kinematics
    assert kinematics.named.terms == commanded.model.named.terms
    pose, _ = kinematics.step(np.zeros(3), np.zeros(0), np.array([1.0, 0.0]))
    assert pose[0] == pytest.approx(kinematics.dt, rel=0.02)


@pytest.mark.slow
def test_the_textbook_is_fitted_no_further(commanded):
    assert refit_model(commanded.drive, commanded.findings) is commanded.findings
