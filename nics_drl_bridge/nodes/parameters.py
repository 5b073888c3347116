"""Parameters of every node, for `declare` and `--help`; needs no ROS 2.

The parameters themselves stand in `parameters.yaml`.
"""

import math
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from nics_drl_bridge import defaults
from nics_drl_bridge.config import parse_yaml, read_text
from nics_drl_bridge.errors import ConfigError, shorten
from nics_drl_bridge.nodes.transport import is_before_kilted
from nics_drl_bridge.robot import DEFAULT_ROBOT

FILE = Path(__file__).with_suffix(".yaml")
REALTIME = "realtime"
LOCKSTEP = "lockstep"
MODES = (REALTIME, LOCKSTEP, "as_fast_as_possible")
NO_POSE = defaults.POSE_TYPE
STAMPED = "enable_stamped_cmd_vel"
IMU = "imu"
BASE_FRAME = "base_frame"
MAP_FRAME = "map_frame"
GREATEST_FLEET = 256
GREATEST_SEED = 2**63 - 1
NAMESPACE = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")
FRAME = re.compile(r"[^\s/]\S{0,254}")
MAY_BE_EMPTY = ("footprint_frame",)


class Row(NamedTuple):
    """A parameter; the default determines its type."""

    name: str
    default: Any
    about: str
    span: tuple[float, float] | None = None  # valid range of a number
    fixed: bool = True  # read once, at startup
    shown: str = ""  # the default in words, if it depends on other values


def is_stamped_default() -> bool:
    """True if this ROS 2 distribution uses TwistStamped for commands: Kilted and newer."""
    return not is_before_kilted(os.environ.get("ROS_DISTRO", ""))


@cache
def read_parameters() -> dict[str, Any]:
    """Return the groups of parameters by their names, and `nodes`."""
    return parse_yaml(read_text(FILE), str(FILE))


def list_rows(*groups: str, **known: Any) -> list[Row]:
    """Return the parameters of groups; `known` are defaults that the file leaves open."""
    known = {
        "model": DEFAULT_ROBOT,
        "robot": DEFAULT_ROBOT,
        "world": defaults.WORLD,
        "renderer": defaults.RENDERER,
        "laser_frame": "",
        "pose_type": defaults.POSE_TYPE,
        IMU: defaults.IMU_TOPIC,
        STAMPED: is_stamped_default(),
        "command_timeout": defaults.COMMAND_SILENCE_S,
        "odom_timeout": defaults.DATA_SILENCE_S,
        "bound": defaults.DRIVE_BOUND_M,
        "duration": defaults.DRIVE_S,
        **known,
    }
    rows = []
    for group in groups:
        for name, entry in read_parameters()[group].items():
            row = Row(**{"name": name, "default": known.get(name), **entry})
            rows.append(row._replace(shown=row.shown.format(default=row.default)))
    return rows


def find_frame_fault(parameters: Iterable[Any], *may_be_empty: str) -> str:
    """Return a sentence about the first invalid frame id; empty if all are valid.

    If a name occurs twice, its last value counts.
    """
    frames = {
        parameter.name: str(parameter.value)
        for parameter in parameters
        if parameter.name.endswith("_frame")
    }
    for name, frame in frames.items():
        if not FRAME.fullmatch(frame) and (
            frame or name not in (*MAY_BE_EMPTY, *may_be_empty)
        ):
            return (
                f"parameter {name!r}: must be 1 to 255 characters, without blanks or a leading /, "
                f"not {shorten(frame, 80)!r}."
            )
    base = frames.get(BASE_FRAME, "")
    for name in (MAP_FRAME, "odom_frame"):
        if base and frames.get(name, "") == base:
            return f"parameter {BASE_FRAME!r}: is {base!r}, like {name!r}; they must differ."
    return ""


def list_checker_rows(group: str, names: Sequence[str]) -> list[Row]:
    """Return the parameters of Nav2's goal or progress checkers (the group) of some names."""
    return [
        row._replace(name=f"{name}.{row.name}")
        for name in names
        for row in list_rows(group)
    ]


def name_fleet(robots: Any) -> tuple[str, ...]:
    """Return the namespaces of robots, given as a count or as names; one alone has none.

    Raises ConfigError.
    """
    if type(robots) is int and 1 <= robots <= GREATEST_FLEET:
        return ("",) if robots == 1 else tuple(f"robot{k + 1}" for k in range(robots))
    is_list = isinstance(robots, Sequence) and not isinstance(robots, str)
    names = tuple(robots) if is_list else ()
    valid = all(isinstance(name, str) and NAMESPACE.fullmatch(name) for name in names)
    if not valid or not len(names) == len(set(names)) in range(1, GREATEST_FLEET + 1):
        raise ConfigError(
            f"'robots' is {robots!r}; give a count from 1 to {GREATEST_FLEET}, or a list of "
            "different namespaces, as in [robot1, robot2]."
        )
    return names


def list_gate_rules(**known: float) -> list[Row]:
    """Return the parameters of a gate's rules, which set fields of `GateConfig`.

    Fields whose names end in `_s` are called by the rest of their names.
    """
    from nics_drl_bridge.gate.state import GateConfig

    rules = {each.name.removesuffix("_s"): each.default for each in fields(GateConfig)}
    return list_rows("rules", **{**rules, "odom_rate": math.nan, **known})


def list_drive_rows() -> list[Row]:
    """Return the parameters of `record_node`."""
    from nics_drl_bridge.recording import excite

    spans = {
        "bound": (0.0, excite.WIDEST_M),
        "duration": (excite.MIN_DRIVE_S, excite.LONGEST_S),
        "speed": (excite.SLOWEST, 1.0),
        "seed": (0, GREATEST_SEED),
    }
    rows = list_rows("drive", "stamped")
    return [row._replace(span=spans.get(row.name, row.span)) for row in rows]


class NodeFacts(NamedTuple):
    """What a user needs to know about a node."""

    about: str
    subscribes: Sequence[str]
    publishes: Sequence[str]
    services: Sequence[str]
    parameters: Sequence[Row]
    example: str  # after `--ros-args`


def list_nodes() -> list[str]:
    """Return the names of all executables of nodes."""
    return list(read_parameters()["nodes"])


def describe_node(name: str) -> NodeFacts:
    """Return what a user needs to know about a node, by the name of its executable."""
    facts = dict(read_parameters()["nodes"][name])
    groups = facts.pop("groups")
    known = {}
    if name == "mujoco_node":
        known["renderer"] = defaults.MUJOCO_RENDERER
    rows = list_rows(*groups, **known)
    if name == "command_gate":
        rows += list_gate_rules()
    if name == "record_node":
        rows = list_drive_rows()
    if name == "policy_node":
        rows += list_checker_rows("goal_checker", ["general_goal_checker"])
        rows += list_checker_rows("progress_checker", ["progress_checker"])
    return NodeFacts(parameters=rows, **facts)
