"""Guesses what the columns of a recording are, by their names, units and types.

A column counts as a command only if its name, or the name and type of its topic, says so.
A column that may be a command is listed as a candidate. A measurement is neither,
but measured wheel motion may replace missing commands.
The guesses serve only the draft of a mapping: opening a recording never guesses.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording import topic_roles
from nics_drl_bridge.recording.imu_axis import AXES, UpAxis, find_table_axis
from nics_drl_bridge.recording.mapping import NO_COMMANDS, UNITS, word_set
from nics_drl_bridge.recording.survey import TICKS, Field, TableSurvey, split_unit
from nics_drl_bridge.recording.table import Column, is_text
from nics_drl_bridge.recording.values import match_values
from nics_drl_bridge.robot.spec import find_kind, list_kinds
from nics_drl_bridge.robot.template import Template, list_names

# Words of the first coordinate, with the matching word of the second
COORDINATES = {
    "x": "y",
    "px": "py",
    "tx": "ty",
    "posx": "posy",
    "easting": "northing",
    "east": "north",
}
GLOBE = {"longitude": "latitude", "lon": "lat", "lng": "lat", "long": "lat"}
ALL_COORDINATES = COORDINATES | GLOBE
HEADINGS = [
    "yaw",
    "heading",
    "theta",
    "psi",
    "th",
    "hdg",
    "orientation",
    "angle",
    "phi",
]
# Words of columns with positions of something else, motions, sensor data or deviations
OTHERS = word_set("""
    goal target waypoint waypoints ref reference setpoint desired initialpose
    marker markers obstacle obstacles landmark landmarks person people leg
    detection detections tag plan path cmd command
""")
NOT_PLACES = OTHERS | word_set("""
    linear angular twist velocity vel acc accel acceleration speed rate gyro mag
    magnetic magnetometer gravity force torque jerk steer steering wheel joy
    axes user pixel image camera laser scan lidar range beam info map error err
    std stddev sigma var variance cov covariance
""")
TURNS = word_set("q quat quaternion rotation orientation")
# Words for the source of a pose: trackers rank before localisers, localisers before odometry.
TRACKERS = word_set("vicon mocap vrpn optitrack qualisys gt truth groundtruth tracker")
LOCALISERS = word_set("pose amcl pf slam cartographer rtabmap filtered fused ekf")
SENSORS = word_set("odom odometry imu gyro measured encoder wheel feedback model")
SOURCES = TRACKERS | LOCALISERS | SENSORS | {"ground"}
# Message types with positions of something else, or of a goal
OTHER_PLACES = re.compile(
    r"^(visualization|actionlib|action|move_base|map)_msgs/"
    r"|/(Path|OccupancyGrid|MapMetaData|PoseArray|GridCells|Imu|Joy|LaserScan|MagneticField)$"
)
NEARLY_A_TURN = 5.5  # minimum change between two rows where an angle wraps [rad]
ELEMENT = re.compile(r"\[\d+\]")


ENABLING = word_set("""
    safety enable enabled armed active activated auto autonomous autonomy
    deadman engaged engage
""")
DISABLING = word_set("estop emergency kill stop stopped disabled manual fault")
POWER = word_set("on power powered")
POWERED = word_set("motor motors drive drives")
ON_WORDS = word_set("auto autonomous autonomy enabled on armed active offboard run")
MODES = ENABLING | word_set("mode state status safety switch")
EPISODES = word_set("episode ep trial traj trajectory rollout run")
MIN_MEAN_EPISODE_ROWS = 20  # minimum number of rows of an episode, on average
OF_MESSAGE = "angular_velocity.z"  # a field of sensor_msgs/Imu
NAMES_OF_YAW_RATE = """
    gyro z
    gz
    gyroz
    gyro yaw
    yaw rate
    yawrate
    w
    wz
    omega
    angular z
    z rate
"""
TURNING_OF_IMU = [word_set(line) for line in NAMES_OF_YAW_RATE.strip().splitlines()]
NOT_OF_GYRO = word_set("""
    cmd command commanded ref setpoint target desired covariance
    odom odometry vicon mocap gt truth
