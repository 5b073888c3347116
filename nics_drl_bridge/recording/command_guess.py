"""Guesses which columns of a recording were sent to the robot, by names, units and types.

A column is taken for a command only if its name, or the name and type of its topic, says so. What
only may be one is listed as a candidate. Measurements are neither.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.recording import topic_roles
from nics_drl_bridge.recording.mapped import NEAR_DEG, SHORT_OF_EARTH
from nics_drl_bridge.recording.mapping import NO_COMMANDS
from nics_drl_bridge.recording.names import split_words, word_set
from nics_drl_bridge.recording.pose_guess import PoseGuess
from nics_drl_bridge.recording.survey import Survey, TableSurvey, split_unit
from nics_drl_bridge.robot.spec import find_kind, kind_names
from nics_drl_bridge.robot.template import list_names

# Words that say that something was sent to the robot: beyond doubt, and of a goal of a controller.
COMMANDING = word_set("cmd command commanded commands cmdvel ctrl control controls")
WISHING = word_set("""
    ref reference setpoint target desired des input inputs set u req request
    requested demand
""")
# Words that say that something was measured or computed from measurements.
MEASURING = word_set("""
    odom odometry imu measured measurement meas encoder enc feedback fb model
    actual act state states real true truth gt est groundtruth estimated
    estimate sensor sensors gyro gps gnss fix ekf vicon mocap vrpn optitrack pf
    filtered predicted pred joint core telemetry status current voltage battery
    temp temperature
""")
# Words of columns that no robot is driven by.
NEVER = word_set("""
    header stamp seq index id row frame time timestamp layout range ranges scan
    laser lidar beam beams intensity intensities depth image pixel sonar
    ultrasonic bumper cliff slam amcl orb lio loam cartographer rtabmap
    localization map pose position orientation quaternion quat pos translation
    rotation yaw heading roll pitch easting northing utm goal waypoint path acc
    accel acceleration jerk mag magnetic magnetometer gravity gear brake error
    err std stddev sigma var fps latency torque force status axes buttons level
    line
""")
NEVER_WORDS = NEVER | NO_COMMANDS
TICKS = word_set("tick ticks encoder enc encoders count counts")
WHEEL_WORDS = TICKS | word_set("wheel wheels rpm")
NO_SPEED = word_set("""
    pos position angle current force torque slip distance dist pressure load
    temp effort travel accel acc steer steering
