"""The parameters of every node in one place that needs no ROS 2, for `declare` and `--help`."""

import math
import os
import re
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import PackageNotFoundError, distribution
from typing import Any, NamedTuple

from nics_drl_bridge.errors import shorten
from nics_drl_bridge.robot import DEFAULT_ROBOT

MODES = ("realtime", "lockstep", "as_fast_as_possible")
NO_POSE = "none"
POSE_TYPES = ("PoseStamped", "PoseWithCovarianceStamped")
OWN = -1.0  # of a delay: as in the model
HIGHEST_PRIORITY = 99
# distributions whose robots are driven by a Twist
PLAIN_TWISTS = ("humble", "iron", "jazzy")
STAMPED = "enable_stamped_cmd_vel"
FRAME = re.compile(r"[^\s/]\S{0,254}")
MAY_BE_EMPTY = ("footprint_frame",)


class Row(NamedTuple):
    """A parameter; its type is that of the default."""

    name: str
    default: Any
    about: str
    span: tuple[float, float] | None = None  # in which a number lies
    fixed: bool = True  # it is read once
    shown: str = ""  # the default in words, where it follows from others


def stamped_by_default() -> bool:
    """True if commands are a TwistStamped in this ROS 2 distribution, as they are since Kilted."""
    named = os.environ.get("ROS_DISTRO", "")
    return not any(named == each if named else _is_wheel(each) for each in PLAIN_TWISTS)


def _is_wheel(name: str) -> bool:
    try:
        return bool(distribution(f"ros-{name}-rclpy"))
    except PackageNotFoundError:
        return False


def stamped(what: str) -> Row:
    """Returns the parameter that chooses the type of `cmd_vel`."""
    about = f"Whether {what} is a TwistStamped, as since Kilted, or a Twist."
    return Row(STAMPED, stamped_by_default(), about)


IMU = "imu"
AUTO = "auto"
ABOUT_IMU = (
    "Topic of the gyro that turns odometry. auto: imu or imu/data, if the model was made with a "
    "gyro; none: the wheels alone."
)
MODEL = Row("model", DEFAULT_ROBOT, "Folder of a SimulatorModel, or a shipped robot.")
BASE_FRAME = Row("base_frame", "base_link", "Frame id of the robot.", fixed=False)
ROBOT_FRAME = Row(
    BASE_FRAME.name,
    "",
    "Frame id of the robot, in which cmd_vel is.",
    shown="the child frame of odom",
)


def frame_fault(parameters: Iterable[Any], *may_be_empty: str) -> str:
    """Returns a sentence about frames that can't be so; empty if all can. The last of a name is."""
    frames = {
        each.name: str(each.value)
        for each in parameters
        if each.name.endswith("_frame")
    }
    for name, frame in frames.items():
        if not FRAME.fullmatch(frame) and (
            frame or name not in (*MAY_BE_EMPTY, *may_be_empty)
        ):
            needed = (
                "must be 1 to 255 characters, without blanks, the first of them no /"
            )
            return f"parameter {name!r}: {needed}, not {shorten(frame, 80)!r}."
    base = frames.get("base_frame", "")
    taken = [
        name
        for name in ("map_frame", "odom_frame")
        if frames.get(name, "") == base != ""
    ]
    if taken:
        return f"parameter 'base_frame': is {base!r}, as {taken[0]!r} is; they must differ."
    return ""


def managed() -> list[Row]:
    """Returns the parameters of a managed node."""
    about = "Whether it configures and activates itself, without a lifecycle manager."
    return [Row("autostart", True, about), MODEL]


def sensors() -> list[Row]:
    """Returns the parameters of the sensors that a robot has beside scan and odometry."""
    upside_down = (
        "Whether the lidar is mounted upside down, so that its beams run clockwise."
    )
    types = ", ".join((NO_POSE, *POSE_TYPES))
    return [
        Row("pose_type", NO_POSE, f"Type of `pose`, in the map frame: {types}."),
        Row("lidar_upside_down", False, upside_down),
        Row(IMU, AUTO, ABOUT_IMU),
        stamped("cmd_vel"),
    ]


