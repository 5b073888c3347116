"""Guesses which columns of a recording were sent to the robot, by names, units and types.

A column counts as a command only if its name, or the name and type of its topic, says so. A column
that may be a command is listed as a candidate. Measurements are neither.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.recording import topic_roles
from nics_drl_bridge.recording.column_guess import Place
from nics_drl_bridge.recording.mapping import NO_COMMANDS
from nics_drl_bridge.recording.names import split_words, word_set
from nics_drl_bridge.recording.pose_guess import PoseGuess, list_used_columns
from nics_drl_bridge.recording.survey import Survey, TableSurvey, split_unit
from nics_drl_bridge.robot.spec import find_kind, list_kinds
from nics_drl_bridge.robot.template import list_names

# Words that show that something was sent to the robot: for certain, or as a controller's goal
COMMANDING = word_set("cmd command commanded commands cmdvel ctrl control controls")
WISHING = word_set("""
    ref reference setpoint target desired des input inputs set u req request
    requested demand vtarget
""")
# Words that show that something was measured or computed from measurements
MEASURING = word_set("""
    odom odometry imu measured measurement meas encoder enc feedback fb model
    actual act state states real true truth gt est groundtruth estimated
    estimate sensor sensors gyro gps gnss fix ekf vicon mocap vrpn optitrack pf
    filtered predicted pred joint core telemetry status current voltage battery
    temp temperature vins hector gmapping ins rtk
""")
# Words of columns that never drive a robot
NEVER = word_set("""
    header stamp seq index id row frame time timestamp layout range ranges scan
    laser lidar beam beams intensity intensities depth image pixel sonar
    ultrasonic bumper cliff distance dist proximity prox tof infrared ir lds
    obstacle obstacles person people pedestrian wind
    slam amcl orb lio loam cartographer rtabmap
    localization map pose position orientation quaternion quat pos translation
    rotation yaw heading roll pitch easting northing utm goal waypoint path acc
    accel acceleration jerk mag magnetic magnetometer gravity gear brake error
    err std stddev sd rms sigma var uncertainty confidence fps latency torque
    force load status axes buttons level line
""")
NOT_COMMANDED = NEVER | NO_COMMANDS | MEASURING
TICKS = word_set("tick ticks encoder enc encoders count counts")
WHEEL_WORDS = TICKS | word_set("wheel wheels rpm")
# Words that show what a column holds
EXPLAINED = NOT_COMMANDED | WHEEL_WORDS | word_set("x y z")
NO_SPEED = word_set("""
    pos position angle current force torque slip distance dist pressure load
    temp effort travel accel acc steer steering