""")
USUAL_NAMES = ("/imu", "/imu/data")  # topics; the first one in the bag is chosen
FASTEST_RADPS = 20.0  # faster rates are in degrees per second


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
WHEEL_WORDS = TICKS | word_set("wheel wheels rpm")
# Words that show the content of a column
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
WHEELS = tuple(corner for corner, *_ in CORNERS)
NO_VEHICLE = word_set("motor arm gripper pan tilt head fan")
STEERING = word_set("steering steer delta servo")
PULSES = word_set("pwm duty")  # what a motor driver is sent
THROTTLE = PULSES | word_set("throttle gas accelerator pedal")
TURNS_OF_BODY = word_set("angular ang omega yawrate wz w turn rot rotational")
SPEED = word_set("speed velocity vel v vx linear lin forward trans cmdvel")
# Words that belong to a measurement, unless a command of turn rate or steering has them
ORIENTATIONS = word_set("yaw heading rotation")
RATES = word_set("rate speed velocity vel")
POSITIONS = word_set("position pos")
FORMS_OF_TURN = (
    (TURNS_OF_BODY,),
    (word_set("yaw"), word_set("rate")),
    (word_set("theta th"), RATES),
)
# A command's meaning by its name, with a word from each of these sets; the first row counts
MEANINGS: tuple[tuple[str | None, tuple[frozenset[str], ...]], ...] = (
    *((corner, (short,)) for corner, short, _, _ in CORNERS),
    *((corner, (along, across)) for corner, _, along, across in CORNERS),
    (None, (LEFT, RIGHT)),
    ("left", (LEFT,)),
    ("right", (RIGHT,)),
    (None, (STEERING, RATES)),
    ("steering", (STEERING,)),
    (None, (NO_VEHICLE,)),
    ("throttle", (THROTTLE,)),
    ("traction", (word_set("traction"),)),
    *((None, (*form, word_set("x y linear"))) for form in FORMS_OF_TURN),
    *(("turn", form) for form in FORMS_OF_TURN),
    ("side", (word_set("vy"),)),
    ("side", (SPEED, word_set("y"))),
    (None, (SPEED, word_set("z vz"))),
    ("speed", (SPEED,)),
)
# Kinds of robots, with the names of their commands by meaning; the `words` of a template name those
# of other kinds.
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


class PoseGuess(NamedTuple):
    """Columns of a pose."""

    x: Field
    y: Field
    orientation: tuple[Field, ...]  # a heading, or x, y, z, w of a quaternion

    @property
    def table(self) -> TableSurvey:
        """Its table."""
        return self.x.table

    @property
    def columns(self) -> tuple[Field, ...]:
        """All columns that it uses."""
        return (self.x, self.y, *self.orientation)


def is_used(column: Field, pose: PoseGuess | None) -> bool:
    """True for a column of stamps or of the pose."""
    is_stamp = column.name in column.table.stamp_columns
    return is_stamp or (pose is not None and column in pose.columns)


def guess_pose(tables: Sequence[TableSurvey]) -> PoseGuess | None:
    """Finds x, y and heading or quaternion by their names."""
    poses: list[PoseGuess] = []
    for table in tables:
        # With several tables, their names show their content.
        if table.is_single or not table.words & OTHERS:
            poses += _find_named_poses(table)
    return max(poses, key=_rank_pose, default=None)


def _rank_pose(pose: PoseGuess) -> float:
    """Ranks a pose by what its names say about its source."""
    words = pose.x.name_words
    # A column's name that states its source outweighs the file's name.
    if pose.table.kind or not words & SOURCES:
        words |= pose.table.words
    rank = 0.5 * len(pose.orientation[1:])
    if words & TRACKERS or {"ground", "truth"} <= words:
        rank += 9.0
    elif words & LOCALISERS:
        rank += 6.0
    if words & SENSORS:
        rank -= 6.0
    return rank - 3.0 * pose.table.kind.endswith("/TFMessage")


def _find_named_poses(table: TableSurvey) -> Iterator[PoseGuess]:
    """Yields the poses whose names show x, y and heading."""
    if OTHER_PLACES.search(table.kind):
        return
    columns: dict[tuple[str, ...], Field] = {}
    for column in table.numbers:
        if not ELEMENT.search(column.name):
            columns.setdefault(tuple(split_unit(column.name)[0]), column)
    for words, x in columns.items():
        if {*words} & (NOT_PLACES | TURNS):
            continue
        for first, second in ALL_COORDINATES.items():
            y = columns.get(tuple(second if w == first else w for w in words))
            kinds = ["m"] + ["rad"] * (first in GLOBE)
            if first not in words or y is None or not _is_in(x, kinds):
                continue
            orientation = _find_orientation(words, columns)
            if orientation and (x.moves or y.moves):
                yield PoseGuess(x, y, orientation)


def _is_in(column: Field, kinds: Sequence[str]) -> bool:
    """True if a name has no unit, or a unit of one of these kinds."""
    return column.unit is None or UNITS[column.unit].si in kinds


def _find_orientation(
    place: tuple[str, ...], columns: Mapping[tuple[str, ...], Field]
) -> tuple[Field, ...]:
    """Returns the quaternion, else the heading, that shares the most words with a place."""
    found: list[tuple[bool, float, tuple[Field, ...]]] = []
    for words, column in columns.items():
        if not words or {*words} & (SENSORS - {*place}):
            continue  # from another source than the place
        *first, last = words
        shared = len({*words} & {*place})
        if last in ("w", "qw"):
            axes = [(*first, last[:-1] + axis) for axis in "xyzw"]
            if all(axis in columns for axis in axes) and axes[0] != place:
                found.append((True, shared, tuple(columns[axis] for axis in axes)))
        elif last in HEADINGS and not {*words} & NOT_PLACES and _is_in(column, ["rad"]):
            found.append((False, shared - 0.1 * HEADINGS.index(last), (column,)))
    z = columns.get((*place[:-1], "z"))
    if found or z is None or place[-1] != "x" or "position" in place:
        return max(found, key=itemgetter(0, 1), default=(False, 0.0, ()))[2]
    return (z,) if _is_in(z, ["rad"]) and _wraps(z.numbers) else ()


def _wraps(values: Array) -> bool:
    """True for values that wrap like an angle, unlike a height."""
    values = values[np.isfinite(values)]
    is_angle = np.all((values > -3.3) & (values < 6.4))
    return bool(is_angle and (np.abs(np.diff(values)) > NEARLY_A_TURN).any())


class Switch(NamedTuple):
    """A column that must have a certain value for the commands to be valid."""

    column: Field
    on: float | str  # the value

    @property
    def condition(self) -> str:
        """The column and its value, as in a mapping."""
        text = self.column.reference
        if ":" in text and not text.startswith('"'):
            text = f'"{text}"'
        on = self.on
        if not isinstance(on, str):
            on = np.format_float_positional(on, trim="-")
        return f"{text}: {on}"


def guess_switches(tables: Sequence[TableSurvey]) -> tuple[Switch, ...]:
    """Finds switches by the names of columns and values; none if they are never on together."""
    switches = []
    for table in tables:
        is_on = np.ones(table.rows, dtype=np.bool_)
        for column in table.columns:
            values = column.values
            on = _find_on_value({*column.words}, values)
            if on is not None:
                switches.append(Switch(column, on))
                if len(values) == table.rows:
                    is_on &= match_values(values, on)
        if table.rows and not is_on.any():
            return ()
    return tuple(switches)


def _find_on_value(words: set[str], values: Column) -> float | str | None:
    """Returns the value at which the commands count, from the names of column and values."""
    if is_text(values):
        texts = {str(value) for value in np.unique(values)}
        on = [text for text in texts if text.lower() in ON_WORDS]
        if words & MODES and len(texts) == 2 and len(on) == 1:
            return on[0]
        return None
    if values.dtype.kind not in "fiub":
        return None
    numbers = np.unique(values.astype(np.float64))
    numbers = numbers[np.isfinite(numbers)]
    if len(numbers) != 2 or numbers[0] != 0.0:
        return None
    if words & DISABLING or {"e", "stop"} <= words:
        return 0.0
    is_powered = words & POWER and words & POWERED and numbers[1] == 1.0
    if words & ENABLING or {"dead", "man"} <= words or is_powered:
        return float(numbers[1])
    return None


def guess_episode(tables: Sequence[TableSurvey]) -> Field | None:
    """Finds the only column that numbers episodes; None if there is none, or several."""
    columns = [c for table in tables for c in table.columns if _numbers_episodes(c)]
    return columns[0] if len(columns) == 1 else None


def _numbers_episodes(column: Field) -> bool:
    """True for a column named like an episode that keeps each of its values for many rows."""
    words = column.words
    if EPISODES.isdisjoint(words) or column.name in column.table.stamp_columns:
        return False
    values = column.values
    count = len(np.unique(values))
    changes = np.flatnonzero(values[1:] != values[:-1])
    if not 1 < count == len(changes) + 1 <= len(values) / MIN_MEAN_EPISODE_ROWS:
        return False
    # `run` with two values may be a switch, unless the stamps restart with it.
    if "run" not in words or count > 2:
        return True
    row = int(changes[0])
    t = column.table.t
    return t is not None and row + 1 < len(t) and bool(t[row + 1] < t[row])


def guess_yaw_rate(tables: Sequence[TableSurvey]) -> Field | None:
    """Finds the yaw rate of a gyro; None if no column is named like one."""
    columns = [column for table in tables for column in table.numbers if column.moves]
    rates = [c for c in columns if _is_rate_of_message(c)]
    rates = rates or [c for c in columns if _is_named_like_yaw_rate(c)]
    rates.sort(key=lambda rate: rate.table.name not in USUAL_NAMES)
    return next(iter(rates), None)


def write_imu_line(rate: Field, common_time: str | None) -> str:
    """Returns a mapping's line for a yaw rate; `common_time` is that of the whole mapping."""
    keys = []
    is_of_message = rate.name.startswith("angular_velocity.")
    if is_of_message and _find_message_axis(rate.table).sign < 0.0:
        keys.append("scale: -1")
    if rate.unit == "deg" or max(-rate.low, rate.high) > FASTEST_RADPS:
        keys.append("unit: deg/s")
    return f"imu: {{yaw_rate: {write_value(rate, keys, common_time)}}}"