def middleware() -> list[Row]:
    """Returns the parameters of `middleware_node` alone."""
    return [
        Row("map_frame", "map", "Frame id of the estimate.", fixed=False),
        BASE_FRAME,
        Row(
            "publish_map_to_odom",
            True,
            "Whether to publish map -> odom on /tf from the estimate, if no other node does.",
        ),
        Row(
            "transform_tolerance",
            0.2,
            "How far the stamp of map -> odom is ahead [s].",
            (0.0, 10.0),
        ),
    ]


def policy() -> list[Row]:
    """Returns the parameters of `policy_node` alone."""
    return [
        BASE_FRAME,
        Row(
            "map_frame",
            "map",
            "Frame id of the estimate, in which goals are.",
            fixed=False,
        ),
        Row(
            "policy",
            "dynamic_window",
            "A policy file (*.onnx), the mapping of a foreign one (*.yaml), or the name of a "
            "shipped one or of a baseline.",
        ),
        Row("goal", [math.nan] * 2, "x, y in map [m]; NaN waits for goal_pose."),
        Row(
            "rate",
            math.nan,
            "Actions per second of the steady clock; NaN: one per control period; 0: one per "
            "scan, for a simulator that does not run in real time.",
        ),
        Row(
            "deadline",
            math.nan,
            "Longest time of an inference [s]; NaN: half the control period.",
        ),
        Row(
            "late_limit",
            3,
            "Late inferences in a row that cause a zero command.",
            (1, 1000),
        ),
    ]


def nav2() -> list[Row]:
    """Returns the parameters of Nav2's controller server that `policy_node` knows, too."""
    return [
        Row(
            "navigate_to_pose",
            True,
            "Whether to serve this action too, if no other node does.",
        ),
        Row(
            "lookahead",
            1.0,
            "From the robot to the sub-goal on a path [m].",
            (0.1, 100.0),
            False,
        ),
        Row(
            "controller_plugins",
            ["FollowPath"],
            "Names that goals of follow_path may ask for.",
        ),
        Row(
            "goal_checker_plugins",
            ["general_goal_checker"],
            "The same for goal checkers.",
        ),
        Row(
            "progress_checker_plugins",
            ["progress_checker"],
            "The same for progress checkers.",
        ),
        Row(
            "path_handler_plugins",
            ["PathHandler"],
            "Names of path handlers; all do the same.",
        ),
        Row(
            "progress_checker_plugin",
            "",
            "Humble's single progress checker; empty for the list.",
        ),
        Row(
            "failure_tolerance",
            0.3,
            "How long a robot that touches something waits [s]; -1 for ever.",
            (-1.0, 1e6),
            False,
        ),
        Row(
            "costmap_update_timeout",
            1.0,
            "Silence of scan or odom that ends a path [s]; ten control periods at least.",
            (0.0, 1e6),
            False,
        ),
        Row("speed_limit_topic", "speed_limit", "Topic of SpeedLimit messages."),
    ]


def checkers(goals: Sequence[str], progress: Sequence[str]) -> list[Row]:
    """Returns the parameters of the checks of these names, as of Nav2's own checkers."""
    span = (0.0, 1e6)
    plugin = "Nav2's checker to imitate."
    rows: tuple[list[tuple[str, Any, str, tuple[float, float] | None]], ...] = (
        [
            ("xy_goal_tolerance", 0.25, "Greatest distance from the goal [m].", span),
            (
                "yaw_goal_tolerance",
                0.25,
                "Heading tolerance [rad]; not for robots that steer.",
                span,
            ),
            ("stateful", True, "Whether a position once reached stays reached.", None),
            (
                "path_length_tolerance",
                1.0,
                "Greatest remaining path length at the goal [m].",
                span,
            ),
            ("plugin", "nav2_controller::SimpleGoalChecker", plugin, None),
        ],
        [
            ("plugin", "nav2_controller::SimpleProgressChecker", plugin, None),
            ("required_movement_radius", 0.5, "Radius the robot must leave [m].", span),
            (
                "required_movement_angle",
                0.5,
                "Or turn by this [rad], for a PoseProgressChecker.",
                span,
            ),
            ("movement_time_allowance", 10.0, "Within this time [s].", span),
        ],
    )
    return [
        Row(f"{name}.{key}", default, about, limits, fixed=False)
        for names, those in zip((goals, progress), rows, strict=True)
        for name in names
        for key, default, about, limits in those
    ]