""")
LEFT = word_set("left l lw wl vl le lwheel leftwheel")
RIGHT = word_set("right r rw wr vr ri rwheel rightwheel")
FRONT = word_set("front f")
REAR = word_set("rear back b")
CORNERS = (
    ("front_left", word_set("fl lf"), FRONT, LEFT),
    ("front_right", word_set("fr rf"), FRONT, RIGHT),
    ("rear_left", word_set("rl bl lr"), REAR, LEFT),
    ("rear_right", word_set("rr br"), REAR, RIGHT),
)
NO_VEHICLE = word_set("motor arm gripper pan tilt head fan")
STEERING = word_set("steering steer delta servo")
PULSES = word_set("pwm duty")  # what a motor driver is sent
THROTTLE = PULSES | word_set("throttle gas accelerator pedal")
TURNING = word_set("angular ang omega yawrate wz w turn rot rotational")
SPEED = word_set("speed velocity vel v vx linear lin forward trans cmdvel")
# Words that belong to a measurement, unless a command of turn rate or steering has them
ORIENTATIONS = word_set("yaw heading rotation")
RATES = word_set("rate speed velocity vel")
POSITIONS = word_set("position pos")
# Kinds of robots, with the names of their commands by meaning; the `words` of a template name those
# of other kinds.
WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
KINDS: tuple[tuple[str, dict[str, str]], ...] = (
    ("mecanum", {wheel: f"{wheel}_wheel" for wheel in WHEELS}),
    ("omnidirectional", {"speed": "vx", "side": "vy", "turn": "wz"}),
    ("ackermann_throttle", {"throttle": "throttle", "steering": "steering"}),
    ("ackermann", {"speed": "speed_command", "steering": "steering_command"}),
    ("differential", {"speed": "forward_command", "turn": "turn_command"}),
    ("differential_wheels", {"left": "left_wheel", "right": "right_wheel"}),
)
# Message types that are commands, types that may be commands, and packages of measurements
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


@dataclass(frozen=True)
class Candidate(Place):
    """A column that was or may have been sent to the robot."""

    meaning: str | None  # such as `speed` or `front_left`; None if it is unclear
    strength: int  # CERTAIN, LIKELY or POSSIBLE
    rank: int = 0  # among those of the same strength

    @property
    def is_still(self) -> bool:
        """True if it was zero throughout."""
        return self.column.low == self.column.high == 0.0

    @property
    def merit(self) -> tuple[bool, int, int]:
        """Key that ranks columns of the same meaning."""
        return not self.is_still, self.strength, self.rank


class CommandGuess(NamedTuple):
    """The kind of a robot with its commands or candidates for them."""

    kind: str | None  # None if nothing shows it
    commands: dict[str, Candidate]  # by the robot's names; empty if none is certain
    # by the robot's names, for the user to choose from
    candidates: dict[str, Candidate]
    # True if no command is certain and the motion of the wheels stands in for it
    of_wheels: bool = False

    @property
    def listed(self) -> dict[str, Candidate]:
        """The commands, or the candidates if there are no commands."""
        return self.commands or self.candidates


def guess_command(
    tables: Sequence[TableSurvey], pose: PoseGuess | None
) -> CommandGuess:
    """Finds the columns that drive a robot of a known kind, or candidates for its commands."""
    candidates: list[Candidate] = []
    for table in tables:
        candidates += _find_candidates(table, len(tables) > 1, pose)
    candidates = _accept_steering(candidates)
    certain = [column for column in candidates if column.strength >= LIKELY]
    kind, commands = _choose_kind(certain)
    if kind is not None:
        return CommandGuess(kind, commands, {})
    if not certain:
        kind, commands = _choose_kind(list(_find_wheels(tables)))
        if kind is not None:
            wheels = [wheel.key for wheel in commands.values()]
            others = [column for column in candidates if column.key not in wheels]
            named = _choose_kind(others)[1]
            return CommandGuess(kind, commands, named, of_wheels=True)
    if not candidates:
        for table in tables:
            candidates += _find_unexplained(table, len(tables) > 1, pose)
    kind, named = _choose_kind(candidates)
    if kind is None:
        strongest = sorted(candidates, key=lambda column: -column.strength)
        named = {
            f"command_{k}": candidate
            for k, candidate in enumerate(strongest[:MOST_CANDIDATES])
        }
    return CommandGuess(kind, {}, named)


def _find_candidates(
    table: TableSurvey, has_others: bool, pose: PoseGuess | None
) -> Iterator[Candidate]:
    """Yields the columns of a table that were or may have been sent to the robot."""
    if STANDARD_PACKAGES.match(table.kind) and table.kind not in TWIST_KINDS:
        return
    has_pose = pose is not None and pose.table is table
    # A file's name shows what it holds only if there are others and the pose is in one of them.
    context: set[str] = set()
    if table.kind or (has_others and not has_pose):
        context = {*split_words(table.name)}
    if context & NOT_COMMANDED and not context & COMMANDING:
        return
    context_of_topic: set[str] = set()
    if table.kind:
        context_of_topic = context & BARE_TWIST
    used = list_used_columns(table, pose)
    for column in table.numbers:
        words = {*table.list_words(column.name)}
        if (words | context) & (COMMANDING | WISHING):
            words = _name_commanded(words)
        if column.name in used or words & NOT_COMMANDED or column.is_place_on_earth:
            continue
        meaning = guess_meaning(words | context_of_topic)
        strength = _estimate_strength(table, words, context, meaning)
        if meaning is None and (strength < LIKELY or table.kind in TWIST_KINDS):
            continue
        yield Candidate(table, column, meaning, strength, _rank_topic(table, context))


def _name_commanded(words: set[str]) -> set[str]:
    """Returns the words of a command: `yaw rate` as `yawrate`, `servo position` as `servo`."""
    if words & ORIENTATIONS and words & RATES:
        return words - ORIENTATIONS - RATES | {"yawrate"}
    if words & STEERING:
        return words - POSITIONS
    return words


def _find_unexplained(
    table: TableSurvey, has_others: bool, pose: PoseGuess | None
) -> Iterator[Candidate]:
    """Yields the columns without a name, or with an unknown one, as in other languages.

    Each may have been sent to the robot, or measured.
    """
    if STANDARD_PACKAGES.match(table.kind):
        return
    pose_is_elsewhere = pose is not None and pose.table is not table
    has_place = bool(table.kind) or pose_is_elsewhere
    if has_place and has_others and NOT_COMMANDED.intersection(split_words(table.name)):
        return
    used = list_used_columns(table, pose)
    for column in table.numbers:
        says_something = not EXPLAINED.isdisjoint(split_words(column.name))
        if says_something or column.name in used or _counts_rows(table, column):
            continue
        if column.low < column.high and not column.is_place_on_earth:
            yield Candidate(table, column, None, POSSIBLE)


def _counts_rows(table: TableSurvey, column: Survey) -> bool:
    """True for a column without a name that numbers the rows."""
    steps = np.diff(table.get_numbers(column.name))
    return column.name.isdecimal() and bool((steps == 1.0).all())


def _estimate_strength(
    table: TableSurvey, words: set[str], context: set[str], meaning: str | None
) -> int:
    if table.kind in ACKERMANN_KINDS and meaning is None:
        return POSSIBLE
    if table.kind in ACKERMANN_KINDS or (words | context) & COMMANDING:
        return CERTAIN
    if meaning == "throttle" or (words & (WISHING | PULSES) and meaning is not None):
        return LIKELY
    return POSSIBLE


def _rank_topic(table: TableSurvey, context: set[str]) -> int:
    """Ranks a topic by its distance to the robot: `cmd_vel` itself before the inputs of a mux."""
    if not table.kind:
        return 0
    if context & ROUNDABOUT and "output" not in context:
        return -1
    return int(context <= BARE_TWIST)


def guess_meaning(words: set[str]) -> str | None:
    """Returns the meaning of a command with these words in its name; None if it is unclear."""
    is_speed = bool(words & {"velocity", "vel", "rate", "speed"})
    is_left = bool(words & LEFT)
    is_right = bool(words & RIGHT)
    for corner, short, lengthwise, sideways in CORNERS:
        if words & short or (words & lengthwise and words & sideways):
            return corner
    if words & STEERING and not (is_left or is_right):
        if is_speed:
            return None
        return "steering"
    if is_left and is_right:
        return None
    if is_left:
        return "left"
    if is_right:
        return "right"
    if words & NO_VEHICLE:
        return None
    if words & THROTTLE:
        return "throttle"
    if "traction" in words:
        return "traction"
    is_angle = bool(words & {"theta", "th"})
    if words & TURNING or {"yaw", "rate"} <= words or (is_angle and is_speed):
        if words & {"x", "y", "linear"}:
            return None
        return "turn"
    if "vy" in words or (words & SPEED and "y" in words):
        return "side"
    if words & SPEED and not words & {"z", "vz"}:
        return "speed"
    return None


def _accept_steering(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Counts a plain `steering` as a command if a throttle was also recorded."""
    has_throttle = any(
        candidate.meaning == "throttle" and candidate.strength >= LIKELY
        for candidate in candidates
    )
    accepted = []
    for candidate in candidates:
        words = candidate.table.list_words(candidate.column.name)
        if has_throttle and words in (["steering"], ["steer"]):
            strength = max(candidate.strength, LIKELY)
            candidate = replace(candidate, strength=strength)
        accepted.append(candidate)
    return accepted


