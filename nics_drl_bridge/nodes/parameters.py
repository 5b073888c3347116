"""Parameters of every node, for `declare` and `--help`; needs no ROS 2."""

import math
import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields
from importlib.metadata import PackageNotFoundError, distribution
from typing import Any, NamedTuple

from nics_drl_bridge import defaults
from nics_drl_bridge.errors import ConfigError, shorten
from nics_drl_bridge.robot import DEFAULT_ROBOT

REALTIME = "realtime"
LOCKSTEP = "lockstep"
MODES = (REALTIME, LOCKSTEP, "as_fast_as_possible")
NO_POSE = defaults.POSE_TYPE
POSE_TYPES = ("PoseStamped", "PoseWithCovarianceStamped")
OWN = -1.0  # value of a delay: take the model's
HIGHEST_PRIORITY = 99
# distributions whose robots expect a Twist
PLAIN_TWISTS = ("humble", "iron", "jazzy")
STAMPED = "enable_stamped_cmd_vel"
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


def is_before_kilted(distribution: str) -> bool:
    """True if a distribution, or the one of the wheels if it is empty, is older than Kilted."""
    if distribution:
        return distribution in PLAIN_TWISTS
    return any(map(_is_wheel, PLAIN_TWISTS))


def _is_wheel(name: str) -> bool:
    try:
        return bool(distribution(f"ros-{name}-rclpy"))
    except PackageNotFoundError:
        return False


def make_stamped_row() -> Row:
    """Return the parameter that selects the type of `cmd_vel`."""
    about = (
        "Use TwistStamped for cmd_vel, the default on Kilted and newer; false: Twist."
    )
    return Row(STAMPED, is_stamped_default(), about)


IMU = "imu"
ABOUT_IMU = (
    "Topic of the gyro that replaces the yaw rate of the wheels. auto: imu or imu/data, if the "
    "model was made with a gyro; none: wheels only."
)
MODEL = Row(
    "model", DEFAULT_ROBOT, "Name of a shipped robot, or folder of a SimulatorModel."
)
BASE_FRAME = Row("base_frame", "base_link", "Frame id of the robot.", fixed=False)
MAP_FRAME = Row(
    "map_frame", "map", "Frame id of the estimate and of goals.", fixed=False
)
ROBOT_FRAME = Row(
    BASE_FRAME.name,
    "",
    "Frame id of the robot, in which cmd_vel is expressed.",
    shown="the child frame of odom",
)


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
            needed = "must be 1 to 255 characters, without blanks or a leading /"
            return f"parameter {name!r}: {needed}, not {shorten(frame, 80)!r}."
    base = frames.get(BASE_FRAME.name, "")
    for name in (MAP_FRAME.name, "odom_frame"):
        if base and frames.get(name, "") == base:
            return f"parameter {BASE_FRAME.name!r}: is {base!r}, like {name!r}; they must differ."
    return ""


def list_managed_rows() -> list[Row]:
    """Return the parameters of a managed node."""
    about = (
        "Configure and activate automatically at startup, without a lifecycle manager."
    )
    return [Row("autostart", True, about), MODEL]


def list_sensor_rows() -> list[Row]:
    """Return the parameters of a robot's sensors other than scan and odometry."""
    upside_down = "The lidar is mounted upside down, so that its beams run clockwise."
    types = ", ".join((NO_POSE, *POSE_TYPES))
    return [
        Row(
            "pose_type",
            NO_POSE,
            f"Message type of `pose`, a pose in the map frame: {types}.",
        ),
        Row("lidar_upside_down", False, upside_down),
        Row(IMU, defaults.IMU_TOPIC, ABOUT_IMU),
        make_stamped_row(),
    ]


def list_middleware_rows() -> list[Row]:
    """Return the parameters that only `middleware_node` has."""
    return [
        MAP_FRAME,
        BASE_FRAME,
        Row(
            "publish_map_to_odom",
            True,
            "Publish map -> odom on /tf from the estimate, unless another node does.",
        ),
        Row(
            "transform_tolerance",
            0.2,
            "How far into the future map -> odom is stamped [s].",
            (0.0, 10.0),
        ),
    ]


