"""Each statement on a drive names the defect that was planted, and no other."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from identify import planted
from nics_drl_bridge.errors import BridgeError
from nics_drl_bridge.identify.identify import identify
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


def without_wheels(spec: RobotSpec) -> RobotSpec:
    """Returns the robot with two wheels if neither wheel is recorded."""
    return spec.model_copy(update={"state": ()})


def statements(recording: Recording, spec: RobotSpec) -> str:
    """Everything that is said of a drive."""
    try:
        found = identify(recording, spec, alpha="auto")
    except BridgeError as error:
        return str(error)
    told = [*conclude(found).lines, *found.notes, explain_uselessness(found)]
    return " ".join(" ".join([*told, format_report("here", found)]).split())


def blamed(text: str) -> set[str]:
    """Returns the causes that a text names."""
    return {cause for cause, pattern in CAUSES.items() if re.search(pattern, text)}


def same(drive: Recording) -> Recording:
    return drive


def without_state(defect: planted.Defect) -> planted.Defect:
    return lambda drive: replace(defect(drive), state=None)


# Defects that are found as another one is, and drives much like another.
ALIKE = {
    "x points backwards",
    "heading in degrees",
    "speed at a third",
    "both encoders backwards",
    "15 values",
    "a long drive",
    "rows twice",
}
ALIKE_WITHOUT_STATE = {"pose in feet", "speed in km/h", "turn to the other side"}


def some_of(cases: dict[str, Any], alike: Collection[str] = ALIKE) -> list[Any]:
    """The names of cases; those that resemble others run in the campaign."""
    return [
        pytest.param(name, marks=pytest.mark.campaign) if name in alike else name
        for name in cases
    ]


SOUND = set[str]()
MEASURED: dict[str, tuple[planted.Defect, set[str]]] = {
    "nothing": (same, SOUND),
    "heading counts clockwise": (
        planted.scaled_pose(heading=-1.0),
        {"an axis is reversed"},
    ),
    "x points backwards": (planted.scaled_pose(x=-1.0), {"an axis is reversed"}),
    "x and y exchanged": (planted.swapped_axes, {"an axis is reversed"}),
    "pose in millimetres": (planted.scaled_pose(x=1e3, y=1e3), {"a unit is wrong"}),
    "pose in feet": (planted.scaled_pose(x=3.28, y=3.28), {"a scale is wrong"}),
    "heading in degrees": (
        planted.scaled_pose(heading=180.0 / np.pi),
        {"a unit is wrong"},
    ),
    "turn in degrees": (
        planted.scaled_command(steering=180.0 / np.pi),
        {"a unit is wrong"},
    ),
    "speed at a third": (planted.scaled_command(speed=0.3), {"a scale is wrong"}),
    "turn to the other side": (
        planted.scaled_command(steering=-1.0),
        {"the turn has the wrong sign"},
    ),
    "speed backwards": (
        planted.scaled_command(speed=-1.0),
        {"the speed has the wrong sign"},
    ),
    "commands exchanged": (planted.swapped_commands, {"commands are swapped"}),
    "left encoder backwards": (
        planted.scaled_wheels(left=-1.0),
        {"an encoder counts backwards"},
    ),
    "both encoders backwards": (
        planted.scaled_wheels(left=-1.0, right=-1.0),
        {"an encoder counts backwards"},
    ),
    "pose frozen": (planted.frozen_pose, {"the pose is frozen"}),
    "a jump": (planted.jump(25.0, 2.0), {"the pose jumps"}),
    "a gap": (planted.gap(20.0, 26.0), {"the pose has a gap"}),
    "rows twice": (planted.duplicated_rows, {"rows are repeated"}),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", some_of(MEASURED))
def test_a_defect_is_named_and_no_other(name):
    defect, causes = MEASURED[name]
    text = statements(defect(planted.wheeled_drive()), planted.wheeled())
    assert blamed(text) == causes, text


COMMANDED: dict[str, tuple[planted.Defect, set[str]]] = {
    "nothing": (same, SOUND),
    "pose stamped too early": (planted.ahead(-0.5), {"another clock"}),
    "the pose's clock runs faster": (planted.drifting(0.01), {"the clocks drift"}),
    "pose in feet": (planted.scaled_pose(x=3.28, y=3.28), {"a scale is wrong"}),
    "speed in km/h": (planted.scaled_command(speed=3.6), {"a unit is wrong"}),
    "pose frozen": (planted.frozen_pose, {"the pose is frozen"}),
    "turn to the other side": (
        planted.scaled_command(steering=-1.0),
        {"the turn has the wrong sign"},
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", some_of(COMMANDED, ALIKE_WITHOUT_STATE))
def test_a_defect_is_named_where_only_commands_and_poses_are_known(name):
    defect, causes = COMMANDED[name]
    drive = without_state(defect)(planted.wheeled_drive())
    text = statements(drive, without_wheels(planted.wheeled()))
    assert blamed(text) == causes, text


DRIVES: dict[str, tuple[Callable[[], Recording], set[str]]] = {
    "15 values": (lambda: planted.wheeled_drive(levels=15), SOUND),
    "2 values": (lambda: planted.wheeled_drive(levels=2), {"two values"}),
    "a short drive": (
        lambda: planted.wheeled_drive(duration=12.0),
        {"the drive is too short"},
    ),
    "a long drive": (lambda: planted.wheeled_drive(duration=267.0), SOUND),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", some_of(DRIVES))
def test_a_drive_is_told_what_it_is(name):
    make, causes = DRIVES[name]
    text = statements(make(), planted.wheeled())
    assert blamed(text) == causes, text