""")
LEFT = word_set("left l lw wl vl le")
RIGHT = word_set("right r rw wr vr ri")
FRONT = word_set("front f")
REAR = word_set("rear back b")
CORNERS = {
    "front_left": {"fl", "lf"},
    "front_right": {"fr", "rf"},
    "rear_left": {"rl", "bl", "lr"},
    "rear_right": {"rr", "br"},
}
STEERING = word_set("steering steer delta servo")
THROTTLE = word_set("throttle gas accelerator pedal pwm duty")
TURNING = word_set("angular ang omega yawrate wz w turn rot rotational")
SPEED = word_set("speed velocity vel v vx linear lin forward trans cmdvel")
# Kinds of robots by the meaning of their commands, and their names for them; kinds that a file of
# its own describes have theirs in `words`.
WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
KINDS: tuple[tuple[str, dict[str, str]], ...] = (
    ("mecanum", {wheel: f"{wheel}_wheel" for wheel in WHEELS}),
    ("omnidirectional", {"speed": "vx", "side": "vy", "turn": "wz"}),
    ("ackermann_throttle", {"throttle": "throttle", "steering": "steering"}),
    ("ackermann", {"speed": "speed_command", "steering": "steering_command"}),
    ("differential", {"speed": "forward_command", "turn": "turn_command"}),
    ("differential_wheels", {"left": "left_wheel", "right": "right_wheel"}),
)
# Types of messages that are commands, those that may be, and those that hold measurements.
ACKERMANN_KINDS = (topic_roles.ACKERMANN, topic_roles.ACKERMANN_STAMPED)
TWIST_KINDS = (topic_roles.TWIST, topic_roles.TWIST_STAMPED)
STANDARD_PACKAGES = re.compile(
    r"^(nav|sensor|tf2|tf|rosgraph|diagnostic|visualization|action|actionlib|move_base|geometry"
    r"|rcl_interfaces|dynamic_reconfigure|map|stereo|shape|trajectory|bond|theora_image_transport"
    r"|gazebo|gps_common|geographic)(_msgs)?/"
)
ROUNDABOUT = word_set("raw mux nav navi teleop joy smoother unfiltered key")
BARE_TWIST = word_set("cmd vel")

CERTAIN = 3
LIKELY = 2
POSSIBLE = 1
MOST_CANDIDATES = 8


class Candidate(NamedTuple):
    """A column that was or may have been sent to the robot."""

    table: TableSurvey
    column: Survey
    meaning: str | None  # as `speed` or `front_left`; None: its name does not tell
    strength: int  # CERTAIN, LIKELY or POSSIBLE
    rank: int = 0  # among those of the same strength

    @property
    def is_still(self) -> bool:
        """True if it was zero throughout."""
        return self.column.low == self.column.high == 0.0


class CommandGuess(NamedTuple):
    """The kind of a robot and its commands, or what they may be."""

    kind: str | None  # None: nothing tells it
    commands: dict[str, Candidate]  # by the robot's names; empty if none is certain
    candidates: dict[
        str, Candidate
    ]  # by the robot's names, for the user to choose from
    # True: no command was recorded, the wheels' own motion stands in
    of_wheels: bool = False


def guess_command(
    tables: Sequence[TableSurvey], pose: PoseGuess | None
) -> CommandGuess:
    """Finds the columns that drive a robot of a known kind; else what may be its commands."""
    found = [each for table in tables for each in _find_candidates(table, tables, pose)]
    found = _accept_steering(found)
    certain = [each for each in found if each.strength >= LIKELY]
    kind, commands = _choose_kind(certain)
    if kind is not None:
        return CommandGuess(kind, commands, {})
    if not certain:
        kind, commands = _choose_kind(list(_find_wheels(tables)))
        if kind is not None:
            return CommandGuess(kind, commands, {}, of_wheels=True)
    found = found or [
        each for table in tables for each in _find_unexplained(table, pose)
    ]
    kind, candidates = _choose_kind(found)
    if kind is None:
        some = sorted(found, key=lambda each: -each.strength)[:MOST_CANDIDATES]
        candidates = {f"command_{k}": each for k, each in enumerate(some)}
    return CommandGuess(kind, {}, candidates)


def _find_candidates(
    table: TableSurvey, tables: Sequence[TableSurvey], pose: PoseGuess | None
) -> Iterator[Candidate]:
    """Yields the columns of a table that were or may have been sent to the robot."""
    if STANDARD_PACKAGES.match(table.kind) and table.kind not in TWIST_KINDS:
        return
    of_pose = pose is not None and pose.table is table
    # The name of a file tells what it holds only beside other files, and if the pose is elsewhere.
    if table.kind or (len(tables) > 1 and not of_pose):
        context = {*split_words(table.name)}
    else:
        context = set()
    if context & (NEVER_WORDS | MEASURING) and not context & COMMANDING:
        return
    taken = {*pose.columns} if pose is not None and of_pose else set()
    for column in table.numbers:
        if column.name in taken or column.name in table.stamp_columns:
            continue
        words = {*split_unit(column.name)[0]}
        if words == {"data"}:
            words = {*split_words(table.name)}
        if words & (NEVER_WORDS | MEASURING) or _is_place_on_earth(column):
            continue
        meaning = guess_meaning(
            words | (context & {"cmd", "vel"} if table.kind else set())
        )
        strength = _estimate_strength(table, words, context, meaning)
        known = meaning is not None or strength >= LIKELY
        if known and not (table.kind in TWIST_KINDS and meaning is None):
            yield Candidate(
                table, column, meaning, strength, _rank_topic(table, context)
            )


def _find_unexplained(
    table: TableSurvey, pose: PoseGuess | None
) -> Iterator[Candidate]:
    """Yields the columns of a table of no message whose names tell nothing, as in other languages.

    None of them was certainly sent to the robot, but none was certainly measured either.
    """
    beside = (
        {*split_words(table.name)}
        if pose is not None and pose.table is not table
        else set()
    )
    if table.kind or beside & (NEVER_WORDS | MEASURING):
        return
    taken = {*table.stamp_columns} | (
        {*pose.columns} if pose and pose.table is table else set()
    )
    for column in table.numbers:
        words = {*split_words(column.name)}
        told = bool(words & (NEVER_WORDS | MEASURING | WHEEL_WORDS | {"x", "y", "z"}))
        told = (
            told
            or column.name in taken
            or column.name.isdecimal()
            or _is_place_on_earth(column)
        )
        if not told and column.low < column.high:
            yield Candidate(table, column, None, POSSIBLE)


def _estimate_strength(
    table: TableSurvey, words: set[str], context: set[str], meaning: str | None
) -> int:
    if table.kind in ACKERMANN_KINDS:
        return CERTAIN if meaning is not None else POSSIBLE
    if (words | context) & COMMANDING:
        return CERTAIN
    if words & WISHING and meaning is not None:
        return LIKELY
    return LIKELY if meaning == "throttle" else POSSIBLE


def _rank_topic(table: TableSurvey, context: set[str]) -> int:
    """Returns how near to the robot a topic is: `cmd_vel` itself before what a mux gets."""
    if not table.kind:
        return 0
    if context & ROUNDABOUT:
        return -1
    return int(context <= BARE_TWIST)


def guess_meaning(words: set[str]) -> str | None:
    """Returns what a command with these words in its name means; None if they do not tell."""
    moves = words & {"velocity", "vel", "rate", "speed"}
    left = bool(words & LEFT)
    right = bool(words & RIGHT)
    for corner, short in CORNERS.items():
        ahead, side = corner.split("_")
        spoken = words & (FRONT if ahead == "front" else REAR)
        if words & short or (spoken and (left if side == "left" else right)):
            return corner
    if words & STEERING and not (left or right):
        return None if moves else "steering"
    if left != right:
        return "left" if left else "right"
    if left or words & {"motor", "arm", "gripper", "pan", "tilt", "head", "fan"}:
        return None
    if words & THROTTLE:
        return "throttle"
    if "traction" in words:
        return "traction"
    if (
        words & TURNING
        or {"yaw", "rate"} <= words
        or (words & {"theta", "th"} and moves)
    ):
        return None if words & {"x", "y", "linear"} else "turn"
    if "vy" in words or (words & SPEED and "y" in words):
        return "side"
    if words & SPEED and not words & {"z", "vz"}:
        return "speed"
    return None


def _accept_steering(found: Sequence[Candidate]) -> list[Candidate]:
    """Takes a plain `steering` for a command where a throttle is recorded beside it."""
    throttle = any(
        each.meaning == "throttle" and each.strength >= LIKELY for each in found
    )
    made = []
    for each in found:
        words = split_unit(each.column.name)[0]
        words = split_words(each.table.name) if words == ["data"] else words
        if throttle and words in (["steering"], ["steer"]):
            each = each._replace(strength=max(each.strength, LIKELY))
        made.append(each)
    return made


def _choose_kind(
    found: Sequence[Candidate],
) -> tuple[str | None, dict[str, Candidate]]:
    """Returns the kind of robot that these columns drive best, and its commands by its names."""
    own = [
        (name, kind.template.words)
        for name in kind_names()
        if (kind := find_kind(name))
    ]
    best: tuple[tuple[int, int, int], str, dict[str, Candidate]] | None = None
    for order, (kind, names) in enumerate((*own, *KINDS)):
        commands = _match_commands(names, found) if names else {}
        if not commands:
            continue
        still = sum(each.is_still for each in commands.values())
        if still == len(commands):
            continue
        strength = min(each.strength for each in commands.values())
        if best is None or (-strength, still, order) < best[0]:
            best = (-strength, still, order), kind, commands
    return (None, {}) if best is None else best[1:]


def _match_commands(
    names: Mapping[str, str], found: Sequence[Candidate]
) -> dict[str, Candidate]:
    """Finds a column for each of a kind's commands; none if one is missing or can't be told."""
    commands: dict[str, Candidate] = {}
    for meaning, name in names.items():
        fitting = [each for each in found if each.meaning == meaning]
        if not fitting:
            return {}
        most = max((not each.is_still, each.strength, each.rank) for each in fitting)
        best = [e for e in fitting if (not e.is_still, e.strength, e.rank) == most]
        if any(not _has_same_values(best[0], other) for other in best[1:]):
            return {}
        commands[name] = best[0]
    return commands


def _has_same_values(one: Candidate, other: Candidate) -> bool:
    values = [each.table.data[each.column.name] for each in (one, other)]
    return np.array_equal(values[0], values[1])


def _find_wheels(tables: Sequence[TableSurvey]) -> Iterator[Candidate]:
    """Yields the measured ticks or speeds of wheels, which stand in where no command was sent."""
    for table in tables:
        if STANDARD_PACKAGES.match(table.kind):
            continue
        for column in table.numbers:
            words, _ = split_unit(column.name)
            spoken = {*split_words(column.name)}
            if (
                not spoken & WHEEL_WORDS
                or spoken & NO_SPEED
                or column.low == column.high
            ):
                continue
            meaning = guess_meaning({*words} - TICKS - {"speed", "velocity", "vel"})
            if meaning in ("left", "right", *WHEELS):
                yield Candidate(
                    table, column, meaning, LIKELY, int(bool(spoken & TICKS))
                )


def _is_place_on_earth(column: Survey) -> bool:
    """True for `lat` or `lon` whose values stay within a degree, as those of a drive do."""
    if not {*split_words(column.name)} & SHORT_OF_EARTH:
        return False
    return column.high - column.low < NEAR_DEG <= max(abs(column.low), abs(column.high))


def find_look_alikes(kind: str) -> list[str]:
    """Returns the other kinds of robots that have the same commands."""
    found = []
    own = find_kind(kind)
    ways = [] if own is None else [{*list_names(way)} for way in own.template.commands]
    for name in kind_names():
        other = find_kind(name)
        if name == kind or other is None:
            continue
        if any({*list_names(way)} in ways for way in other.template.commands):
            found.append(name)
    return found