def list_policy_rows() -> list[Row]:
    """Return the parameters that only `policy_node` has."""
    return [
        BASE_FRAME,
        MAP_FRAME,
        Row(
            "policy",
            "dynamic_window",
            "Policy file (*.onnx), mapping of a foreign policy (*.yaml), or name of a shipped "
            "policy or a baseline.",
        ),
        Row(
            "goal",
            [math.nan] * 2,
            "Goal x, y in the map frame [m]; NaN: wait for goal_pose.",
        ),
        Row(
            "rate",
            math.nan,
            "Actions per second on the steady clock. NaN: one per control period; 0: one per "
            "scan, for a simulator that does not run in real time.",
        ),
        Row(
            "deadline",
            math.nan,
            "Time limit of an inference [s]; NaN: half the control period.",
        ),
        Row(
            "late_limit",
            3,
            "Number of consecutive late inferences after which a zero command is sent.",
            (1, 1000),
        ),
    ]


def list_nav2_rows() -> list[Row]:
    """Return the parameters of Nav2's controller server that `policy_node` supports."""
    return [
        Row(
            "navigate_to_pose",
            True,
            "Serve the action navigate_to_pose, unless another node does.",
        ),
        Row(
            "lookahead",
            1.0,
            "Distance from the robot to its sub-goal on a path [m].",
            (0.1, 100.0),
            False,
        ),
        Row(
            "controller_plugins",
            ["FollowPath"],
            "Controller names that follow_path goals may request.",
        ),
        Row(
            "goal_checker_plugins",
            ["general_goal_checker"],
            "Goal checker names that follow_path goals may request.",
        ),
        Row(
            "progress_checker_plugins",
            ["progress_checker"],
            "Progress checker names that follow_path goals may request.",
        ),
        Row(
            "path_handler_plugins",
            ["PathHandler"],
            "Path handler names that goals may request; all behave alike.",
        ),
        Row(
            "progress_checker_plugin",
            "",
            "Humble's single progress checker; empty: use progress_checker_plugins.",
        ),
        Row(
            "failure_tolerance",
            0.3,
            "How long a robot in contact waits before its goal is aborted [s]; -1: forever.",
            (-1.0, 1e6),
            False,
        ),
        Row(
            "costmap_update_timeout",
            1.0,
            "Abort a goal after this silence of scan or odom [s]; at least ten control periods.",
            (0.0, 1e6),
            False,
        ),
        Row("speed_limit_topic", "speed_limit", "Topic of SpeedLimit messages."),
    ]


CHECKS = {  # what the fields of `GoalCheck` and `ProgressCheck` mean
    "xy_goal_tolerance": "Maximum distance from the goal [m].",
    "yaw_goal_tolerance": "Heading tolerance [rad]; ignored for robots that steer.",
    "stateful": "A position once reached counts as reached from then on.",
    "path_length_tolerance": "Maximum remaining path length at the goal [m].",
    "required_movement_radius": "Distance that counts as progress [m].",
    "required_movement_angle": "Rotation that also counts as progress [rad], for a "
    "PoseProgressChecker.",
    "movement_time_allowance": "Time limit for progress [s].",
}


def list_checker_rows(goals: Sequence[str], progress: Sequence[str]) -> list[Row]:
    """Return the parameters of the named checks; they are those of Nav2's checkers."""
    from nics_drl_bridge.policy.follow import GoalCheck, ProgressCheck

    rows = []
    for names, check in ((goals, GoalCheck), (progress, ProgressCheck)):
        defaults_of = {field.name: field.default for field in fields(check)}
        if check is ProgressCheck:
            defaults_of["required_movement_angle"] = 0.5
        plugin = f"nav2_controller::Simple{check.__name__}er"
        for name in names:
            rows.append(
                Row(f"{name}.plugin", plugin, "Nav2 checker to imitate.", fixed=False)
            )
            for field, value in defaults_of.items():
                span = None if isinstance(value, bool) else (0.0, 1e6)
                rows.append(Row(f"{name}.{field}", value, CHECKS[field], span, False))
    return rows


# This service exists since simulation_interfaces 2.1, the oldest supported version.
NEWEST = "simulation_interfaces/srv/SpawnEntities"
STANDARD = Row(
    "simulation_interfaces",
    True,
    "Offer the services of simulation_interfaces, if that package is installed.",
)