def write_value(column: Field, keys: Sequence[str], common_time: str | None) -> str:
    """Returns a value as written in a mapping: a column, or a column with more keys."""
    time = column.table.time
    if time not in (common_time, None):
        keys = [*keys, f"time: {time}"]
    if not keys:
        return column.reference
    return f"{{from: {column.reference}, {', '.join(keys)}}}"


def _is_rate_of_message(column: Field) -> bool:
    """True for the yaw rate in messages of an IMU, by the axis that points up."""
    table = column.table
    if not {OF_MESSAGE, "linear_acceleration.x"} <= table.by_name.keys():
        return False
    axis = AXES[_find_message_axis(table).place]
    return column.name == f"angular_velocity.{axis}"


def _find_message_axis(table: TableSurvey) -> UpAxis:
    """Returns the axis of an IMU's messages that points up; z without accelerations."""
    columns = table.by_name
    if all(f"linear_acceleration.{axis}" in columns for axis in AXES):
        return find_table_axis(lambda name: columns[name].numbers)
    return UpAxis()


def _is_named_like_yaw_rate(column: Field) -> bool:
    words = column.name_words
    around = words | column.table.words
    is_of_gyro = around & {"imu", "gyro"} and not around & NOT_OF_GYRO
    return bool(is_of_gyro) and any(names <= words for names in TURNING_OF_IMU)