# of 2.1, the oldest version that will do
NEWEST = "simulation_interfaces/srv/SpawnEntities"
STANDARD = Row(
    "simulation_interfaces",
    True,
    "Whether to offer the services of simulation_interfaces, where that package is installed.",
)


def device(laser_frame: str = "") -> list[Row]:
    """Returns the parameters of all simulators, but `robots`, which is a count or names."""
    return [
        Row("world", "arena", "World file, or the name of a shipped world."),
        STANDARD,
        Row(
            "randomisation",
            "",
            "Drawn in each episode: mild, strong or a file; none if empty.",
        ),
        Row("mode", MODES[0], f"How time runs: {', '.join(MODES)}."),
        stamped("cmd_vel"),
        Row(
            "frame_prefix",
            "",
            "Prefix of the robot's frames; in a fleet, of its namespace.",
        ),
        Row("map_frame", "map", "Frame id of map."),
        Row("odom_frame", "odom", "Frame id of odom."),
        Row("base_frame", "base_link", "Frame id of base_link."),
        Row(
            "laser_frame",
            laser_frame,
            "Frame id of the lidar.",
            shown="that of the model",
        ),
        Row(
            "footprint_frame",
            "",
            "Additional frame at base_link, such as base_footprint; none if empty.",
        ),
        Row("map_resolution", 0.01, "Greatest cell size of map [m].", (0.001, 10.0)),
        Row(
            "publish_map_to_odom",
            False,
            "Whether to publish the true map -> odom on /tf, in place of a localiser.",
        ),
        Row("rate", 1.0, "Simulated seconds per second in realtime.", (0.01, 1000.0)),
        Row(
            "odom_rate",
            0.0,
            "Rate of odom [Hz]; 0 for one per control period.",
            (0.0, 1000.0),
        ),
        Row(
            "scan_rate", 0.0, "Rate of scan [Hz]; 0 for the lidar's own.", (0.0, 1000.0)
        ),
        Row(
            "scan_latency",
            OWN,
            "From the end of a scan to its publication [s]; -1 for the model's measured one.",
            (OWN, 10.0),
        ),
        Row(
            "odom_latency",
            OWN,
            "From the stamp of odom to its publication [s]; -1 for the model's measured one.",
            (OWN, 10.0),
        ),
        Row(
            "latency_jitter",
            OWN,
            "Maximum extra delay of both, drawn uniformly [s]; -1 for the measured ones.",
            (OWN, 10.0),
        ),
        Row(
            "command_latency",
            OWN,
            "From a command to its effect [s]; -1 for the model's measured one.",
            (OWN, 10.0),
        ),
        Row(
            "command_timeout",
            0.5,
            "Stops after this silence on cmd_vel [simulated s]; not in lockstep.",
            (0.0, 3600.0),
            fixed=False,
        ),
        Row("episode_seed", 0, "Seed of the episode that ~/reset begins.", fixed=False),
        Row(
            "episode_start",
            [0.0, 0.0, 0.0],
            "Start x, y, heading of each robot in the episodes, once set.",
            fixed=False,
        ),
        Row(
            "episode_start_given",
            False,
            "Whether episode_start applies, or the seed's start; true once episode_start is set.",
            fixed=False,
        ),
    ]


ROBOTS = Row(
    "robots",
    1,
    "How many robots, named robot1, robot2, ..., or their namespaces; 1 has none.",
)
FRICTION = Row(
    "friction", 1.0, "Friction between tyres and floor; ice has 0.1.", span=(0.01, 2.0)
)