def list_device_rows(laser_frame: str = "") -> list[Row]:
    """Return the parameters of all simulators except `robots`, which is a count or names."""
    return [
        Row("world", defaults.WORLD, "Name of a shipped world, or a world file."),
        STANDARD,
        Row(
            "randomisation",
            "",
            "Randomisation of each episode: mild, strong or a file; empty: none.",
        ),
        Row("mode", REALTIME, f"How time runs: {', '.join(MODES)}."),
        make_stamped_row(),
        Row(
            "frame_prefix",
            "",
            "Prefix of the robot's frames; in a fleet, the namespace follows it.",
        ),
        MAP_FRAME._replace(about="Frame id of map.", fixed=True),
        Row("odom_frame", "odom", "Frame id of odom."),
        BASE_FRAME._replace(about="Frame id of base_link.", fixed=True),
        Row(
            "laser_frame",
            laser_frame,
            "Frame id of the lidar.",
            shown="the model's",
        ),
        Row(
            "footprint_frame",
            "",
            "Additional frame at base_link, such as base_footprint; empty: none.",
        ),
        Row("map_resolution", 0.01, "Maximum cell size of map [m].", (0.001, 10.0)),
        Row(
            "publish_map_to_odom",
            False,
            "Publish the true map -> odom on /tf, in place of a localiser.",
        ),
        Row(
            "rate",
            1.0,
            "Simulated seconds per real second in mode realtime.",
            (0.01, 1000.0),
        ),
        Row(
            "odom_rate",
            0.0,
            "Rate of odom [Hz]; 0: one per control period.",
            (0.0, 1000.0),
        ),
        Row("scan_rate", 0.0, "Rate of scan [Hz]; 0: the lidar's rate.", (0.0, 1000.0)),
        Row(
            "scan_latency",
            OWN,
            "Delay from the end of a scan to its publication [s]; -1: as measured for the model.",
            (OWN, 10.0),
        ),
        Row(
            "odom_latency",
            OWN,
            "Delay from the stamp of odom to its publication [s]; -1: as measured for the model.",
            (OWN, 10.0),
        ),
        Row(
            "latency_jitter",
            OWN,
            "Maximum additional delay of scan and odom, drawn uniformly [s]; -1: as measured.",
            (OWN, 10.0),
        ),
        Row(
            "command_latency",
            OWN,
            "Delay from a command to its effect [s]; -1: as measured for the model.",
            (OWN, 10.0),
        ),
        Row(
            "command_timeout",
            defaults.COMMAND_SILENCE_S,
            "Stop after this silence of cmd_vel [simulated s]; not used in lockstep.",
            (0.0, 3600.0),
            fixed=False,
        ),
        Row(
            "episode_seed",
            0,
            "Seed of the episode that ~/reset begins.",
            (0, GREATEST_SEED),
            fixed=False,
        ),
        Row(
            "episode_start",
            [math.nan] * 3,
            "Start pose x, y, heading of each robot [m, m, rad]; NaN: the seed's.",
            fixed=False,
        ),
    ]


ROBOTS = Row(
    "robots",
    1,
    "Number of robots, named robot1, robot2, ..., or their namespaces; one has none.",
)


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
        fix = f"give a count from 1 to {GREATEST_FLEET}, or a list of different namespaces"
        raise ConfigError(f"'robots' is {robots!r}; {fix}, as in [robot1, robot2].")
    return names


FRICTION = Row(
    "friction",
    1.0,
    "Friction coefficient between tyres and floor; ice: 0.1.",
    span=(0.01, 2.0),
)

GYRO_BIAS = Row(
    "gyro_bias", 0.0, "Bias of a gyro in the odometry [rad/s].", (-1.0, 1.0)
)
GYRO_NOISE = Row(
    "gyro_noise", 0.0, "Standard deviation of its readings [rad/s].", (0.0, 1.0)
)
URDF = Row(
    "urdf",
    "",
    "URDF or SDF file of the robots; empty: built by the parameters of the model's robot.",
)


def make_renderer_row(default: str) -> Row:
    """Return the parameter that selects the renderer of a simulator's lidar."""
    return Row("renderer", default, "Renderer of the lidar: baked or exact.")


LIMITS = Row(
    "limits",
    "",
    "Limits of the robot: name of a shipped file, or a YAML file; required.",
)
SHIELD = Row("shield", True, "Stop before obstacles.")
SHIELD_NUMBERS = [
    Row(
        f"shield_{name}",
        math.nan,
        f"{about}; NaN: from the limits file, else the model.",
    )
    for name, about in (
        ("latency", "Measured time until the robot follows a command, at most 10 [s]"),
        ("deceleration", "Measured deceleration of the robot [m/s^2]"),
        ("margin", "Distance kept free around the footprint, at most 10 [m]"),
        (
            "obstacle_speed",
            "Maximum speed of approaching obstacles, at most 100 [m/s]",
        ),
    )
]
BLACK_BOX = Row(
    "black_box",
    "",
    "Folder for recordings of the last 30 s before a stop, with a subfolder per namespace; "
    "empty: ~/.ros/black_box.",
)
PRIORITY = Row(
    "priority",
    0,
    "Real-time priority (SCHED_FIFO) of the process, 1 to 99; 0: none.",
    (0, HIGHEST_PRIORITY),
)