class Candidate(NamedTuple):
    """A column that was or may have been sent to the robot."""

    column: Field
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
    # True if no command is certain and the motion of the wheels is used instead
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
        candidates += _find_candidates(table, pose)
    candidates = _accept_steering(candidates)
    certain = [c for c in candidates if c.strength >= LIKELY]
    kind, commands = _choose_kind(certain)
    if kind is not None:
        return CommandGuess(kind, commands, {})
    if not certain:
        kind, commands = _choose_kind(list(_find_wheels(tables)))
        if kind is not None:
            wheels = [wheel.column for wheel in commands.values()]
            others = [c for c in candidates if c.column not in wheels]
            named = _choose_kind(others)[1]
            return CommandGuess(kind, commands, named, of_wheels=True)
    if not candidates:
        for table in tables:
            candidates += _find_unexplained(table, pose)
    kind, named = _choose_kind(candidates)
    if kind is None:
        candidates.sort(key=lambda candidate: -candidate.strength)
        for k, candidate in enumerate(candidates[:MOST_CANDIDATES]):
            named[f"command_{k}"] = candidate
    return CommandGuess(kind, {}, named)


def _find_candidates(table: TableSurvey, pose: PoseGuess | None) -> Iterator[Candidate]:
    """Yields the columns of a table that were or may have been sent to the robot."""
    is_twist = table.kind in TWIST_KINDS
    if STANDARD_PACKAGES.match(table.kind) and not is_twist:
        return
    # A file's name describes its columns only if there are other files, and not for the pose's.
    has_pose = pose is not None and pose.table is table
    context: set[str] = set()
    if table.kind or not (table.is_single or has_pose):
        context = table.words
    if context & NOT_COMMANDED and not context & COMMANDING:
        return
    context_of_topic: set[str] = set()
    rank = 0
    if table.kind:
        context_of_topic = context & BARE_TWIST
        # by its distance to the robot: `cmd_vel` itself before the inputs of a mux
        is_input = context & ROUNDABOUT and "output" not in context
        rank = -1 if is_input else int(context <= BARE_TWIST)
    for column in table.numbers:
        words = {*column.words}
        if (words | context) & (COMMANDING | WISHING):
            words = _name_commanded(words)
        if words & NOT_COMMANDED or column.is_place_on_earth or is_used(column, pose):
            continue
        meaning = guess_meaning(words | context_of_topic)
        strength = _estimate_strength(table.kind, words, context, meaning)
        if meaning is not None or (strength >= LIKELY and not is_twist):
            yield Candidate(column, meaning, strength, rank)


