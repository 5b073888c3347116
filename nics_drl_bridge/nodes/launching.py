"""Launch descriptions of what `starting` describes, for the launch files in `launch/` and your own.

A launch file of your own takes a whole launch, as `describe(whole_simulation())`, or puts parts
and arguments together, as `describe(Launch("...", [bridge], [*common("false"), *of_bridge()]))`.
"""

from typing import Any

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, TextSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription
from nics_drl_bridge.nodes.starting import (
    LAUNCHES,
    Argument,
    Launch,
    NodeStart,
    bridge,
    common,
    description,
    e_stop_required,
    of_bridge,
    of_description,
    of_nodes,
    of_simulator,
    simulator,
    whole_simulation,
)

__all__ = [
    "LAUNCHES",
    "Argument",
    "Launch",
    "bridge",
    "common",
    "describe",
    "description",
    "e_stop_required",
    "of_bridge",
    "of_description",
    "of_nodes",
    "of_simulator",
    "simulator",
    "whole_simulation",
]


class Robot(NamedTuple):
    """A robot, and where its names lie."""

    namespace: str  # of its topics
    frames: str  # put before its frames
    transforms: str  # namespace of its `tf` and `tf_static`


class Setup:
    """The request that launch arguments and the file of parameters make together."""

    def __init__(self, values: Values) -> None:
        self.values = values | {
            name: flag_of(name, values.get(name, "")) for name in FLAGS
        }
        self._file = (
            parse_yaml(read_text(file), file) if (file := self["params_file"]) else {}
        )
        self.model = self["model"] or str(self._of_file("model", "") or MODEL.default)
        shipped = share_folder() / "urdf" / f"{self.model}.urdf"
        self._opened: Any = None if shipped.is_file() else opened(self.model)
        self.urdf = self["urdf"] or (str(shipped) if self._opened is None else "")
        self.simulator = f"{self['simulator']}_node"
        space = self["namespace"].strip("/")
        given = self["robots"] or self._of_file("robots", self.simulator)
        self.fleet = names_of(given) if given and "robots" in values else ()
        self.robots = [
            Robot(f"{space}/{n}".strip("/"), f"{n}/", space) for n in self.fleet
        ]
        self.robots = self.robots or [Robot(space, "", space)]

    def __getitem__(self, name: str) -> str:
        """Returns an argument; empty if it was left so, or is none of the file that is launched."""
        return self.values.get(name, "")

    def _of_file(self, name: str, node: str) -> Any:
        """Returns what the file of parameters says of one, for a node in any namespace."""
        found = None
        for key in ("/**", f"/**/{node}", node, f"/{node}") if node else ("/**",):
            found = (
                (self._file.get(key) or {}).get("ros__parameters", {}).get(name, found)
            )
        return found

    def limits(self) -> str:
        """Returns the gate's limits; where a model was given, those that are shipped for it."""
        if self["limits"] or not self["model"]:
            return self["limits"]
        robot = self.model if self._opened is None else self._opened.robot.name
        return (
            robot
            if (share_folder() / "config" / "limits" / f"{robot}.yaml").is_file()
            else ""
        )

    def frame(self, node: str, robot: Robot) -> Any:
        """Returns the frame of a robot of a fleet; empty for one robot, whose file names it."""
        base = self._of_file(BASE_FRAME.name, node) or BASE_FRAME.default
        return f"{robot.frames}{base}" if robot.frames else ""

    def description(self) -> str:
        """Returns the URDF of the robot, with the frames that the file of parameters names."""
        base = str(self._of_file(BASE_FRAME.name, self.simulator) or BASE_FRAME.default)
        laser = str(self._of_file("laser_frame", self.simulator) or "")
        shipped = base == BASE_FRAME.default and laser in ("", SHIPPED_LASER)
        if self["urdf"] or (self.urdf and shipped):
            return read_text(self.urdf)
        from nics_drl_bridge.robot.urdf import urdf_of

        model = opened(self.model) if self._opened is None else self._opened
        further = {sensor.frame: sensor.mount for sensor in model.sensors}
        return urdf_of(
            model.robot, model.lidar.mount, laser or model.lidar.frame, base, further
        )

    def node(
        self,
        package: str,
        name: str,
        robot: Robot,
        parameters: dict[str, Any],
        words: Sequence[str] = (),
        remapped: Sequence[tuple[str, str]] = (),
        **more: Any,
    ) -> Node:
        """Returns a node with the parameters that are given, of ours over those of the file."""
        # As in Nav2, transforms stay in a namespace; those of a fleet, and its map, in that of all.
        own = robot.transforms == robot.namespace
        place = "" if own else f"/{robot.transforms}/".replace("//", "/")
        moved = TRANSFORMS if own else (*TRANSFORMS, "map")
        remapped = [*((each, f"{place}{each.strip('/')}") for each in moved), *remapped]
        files = [self["params_file"]] if package == PACKAGE else []
        return Node(
            package=package,
            executable=name,
            name=name,
            namespace=robot.namespace,
            parameters=[*files, {k: v for k, v in parameters.items() if v is not None}],
            remappings=remapped,
            arguments=[*words, "--ros-args", "--log-level", self["log_level"]],
            output="screen",
            **more,
        )