def renderer(default: str) -> Row:
    """Returns the parameter of a simulator's lidar."""
    return Row("renderer", default, "Lidar: baked or exact.")


LIMITS = Row(
    "limits", "", "Limits of the robot: a shipped file, or a YAML file; no default."
)
SHIELD = Row("shield", True, "Whether to stop before obstacles.")
SHIELD_NUMBERS = [
    Row(
        f"shield_{name}",
        math.nan,
        f"{about}; NaN: from the limits' file, or the model.",
    )
    for name, about in (
        ("latency", "Measured time until the robot follows a command, at most 10 [s]"),
        ("deceleration", "Measured deceleration of the robot [m/s^2]"),
        ("margin", "Kept free around the footprint, at most 10 [m]"),
        (
            "obstacle_speed",
            "Greatest speed of approaching obstacles, at most 100 [m/s]",
        ),
    )
]
BLACK_BOX = Row(
    "black_box",
    "",
    "Folder for the last 30 s before a stop, by namespace; ~/.ros/black_box if empty.",
)
PRIORITY = Row(
    "priority",
    0,
    "Real-time priority (SCHED_FIFO) of its process, 1 to 99; 0 for none.",
    (0, HIGHEST_PRIORITY),
)


def gate_rules(odom_rate: float = math.nan, scan_age: float = math.nan) -> list[Row]:
    """Returns the parameters of a gate's rules; `RULES_IN_SECONDS` are fields that end in _s."""
    from nics_drl_bridge.gate.state import GateConfig as Default

    seconds = (0.01, 10.0)
    heard = "Whether e_stop must have been received before arming; false only in simulations."
    return [
        Row(
            "odom_rate",
            odom_rate,
            "Rate of odom [Hz].",
            (0.1, 1e4),
            shown="1 per control period, or more",
        ),
        Row(
            "scan_age",
            scan_age,
            "Oldest scan, also behind a command [s].",
            seconds,
            shown=f"{Default.scan_age_s:g}, or more for a slow lidar",
        ),
        Row("odom_age", Default.odom_age_s, "Oldest odometry [s].", seconds),
        Row("command_age", Default.command_age_s, "Oldest command [s].", seconds),
        Row(
            "rate_tolerance",
            Default.rate_tolerance,
            "Tolerance of both rates.",
            (0.01, 0.9),
        ),
        Row(
            "clock_rate",
            1.0,
            "Rate of stamps: simulated seconds per second.",
            (0.01, 100.0),
        ),
        Row("e_stop_required", True, heard),
        Row(
            "e_stop_silence",
            Default.e_stop_silence_s,
            "Silence of e_stop [s].",
            seconds,
        ),
        Row("estimate_required", True, "Whether arming needs odometry/filtered."),
        Row(
            "estimate_position",
            Default.estimate_position,
            "Greatest standard deviation that the estimated position may gain within 10 s [m].",
            (1e-3, 1e3),
        ),
        Row(
            "estimate_heading",
            Default.estimate_heading,
            "The same of the heading [rad].",
            (1e-3, 1e3),
        ),
        Row(
            "stop_when_held",
            Default.stop_when_held,
            "Whether to stop when the scans show none of the motion that odometry shows.",
        ),
    ]


SPLIT = {  # parameters of earlier versions: what they are now
    "estimate_std": "'estimate_position' [m] and 'estimate_heading' [rad], which count what the "
    "estimate became uncertain by within 10 s, but only since arming",
}
RULES_IN_SECONDS = ("scan_age", "odom_age", "command_age", "e_stop_silence")


FOREIGN = Row(
    "foreign_commands",
    "none",
    "Type of cmd_vel_raw from a controller that does not stamp it with its scan, like Nav2's: "
    "Twist or TwistStamped; the newest scan's age then counts. none: from the policy.",
)