def list_gate_rules(
    odom_rate: float = math.nan, scan_age: float = math.nan
) -> list[Row]:
    """Return the parameters of a gate's rules.

    Those in `RULES_IN_SECONDS` set fields of `GateConfig` whose names end in `_s`.
    """
    from nics_drl_bridge.gate.state import GateConfig as Default

    seconds = (0.01, 10.0)
    return [
        Row(
            "odom_rate",
            odom_rate,
            "Expected rate of odom [Hz].",
            (0.1, 1e4),
            shown="one per control period, or more",
        ),
        Row(
            "scan_age",
            scan_age,
            "Maximum age of a scan, also of the one behind a command [s].",
            seconds,
            shown=f"{Default.scan_age_s:g}, or more for a slow lidar",
        ),
        Row("odom_age", Default.odom_age_s, "Maximum age of odometry [s].", seconds),
        Row(
            "command_age",
            Default.command_age_s,
            "Maximum age of a command [s].",
            seconds,
        ),
        Row(
            "rate_tolerance",
            Default.rate_tolerance,
            "Relative tolerance of the rates of scan and odom.",
            (0.01, 0.9),
        ),
        Row(
            "clock_rate",
            Default.clock_rate,
            "Rate of stamps: simulated seconds per real second.",
            (0.01, 100.0),
        ),
        Row(
            "e_stop_required",
            Default.e_stop_required,
            "Require e_stop to be received before arming; set false only in simulations.",
        ),
        Row(
            "e_stop_silence",
            Default.e_stop_silence_s,
            "Maximum silence of e_stop [s].",
            seconds,
        ),
        Row(
            "estimate_required",
            Default.estimate_required,
            "Require odometry/filtered for arming.",
        ),
        Row(
            "estimate_position",
            Default.estimate_position,
            "Maximum growth of the estimated position's standard deviation within 10 s [m].",
            (1e-3, 1e3),
        ),
        Row(
            "estimate_heading",
            Default.estimate_heading,
            "Maximum growth of the estimated heading's standard deviation within 10 s [rad].",
            (1e-3, 1e3),
        ),
        Row(
            "stop_when_held",
            Default.stop_when_held,
            "Stop if the scans show none of the motion that odometry reports.",
        ),
    ]


SPLIT = {  # parameters of earlier versions, and what replaced them
    "estimate_std": "'estimate_position' [m] and 'estimate_heading' [rad], which limit how much "
    "the estimate's uncertainty grows within 10 s, counted from arming",
}
RULES_IN_SECONDS = ("scan_age", "odom_age", "command_age", "e_stop_silence")


FOREIGN = Row(
    "foreign_commands",
    "none",
    "Type of cmd_vel_raw, Twist or TwistStamped, if a controller such as Nav2's publishes it "
    "without the stamp of a scan; the newest scan's age then counts. none: a policy publishes it.",
)


def list_gate_rows() -> list[Row]:
    """Return all parameters of `command_gate`."""
    shield = [SHIELD, *SHIELD_NUMBERS]
    return [
        MODEL,
        LIMITS,
        *shield,
        *list_gate_rules(),
        make_stamped_row(),
        ROBOT_FRAME,
        FOREIGN,
        BLACK_BOX,
        PRIORITY,
    ]


def list_drive_rows() -> list[Row]:
    """Return the parameters of `record_node`."""
    from nics_drl_bridge.recording.excite import (
        LONGEST_S,
        MIN_DRIVE_S,
        SLOWEST,
        WIDEST_M,
    )

    return [
        Row("robot", DEFAULT_ROBOT, "Name of a shipped robot, or a robot's YAML file."),
        Row(
            "out",
            "drive.npz",
            "Recording to write: a file *.npz, or a folder for a rosbag2.",
        ),
        Row(
            "bound",
            defaults.DRIVE_BOUND_M,
            "Radius of the circle around the start that the robot stays within [m].",
            (0.0, WIDEST_M),
        ),
        Row(
            "duration",
            defaults.DRIVE_S,
            "Duration of the drive [s].",
            (MIN_DRIVE_S, LONGEST_S),
        ),
        Row("speed", 1.0, "Fraction of the maximum speeds to use.", (SLOWEST, 1.0)),
        Row("seed", 0, "Seed of the pattern.", (0, GREATEST_SEED)),
        Row("topics", "", "YAML file that names the joints; empty: none."),
        Row(
            IMU,
            defaults.IMU_TOPIC,
            "IMU topic to record. auto: imu or imu/data; none: no IMU.",
        ),
        Row(
            "odom_timeout",
            defaults.DATA_SILENCE_S,
            "Stop after this silence of odom [s].",
            (0.05, 10.0),
        ),
        make_stamped_row(),
    ]