def opened(model: str) -> Any:
    """Returns an opened model; it takes seconds, so only what is not shipped is opened."""
    from nics_drl_bridge.generator import open_model

    return open_model(model)


def value(given: str, kind: Any = str) -> Any:
    """Returns a parameter of a type, whatever its text looks like; None if it was left empty."""
    return (
        ParameterValue(TextSubstitution(text=given), value_type=kind) if given else None
    )


def flag_of(name: str, given: str) -> str:
    """Returns `true` or `false` of an argument, or nothing if it was left empty. ConfigError."""
    words = {"true": "true", "1": "true", "false": "false", "0": "false", "": ""}
    if given.lower() not in words:  # refused here, before any node is started
        raise ConfigError(f"launch argument {name!r} is {given!r}; give true or false.")
    return words[given.lower()]


def names_of(robots: Any) -> tuple[str, ...]:
    """Returns the namespaces of a fleet by a count or their list; none for one robot."""
    if not isinstance(robots, str):
        words = (
            [str(each) for each in robots]
            if isinstance(robots, list)
            else [str(robots)]
        )
    else:
        words = re.findall(r"[^\s,\[\]'\"]+", robots)
    if len(words) == 1 and words[0].isdecimal():
        if (count := int(words[0])) < 1:
            fix = "give a count from 1, or namespaces, as in robots:='[ant, bee]'"
            raise ConfigError(f"launch argument 'robots' is {count}; {fix}.")
        return tuple(f"robot{k + 1}" for k in range(count)) if count > 1 else ()
    if twice := {word for word in words if words.count(word) > 1}:
        raise ConfigError(
            f"launch argument 'robots' names {min(twice)!r} twice; name each once."
        )
    return tuple(words)


def numbers_of(start: str) -> list[float] | None:
    """Returns the numbers x, y, heading of each robot; None if it was left empty. ConfigError."""
    words = re.findall(r"[^\s,\[\]]+", start)
    try:
        found = [float(word) for word in words]
    except ValueError:
        found = [0.0]
    if len(found) % 3:
        fix = (
            "give x, y, heading [m, rad] of each robot, as in start:='[1.0, 0.0, 1.57]'"
        )
        raise ConfigError(f"launch argument 'start' is {start!r}; {fix}.")
    return found or None


def simulator(setup: Setup) -> Iterator[Any]:
    """Starts the simulator of all robots."""
    space = setup["namespace"].strip("/")
    robots = value(setup["robots"] and "1", int)
    if setup.fleet:
        robots = value(str(list(setup.fleet)), list[str])
    given = {
        "model": value(setup["model"]),
        "world": value(setup["world"]),
        "robots": robots,
        "episode_start": numbers_of(setup["start"]),
        STAMPED: value(setup["stamped"], bool),
    }
    yield setup.node(PACKAGE, setup.simulator, Robot(space, "", space), given)


def bridge(setup: Setup) -> Iterator[Any]:
    """Starts gate, middleware and policy of each robot."""
    shared = {"model": value(setup["model"]), STAMPED: value(setup["stamped"], bool)}
    shared["use_sim_time"] = value(setup["use_sim_time"], bool)
    managed = shared | {
        "autostart": value(setup["autostart"], bool),
        IMU: value(setup[IMU]),
    }
    required = value(setup["e_stop_required"] or "true", bool)
    gate = shared | {"e_stop_required": required, "limits": value(setup.limits())}
    named = {"policy": value(setup["policy"])}
    for robot in setup.robots:
        framed = {BASE_FRAME.name: value(setup.frame("command_gate", robot))}
        yield setup.node(PACKAGE, "command_gate", robot, gate | framed)
        for node, own in (("middleware_node", {}), ("policy_node", named)):
            frame = {BASE_FRAME.name: value(setup.frame(node, robot))}
            yield setup.node(PACKAGE, node, robot, managed | own | frame)