def gate() -> list[Row]:
    """Returns all parameters of `command_gate`."""
    shield = [SHIELD, *SHIELD_NUMBERS]
    return [
        MODEL,
        LIMITS,
        *shield,
        *gate_rules(),
        stamped("cmd_vel"),
        ROBOT_FRAME,
        FOREIGN,
        BLACK_BOX,
        PRIORITY,
    ]


def drive() -> list[Row]:
    """Returns the parameters of `record_node`."""
    return [
        Row("robot", DEFAULT_ROBOT, "A shipped robot, or its YAML file."),
        Row("out", "drive.npz", "File *.npz of the recording, or folder of a rosbag2."),
        Row("bound", 2.0, "Radius of the circle around the start to stay within [m]."),
        Row("duration", 60.0, "Duration of the drive [s]."),
        Row("speed", 1.0, "Share of the greatest speeds to use."),
        Row("seed", 0, "Seed of the pattern."),
        Row("topics", "", "YAML file that names joints; none if empty."),
        Row(IMU, AUTO, "Topic of an IMU to record; auto: imu or imu/data; none."),
        Row("odom_timeout", 0.5, "Stops after this silence of odom [s].", (0.05, 10.0)),
        stamped("cmd_vel")._replace(name="stamped"),
    ]


class NodeFacts(NamedTuple):
    """All that a user has to know of a node."""

    about: str
    subscribes: Sequence[str]
    publishes: Sequence[str]
    services: Sequence[str]
    parameters: Sequence[Row]
    example: str  # after `--ros-args`


DRIVEN_BY = (
    "cmd_vel",
    "ackermann_cmd (of a robot that steers, with ackermann_msgs)",
    "initialpose",
)
TOLD = (
    "scan",
    "odom",
    "the model's further sensors",
    "joint_states",
    "ground_truth",
    "map",
    "/clock",
    "/tf, /tf_static (with tf2_msgs)",
    "/diagnostics",
)
SERVED = ("~/reset", "~/pause", "~/repeat", "~/touched")
HEARD = (
    "scan",
    "odom",
    "the model's further sensors",
    "cmd_vel",
    "pose (with pose_type)",
    "imu (or that of the parameter)",
)
NODES: dict[str, Callable[[], NodeFacts]] = {
    "simulator_node": lambda: NodeFacts(
        "A simulator behind the topics of the hardware.",
        DRIVEN_BY,
        TOLD,
        SERVED,
        [MODEL, ROBOTS, *device(), renderer("baked")],
        "-p world:=corridor -p odom_rate:=50.0",
    ),
    "mujoco_node": lambda: NodeFacts(
        "Robots in MuJoCo behind the topics of the hardware.",
        DRIVEN_BY,
        TOLD,
        SERVED,
        [MODEL, ROBOTS, *device(), renderer("exact"), FRICTION],
        "-p model:=mecanum -p world:=empty",
    ),
    "middleware_node": lambda: NodeFacts(
        "Caches a robot's topics and publishes the estimate of its state; a managed node.",
        (*HEARD, "initialpose"),
        ("odometry/filtered", "/tf (with tf2_msgs)", "/diagnostics"),
        ("~/reset",),
        [*managed(), *sensors(), *middleware()],
        "-p imu:=imu/data -r __ns:=/car",
    ),
    "policy_node": lambda: NodeFacts(
        "Drives a robot to goals by a policy, which answers each scan; a managed node.",
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
            *managed(),
            *sensors(),
            *policy(),
            *nav2(),
            *checkers(("general_goal_checker",), ("progress_checker",)),
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
            "the model's further sensors",
        ),
        ("cmd_vel", "/diagnostics"),
        ("~/arm", "~/reset", "~/e_stop"),
        gate(),
        f"-p limits:={DEFAULT_ROBOT}",
    ),
    "record_node": lambda: NodeFacts(
        "Drives a robot through its full range of motion and records it; the robot moves.",
        ("odom", "joint_states", "imu or imu/data", "pose"),
        ("cmd_vel",),
        (),
        drive(),
        "-p bound:=3.0 -p out:=drive.npz",
    ),
}