class NodeFacts(NamedTuple):
    """What a user needs to know about a node."""

    about: str
    subscribes: Sequence[str]
    publishes: Sequence[str]
    services: Sequence[str]
    parameters: Sequence[Row]
    example: str  # after `--ros-args`


DRIVEN_BY = (
    "cmd_vel",
    "ackermann_cmd (for robots that steer, with ackermann_msgs)",
    "initialpose",
)
TOLD = (
    "scan",
    "odom",
    "the model's additional sensors",
    "joint_states",
    "ground_truth",
    "map",
    "/clock",
    "/tf, /tf_static (with tf2_msgs)",
    "/diagnostics",
)
SERVED = ("~/reset", "~/pause", "~/repeat", "~/self_test", "~/touched")
HEARD = (
    "scan",
    "odom",
    "the model's additional sensors",
    "cmd_vel",
    "pose (with pose_type)",
    "imu (or the topic that the parameter names)",
)
NODES: dict[str, Callable[[], NodeFacts]] = {
    "simulator_node": lambda: NodeFacts(
        "Simulates robots behind the topics of the hardware.",
        DRIVEN_BY,
        TOLD,
        SERVED,
        [MODEL, ROBOTS, *list_device_rows(), make_renderer_row(defaults.RENDERER)],
        "-p world:=corridor -p odom_rate:=50.0",
    ),
    "mujoco_node": lambda: NodeFacts(
        "Simulates robots in MuJoCo behind the topics of the hardware.",
        DRIVEN_BY,
        TOLD,
        SERVED,
        [
            MODEL,
            ROBOTS,
            *list_device_rows(),
            make_renderer_row(defaults.MUJOCO_RENDERER),
            FRICTION,
        ],
        "-p model:=mecanum -p world:=empty",
    ),
    "dart_node": lambda: NodeFacts(
        "Simulates robots in DART, Gazebo's physics engine, behind the topics of the hardware.",
        DRIVEN_BY,
        TOLD,
        SERVED,
        [MODEL, ROBOTS, *list_device_rows(), FRICTION, GYRO_BIAS, GYRO_NOISE, URDF],
        "-p model:=jackal -p gyro_bias:=0.01",
    ),
    "middleware_node": lambda: NodeFacts(
        "Caches a robot's topics and publishes an estimate of its state; a managed node.",
        (*HEARD, "initialpose"),
        ("odometry/filtered", "/tf (with tf2_msgs)", "/diagnostics"),
        ("~/reset",),
        [*list_managed_rows(), *list_sensor_rows(), *list_middleware_rows()],
        "-p imu:=imu/data -r __ns:=/car",
    ),
    "policy_node": lambda: NodeFacts(
        "Drives a robot to goals with a policy that answers each scan; a managed node.",
        (
            *HEARD,
            "initialpose",
            "goal_pose",
            "map, speed_limit (with nav2_msgs)",
            "/tf, /tf_static (with tf2_msgs)",
        ),
        ("cmd_vel_raw", "/diagnostics"),
        ("follow_path, navigate_to_pose (actions, with nav2_msgs)",),
        [
            *list_managed_rows(),
            *list_sensor_rows(),
            *list_policy_rows(),
            *list_nav2_rows(),
            *list_checker_rows(("general_goal_checker",), ("progress_checker",)),
        ],
        '-p policy:=my_policy.onnx -p "goal:=[1.0, 2.0]"',
    ),
    "command_gate": lambda: NodeFacts(
        "Passes a policy's commands on while they can be trusted; it starts disarmed.",
        (
            "cmd_vel_raw",
            "scan",
            "odom",
            "odometry/filtered",
            "e_stop",
            "the model's additional sensors",
        ),
        ("cmd_vel", "/diagnostics"),
        ("~/arm", "~/reset", "~/e_stop"),
        list_gate_rows(),
        f"-p limits:={DEFAULT_ROBOT}",
    ),
    "record_node": lambda: NodeFacts(
        "Drives a robot through its full range of motion and records it; the robot moves.",
        ("odom", "joint_states", "imu or imu/data", "pose"),
        ("cmd_vel",),
        (),
        list_drive_rows(),
        "-p bound:=3.0 -p out:=drive.npz",
    ),
}