def description(setup: Setup) -> Iterator[Any]:
    """Starts robot_state_publisher of each robot, and RViz."""
    timed = {"use_sim_time": value(setup["use_sim_time"], bool)}
    wanted = IfCondition(setup["use_robot_state_pub"] or "false")
    for robot in setup.robots:
        given = timed | {
            "robot_description": value(setup.description()),
            "frame_prefix": value(robot.frames),
        }
        yield setup.node(
            STATE_PUBLISHER, STATE_PUBLISHER, robot, given, condition=wanted
        )
    topics = [
        ("/map", f"/{setup.robots[0].transforms}/map".replace("//", "/"))
    ]  # of all robots
    topics += [(f"/{topic}", topic) for topic in SHOWN]
    words = ("-d", setup["rviz_config"])
    wanted = IfCondition(setup["rviz"] or "false")
    yield setup.node(
        "rviz2", "rviz2", setup.robots[0], timed, words, topics, condition=wanted
    )


def launched(
    starts: Sequence[Start], arguments: Sequence[DeclareLaunchArgument]
) -> Any:
    """Returns a launch description of these arguments, which then starts what they request."""

    def start(context: Any) -> list[Any]:
        names = [argument.name for argument in launch.arguments]
        given = {name: context.launch_configurations[name] for name in names}
        return [action_of(node) for node in launch.nodes(given)]

    declared = [declaration_of(argument) for argument in launch.arguments]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])


def declaration_of(argument: Argument) -> DeclareLaunchArgument:
    """Returns an argument as `launch` declares it."""
    default: Any = argument.default
    if argument.same_as:
        default = LaunchConfiguration(argument.same_as)
    return DeclareLaunchArgument(
        argument.name,
        default_value=default,
        description=argument.about,
        choices=list(argument.choices) or None,
    )


def argument(name: str, default: Any, about: str, **more: Any) -> DeclareLaunchArgument:
    """Returns an argument of a launch file."""
    return DeclareLaunchArgument(name, default_value=default, description=about, **more)


def common(use_sim_time: str) -> list[Any]:
    """Returns the arguments of every launch file."""
    return [
        argument(
            "model", "", "Shipped robot, or folder of a model; empty: of params_file"
        ),
        argument("namespace", "", "Of the robot, or of the fleet"),
        argument("use_sim_time", use_sim_time, "Use /clock"),
        argument("log_level", "info", "Of all nodes"),
    ]


def of_nodes() -> list[Any]:
    """Returns the arguments of every launch file that starts nodes of ours."""
    file = str(find_config("bridge", "nodes"))
    return [
        argument("params_file", file, "Parameters of all nodes"),
        argument(
            "stamped",
            "",
            "cmd_vel is a TwistStamped; empty: of params_file, or as usual",
        ),
    ]


def of_simulator(robots: str = "") -> list[Any]:
    """Returns the arguments of a simulator."""
    kinds = ["simulator", "mujoco"]
    start = "x, y, heading [m, rad] of each robot; empty: drawn"
    return [
        argument("simulator", kinds[0], "The fast simulator, or MuJoCo", choices=kinds),
        argument("world", "", "Shipped world, or a YAML file; empty: of params_file"),
        argument("robots", robots, "How many, or their namespaces, as '[a, b]'"),
        argument("start", "", start),
    ]


def of_bridge() -> list[Any]:
    """Returns the arguments of gate, middleware and policy, but for the emergency stop."""
    return [
        argument(
            "policy", "", "Policy file, or a policy by name; empty: of params_file"
        ),
        argument(
            "limits",
            "",
            "Of the gate; empty: of the model, if given, or of params_file",
        ),
        argument(
            "autostart", "true", "Managed nodes configure and activate themselves"
        ),
        argument(IMU, "", "Topic of the gyro, auto or none; empty: of params_file"),
    ]


def e_stop_required(default: str) -> Any:
    """Returns the argument for the emergency stop."""
    return argument(
        "e_stop_required", default, "An e_stop that was never heard counts as pressed"
    )


def parameter_of(value: Any) -> Any:
    """Returns a parameter; a text stays one, whatever it looks like."""
    if isinstance(value, str):
        return ParameterValue(TextSubstitution(text=value), value_type=str)
    if isinstance(value, list) and all(isinstance(each, str) for each in value):
        return ParameterValue(TextSubstitution(text=str(value)), value_type=list[str])
    return value