def _choose_kind(
    candidates: Sequence[Candidate],
) -> tuple[str | None, dict[str, Candidate]]:
    """Returns the kind of robot that these columns drive best, and its commands by name."""
    kinds: list[tuple[str, Mapping[str, str]]] = []
    for name in list_kinds():
        kind = find_kind(name)
        if kind is not None:
            kinds.append((name, kind.template.words))
    best: tuple[str | None, dict[str, Candidate]] = (None, {})
    best_merit: tuple[int, int] | None = None
    for name, words in (*kinds, *KINDS):
        commands = _match_commands(words, candidates)
        still = sum(command.is_still for command in commands.values())
        if still == len(commands):
            continue
        strength = min(command.strength for command in commands.values())
        if best_merit is None or (strength, -still) > best_merit:
            best_merit = strength, -still
            best = name, commands
    return best


def _match_commands(
    names: Mapping[str, str], candidates: Sequence[Candidate]
) -> dict[str, Candidate]:
    """Finds a column for each of a kind's commands; none if one is missing or ambiguous."""
    commands: dict[str, Candidate] = {}
    for meaning, name in names.items():
        fitting = [column for column in candidates if column.meaning == meaning]
        if not fitting:
            return {}
        best = max(fitting, key=lambda column: column.merit)
        for rival in fitting:
            is_equal = np.array_equal(best.values, rival.values)
            if rival.merit == best.merit and not is_equal:
                return {}
        commands[name] = best
    return commands


def _find_wheels(tables: Sequence[TableSurvey]) -> Iterator[Candidate]:
    """Yields the measured ticks or speeds of wheels, which stand in for missing commands."""
    for table in tables:
        if STANDARD_PACKAGES.match(table.kind):
            continue
        for column in table.numbers:
            words = {*split_words(column.name)}
            is_wheel = words & WHEEL_WORDS and not words & NO_SPEED
            if not is_wheel or column.low == column.high:
                continue
            words_of_side = {*split_unit(column.name)[0]} - TICKS
            meaning = guess_meaning(words_of_side - {"speed", "velocity", "vel"})
            if meaning in ("left", "right", *WHEELS):
                rank = int(bool(words & TICKS))
                yield Candidate(table, column, meaning, LIKELY, rank)


def find_look_alikes(name: str) -> list[str]:
    """Returns the other kinds of robots that have the same commands."""
    kind = find_kind(name)
    if kind is None:
        return []
    commands = [{*list_names(names)} for names in kind.template.commands]
    look_alikes = []
    for other_name in list_kinds():
        other = find_kind(other_name)
        if other_name == name or other is None:
            continue
        if any({*list_names(names)} in commands for names in other.template.commands):
            look_alikes.append(other_name)
    return look_alikes