def _name_commanded(words: set[str]) -> set[str]:
    """Returns the words of a command: `yaw rate` as `yawrate`, `servo position` as `servo`."""
    if words & ORIENTATIONS and words & RATES:
        return words - ORIENTATIONS - RATES | {"yawrate"}
    if words & STEERING:
        return words - POSITIONS
    return words


def _find_unexplained(
    table: TableSurvey, pose: PoseGuess | None
) -> Iterator[Candidate]:
    """Yields the columns without a name, or with an unknown one, as in other languages.

    Each may have been sent to the robot, or measured.
    """
    pose_is_elsewhere = pose is not None and pose.table is not table
    shows_content = not table.is_single and (table.kind or pose_is_elsewhere)
    if STANDARD_PACKAGES.match(table.kind) or (
        shows_content and table.words & NOT_COMMANDED
    ):
        return
    for column in table.numbers:
        if column.name_words & EXPLAINED or is_used(column, pose):
            continue
        counts_rows = column.name.isdecimal() and (np.diff(column.numbers) == 1).all()
        if column.moves and not column.is_place_on_earth and not counts_rows:
            yield Candidate(column, None, POSSIBLE)


def _estimate_strength(
    kind: str, words: set[str], context: set[str], meaning: str | None
) -> int:
    is_command = kind in ACKERMANN_KINDS
    if is_command and meaning is None:
        return POSSIBLE
    if is_command or (words | context) & COMMANDING:
        return CERTAIN
    is_goal = words & (WISHING | PULSES) and meaning is not None
    return LIKELY if is_goal or meaning == "throttle" else POSSIBLE


def guess_meaning(words: set[str]) -> str | None:
    """Returns the meaning of a command with these words in its name; None if it is unclear."""
    for meaning, groups in MEANINGS:
        if all(words & group for group in groups):
            return meaning
    return None


def _accept_steering(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Counts a plain `steering` as a command if a throttle was also recorded."""
    if not any(c.meaning == "throttle" and c.strength >= LIKELY for c in candidates):
        return list(candidates)
    return [
        candidate._replace(strength=max(candidate.strength, LIKELY))
        if candidate.column.words in (["steering"], ["steer"])
        else candidate
        for candidate in candidates
    ]


def _choose_kind(
    candidates: Sequence[Candidate],
) -> tuple[str | None, dict[str, Candidate]]:
    """Returns the kind of robot that these columns drive best, and its commands by name."""
    best: tuple[str | None, dict[str, Candidate]] = (None, {})
    best_merit = (0, 0)
    kinds = ((name, template.words) for name, template in _list_templates().items())
    for name, words in (*kinds, *KINDS):
        commands = _match_commands(words, candidates)
        still = sum(command.is_still for command in commands.values())
        if still < len(commands):
            strength = min(command.strength for command in commands.values())
            if (strength, -still) > best_merit:
                best_merit = strength, -still
                best = name, commands
    return best


def _list_templates() -> dict[str, Template]:
    kinds = {name: find_kind(name) for name in list_kinds()}
    return {name: kind.template for name, kind in kinds.items() if kind is not None}


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
        values = [c.column.values for c in fitting if c.merit == best.merit]
        if not all(np.array_equal(best.column.values, others) for others in values):
            return {}
        commands[name] = best
    return commands


def _find_wheels(tables: Sequence[TableSurvey]) -> Iterator[Candidate]:
    """Yields the measured ticks or speeds of wheels, which replace missing commands."""
    for table in tables:
        for column in table.numbers:
            words = column.name_words
            is_wheel = words & WHEEL_WORDS and not words & NO_SPEED
            if STANDARD_PACKAGES.match(table.kind) or not (is_wheel and column.moves):
                continue
            words_of_side = {*split_unit(column.name)[0]} - TICKS
            meaning = guess_meaning(words_of_side - {"speed", "velocity", "vel"})
            if meaning in ("left", "right", *WHEELS):
                yield Candidate(column, meaning, LIKELY, int(bool(words & TICKS)))


def find_look_alikes(name: str) -> list[str]:
    """Returns the other kinds of robots that have the same commands."""
    sets = {
        kind: [{*list_names(commands)} for commands in template.commands]
        for kind, template in _list_templates().items()
    }
    names = sets.pop(name, [])
    return [kind for kind, others in sets.items() if any(o in names for o in others)]
