"""The nodes that `nics up` and the launch files start, and their parameters; needs no ROS 2.

A launch is a list of arguments and of functions, each of which yields the nodes of one part:
`simulator`, `bridge`, `description`. An empty argument leaves the value of the parameter
file, unless its description says otherwise.
"""

import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from nics_drl_bridge.config import (
    PACKAGE,
    find_config,
    list_shipped,
    read_text,
    share_folder,
)
from nics_drl_bridge.errors import ConfigError, suggest
from nics_drl_bridge.nodes.parameters import (
    BASE_FRAME,
    IMU,
    MODEL,
    STAMPED,
    name_fleet,
)

STATE_PUBLISHER = "robot_state_publisher"
RVIZ = "rviz2"
SHIPPED_LASER = "laser"  # frame of the lidar in the URDFs of the shipped robots
TRANSFORMS = ("/tf", "/tf_static")
# RViz names topics absolutely; here they are remapped to the robot's namespace.
SHOWN = (
    "scan",
    "odom",
    "odometry/filtered",
    "ground_truth",
    "goal_pose",
    "robot_description",
)

FLAGS = (
    "autostart",
    "e_stop_required",
    "rviz",
    "stamped",
    "use_robot_state_pub",
    "use_sim_time",
)
FLAG_WORDS = {"true": "true", "1": "true", "false": "false", "0": "false", "": ""}
Values = Mapping[str, str]  # of the arguments, by name


@dataclass(frozen=True)
class Argument:
    """An argument `name:=value` of a launch."""

    name: str
    default: str
    about: str
    choices: tuple[str, ...] = ()


@dataclass(frozen=True)
class NodeStart:
    """A node to start."""

    package: str
    executable: str  # also the name of the node
    namespace: str
    parameters: Mapping[str, Any]  # text, numbers, booleans, or lists of one kind
    params_file: str = ""  # `parameters` take precedence over it; empty: none
    remappings: Sequence[tuple[str, str]] = ()
    arguments: Sequence[str] = ()  # words of the command line before those of ROS 2
    log_level: str = ""

    @property
    def own(self) -> bool:
        """True for a node of this package."""
        return self.package == PACKAGE


class Robot(NamedTuple):
    """A robot and the namespaces of its names."""

    namespace: str  # of its topics
    frames: str  # prefix of its frames
    transforms: str  # namespace of its `tf` and `tf_static`


class Setup:
    """The settings from the arguments; what they leave open is up to the nodes and their file."""

    def __init__(self, values: Values) -> None:
        self.values = dict(values)
        # What is wrong is refused here, before any node is started.
        for name in FLAGS:
            word = self[name]
            if word.lower() not in FLAG_WORDS:
                raise ConfigError(
                    f"launch argument {name!r} is {word!r}; give true or false."
                )
            self.values[name] = FLAG_WORDS[word.lower()]
        for name in ("params_file", "urdf", "policy"):
            file = self[name]
            is_file = name != "policy" or file.endswith((".onnx", ".yaml", ".yml"))
            if file and is_file and not Path(file).is_file():
                raise ConfigError(f"{name} {file}: no such file; check the path.")
        if self["world"] and self["world"] not in list_shipped("worlds"):
            from nics_drl_bridge.sim.world_set import load_worlds

            load_worlds(self["world"])  # it takes a second
        self.model = self["model"] or str(MODEL.default)
        shipped = share_folder() / "urdf" / f"{self.model}.urdf"
        self._opened: Any = None if shipped.is_file() else opened(self.model)
        self.urdf = self["urdf"] or (str(shipped) if self._opened is None else "")
        self.simulator = f"{self['simulator']}_node"
        space = self["namespace"].strip("/")
        self.fleet = names_of(self["robots"])
        self.robots = [Robot(space, "", space)]
        if self.fleet:
            self.robots = [
                Robot(f"{space}/{n}".strip("/"), f"{n}/", space) for n in self.fleet
            ]

    def __getitem__(self, name: str) -> str:
        """Return an argument; empty if it was left empty or the launch does not have it."""
        return self.values.get(name, "")

    def text(self, name: str) -> str | None:
        """Return an argument, or None if it was left empty."""
        return self[name] or None

    def flag(self, name: str) -> bool | None:
        """Return an argument that is true or false, or None if it was left empty."""
        return self[name] == "true" if self[name] else None

    def limits(self) -> str:
        """Return the gate's limits; by default the shipped limits of the given model, if any."""
        if self["limits"] or not self["model"]:
            return self["limits"]
        robot = self.model if self._opened is None else self._opened.robot.name
        return robot if robot in list_shipped("limits") else ""

    def frame(self, robot: Robot) -> str | None:
        """Return the base frame of a robot; None if a single robot's was left empty."""
        base = self[BASE_FRAME.name]
        if not robot.frames:
            return base or None
        return f"{robot.frames}{base or BASE_FRAME.default}"

    def description(self) -> str:
        """Return the URDF of the robot. Raises ConfigError if no argument names the robot."""
        own_file = self["params_file"] not in ("", find_shipped_parameters())
        if own_file and not (self["model"] or self["urdf"]):
            fix = "say model:=ROBOT or urdf:=FILE, or use_robot_state_pub:=false"
            raise ConfigError(
                f"{STATE_PUBLISHER} has to know which robot it is; {fix}."
            )
        base = self[BASE_FRAME.name] or str(BASE_FRAME.default)
        laser = self["laser_frame"]
        shipped = base == BASE_FRAME.default and laser in ("", SHIPPED_LASER)
        if self["urdf"] or (self.urdf and shipped):
            return read_text(self.urdf)
        from nics_drl_bridge.robot.urdf import make_urdf

        model = opened(self.model) if self._opened is None else self._opened
        further = {sensor.frame: sensor.mount for sensor in model.sensors}
        return make_urdf(
            model.robot, model.lidar.mount, laser or model.lidar.frame, base, further
        )

    def node(
        self,
        package: str,
        executable: str,
        robot: Robot,
        parameters: Mapping[str, Any],
        arguments: Sequence[str] = (),
        remappings: Sequence[tuple[str, str]] = (),
    ) -> NodeStart:
        """Return a node with the given parameters; those that are None are left out."""
        # As in Nav2, transforms stay in a namespace; a fleet shares one for transforms and map.
        alone = robot.transforms == robot.namespace
        place = "" if alone else f"/{robot.transforms}/".replace("//", "/")
        moved = TRANSFORMS if alone else (*TRANSFORMS, "map")
        return NodeStart(
            package=package,
            executable=executable,
            namespace=robot.namespace,
            parameters={
                name: value for name, value in parameters.items() if value is not None
            },
            params_file=self["params_file"] if package == PACKAGE else "",
            remappings=[
                *((name, f"{place}{name.strip('/')}") for name in moved),
                *remappings,
            ],
            arguments=arguments,
            log_level=self["log_level"],
        )


Part = Callable[[Setup], Iterator[NodeStart]]


@dataclass(frozen=True)
class Launch:
    """Parts that are started together, and the arguments that select them."""

    about: str
    parts: Sequence[Part]
    arguments: Sequence[Argument]
    simulated: bool = False

    def nodes(self, values: Values) -> list[NodeStart]:
        """Return the nodes for the given arguments. Raises BridgeError."""
        setup = Setup(complete(self.arguments, values))
        return list(chain.from_iterable(part(setup) for part in self.parts))


def complete(arguments: Sequence[Argument], chosen: Values) -> dict[str, str]:
    """Return the values of all arguments. Raises ConfigError for an unknown name or choice."""
    names = {argument.name for argument in arguments}
    for name in chosen:
        if name not in names:
            raise ConfigError(f"unknown argument {name!r}; {suggest(name, names)}")
    values: dict[str, str] = {}
    for argument in arguments:
        value = chosen.get(argument.name, argument.default)
        if argument.choices and value not in argument.choices:
            hint = suggest(value, argument.choices)
            raise ConfigError(f"launch argument {argument.name!r} is {value!r}; {hint}")
        values[argument.name] = value
    return values


def opened(model: str) -> Any:
    """Return an opened model; this takes seconds, so shipped models are not opened."""
    from nics_drl_bridge.generator import open_model

    return open_model(model)


def names_of(robots: str) -> tuple[str, ...]:
    """Return the namespaces of a fleet from a count or a list; none for one robot."""
    words = re.findall(r"[^\s,\[\]'\"]+", robots)
    if not robots:
        return ()
    if robots.count("[") != robots.count("]"):
        raise ConfigError(f"'robots' is {robots!r}; close the list, as in [ant, bee].")
    is_count = len(words) == 1 and words[0].isdecimal()
    names = name_fleet(int(words[0]) if is_count else words)
    return names if any(names) else ()


def numbers_of(start: str) -> list[float] | None:
    """Return x, y, heading of each robot; None if left empty. Raises ConfigError."""
    words = re.findall(r"[^\s,\[\]]+", start)
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = [0.0]
    if len(numbers) % 3:
        fix = (
            "give x, y, heading [m, rad] of each robot, as in start:='[1.0, 0.0, 1.57]'"
        )
        raise ConfigError(f"launch argument 'start' is {start!r}; {fix}.")
    return numbers or None


def simulator(setup: Setup) -> Iterator[NodeStart]:
    """Yield the simulator of all robots."""
    robots: Any = list(setup.fleet) or 1
    space = setup["namespace"].strip("/")
    parameters = {
        "model": setup.text("model"),
        "world": setup.text("world"),
        "robots": robots,
        "episode_start": numbers_of(setup["start"]),
        STAMPED: setup.flag("stamped"),
        BASE_FRAME.name: setup.text(BASE_FRAME.name),
        "laser_frame": setup.text("laser_frame"),
    }
    if setup["simulator"] == "dart":
        parameters["urdf"] = setup.text("urdf")
    yield setup.node(PACKAGE, setup.simulator, Robot(space, "", space), parameters)


def bridge(setup: Setup) -> Iterator[NodeStart]:
    """Yield gate, middleware and policy of each robot."""
    shared = {
        "model": setup.text("model"),
        STAMPED: setup.flag("stamped"),
        "use_sim_time": setup.flag("use_sim_time"),
    }
    required = setup.flag("e_stop_required")
    of_gate = {
        "e_stop_required": True if required is None else required,
        "limits": setup.limits() or None,
    }
    managed = {"autostart": setup.flag("autostart"), IMU: setup.text(IMU)}
    of_policy = {"policy": setup.text("policy")}
    nodes: dict[str, dict[str, Any]] = {
        "command_gate": of_gate,
        "middleware_node": managed,
        "policy_node": {**managed, **of_policy},
    }
    for robot in setup.robots:
        for node, parameters in nodes.items():
            frame = {BASE_FRAME.name: setup.frame(robot)}
            yield setup.node(PACKAGE, node, robot, {**shared, **parameters, **frame})


def description(setup: Setup) -> Iterator[NodeStart]:
    """Yield robot_state_publisher of each robot, and RViz, if requested."""
    timed = {"use_sim_time": setup.flag("use_sim_time")}
    if setup.flag("use_robot_state_pub"):
        drawn = setup.description()
        for robot in setup.robots:
            parameters = {
                **timed,
                "robot_description": drawn,
                "frame_prefix": robot.frames or None,
            }
            yield setup.node(STATE_PUBLISHER, STATE_PUBLISHER, robot, parameters)
    if setup.flag("rviz"):
        first = setup.robots[0]
        # the map is shared by all robots
        topics = [("/map", f"/{first.transforms}/map".replace("//", "/"))]
        topics += [(f"/{topic}", topic) for topic in SHOWN]
        yield setup.node(RVIZ, RVIZ, first, timed, ("-d", setup["rviz_config"]), topics)


def common(use_sim_time: str) -> list[Argument]:
    """Return the arguments of every launch."""
    return [
        Argument(
            "model", "", "Shipped robot, or folder of a model; empty: from params_file"
        ),
        Argument("namespace", "", "Namespace of the robot, or of the fleet"),
        Argument(BASE_FRAME.name, "", "Frame of the robot; empty: from params_file"),
        Argument("use_sim_time", use_sim_time, "Use /clock"),
        Argument("log_level", "info", "Log level of all nodes"),
    ]


def find_shipped_parameters() -> str:
    """Return the path of the parameter file that is used by default."""
    return str(find_config("bridge", "nodes"))


def of_nodes() -> list[Argument]:
    """Return the arguments of every launch that starts nodes of this package."""
    stamped = (
        "Use TwistStamped for cmd_vel; "
        "empty: params_file, else TwistStamped on Kilted and newer"
    )
    return [
        Argument("params_file", find_shipped_parameters(), "Parameters of all nodes"),
        Argument("stamped", "", stamped),
    ]


def of_simulator(robots: str = "1") -> list[Argument]:
    """Return the arguments of a simulator."""
    kinds = ("simulator", "mujoco", "dart")
    start = "Start x, y, heading [m, m, rad] of each robot; empty: drawn at random"
    return [
        Argument("simulator", kinds[0], "The fast simulator, MuJoCo or DART", kinds),
        Argument("world", "", "Shipped world, or a YAML file; empty: from params_file"),
        Argument(
            "robots", robots, "Number of robots, or their namespaces, as in '[a, b]'"
        ),
        Argument("start", "", start),
        Argument("laser_frame", "", "Frame of the lidar; empty: from params_file"),
    ]


def of_bridge() -> list[Argument]:
    """Return the arguments of gate, middleware and policy, except the emergency stop."""
    limits = (
        "Limits of the gate; empty: those of the model, if given, else from params_file"
    )
    return [
        Argument(
            "policy", "", "Policy file, or name of a policy; empty: from params_file"
        ),
        Argument("limits", "", limits),
        Argument(
            "autostart",
            "true",
            "Configure and activate the managed nodes automatically",
        ),
        Argument(IMU, "", "Topic of the gyro, auto or none; empty: from params_file"),
    ]


def e_stop_required(default: str) -> Argument:
    """Return the argument for the emergency stop."""
    return Argument(
        "e_stop_required",
        default,
        "Require e_stop: if never received, it counts as pressed; empty: true",
    )


def of_description() -> list[Argument]:
    """Return the arguments of the description, which draws a robot in RViz."""
    installed = "true" if find_prefix(STATE_PUBLISHER) else "false"
    view = str(share_folder() / "config" / "rviz" / "bridge.rviz")
    return [
        Argument("use_robot_state_pub", installed, "Start robot_state_publisher"),
        Argument("urdf", "", "URDF file of the robot; empty: the model's"),
        Argument("rviz", "false", "Start RViz"),
        Argument("rviz_config", view, "Configuration file for RViz"),
    ]


def find_prefix(package: str) -> Path | None:
    """Return the folder in which a ROS 2 package is installed, or None."""
    folders = [*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]
    for folder in map(Path, filter(None, folders)):
        if (
            folder / "share" / "ament_index" / "resource_index" / "packages" / package
        ).is_file():
            return folder
    return None


def whole_simulation(robots: str = "1") -> Launch:
    """Return a simulator and, on its topics, everything that runs on a vehicle."""
    arguments = [*common("true"), *of_nodes(), *of_simulator(robots), *of_bridge()]
    return Launch(
        "Several robots in one simulator, each with gate, middleware and policy."
        if robots != "1"
        else "A simulator and, on its topics, everything that runs on a vehicle.",
        [simulator, bridge, description],
        [*arguments, e_stop_required("false"), *of_description()],
        simulated=True,
    )


LAUNCHES: dict[str, Callable[[], Launch]] = {
    "simulation": whole_simulation,
    # Without any `e_stop` message, a vehicle stays stopped.
    "vehicle": lambda: Launch(
        "Gate, middleware and policy of a vehicle; start the drivers of lidar and base separately.",
        [bridge, description],
        [*common("false"), *of_nodes(), *of_bridge(), *of_description()],
    ),
    "fleet": lambda: whole_simulation(robots="2"),
    "simulator": lambda: Launch(
        "Only a simulator, to be driven through cmd_vel from elsewhere.",
        [simulator, description],
        [*common("true"), *of_nodes(), *of_simulator(), *of_description()],
        simulated=True,
    ),
    "bridge": lambda: Launch(
        "Gate, middleware and policy on the topics of a robot.",
        [bridge],
        [*common("false"), *of_nodes(), *of_bridge(), e_stop_required("true")],
    ),
    "description": lambda: Launch(
        "The description of a robot: robot_state_publisher with its URDF, and RViz.",
        [description],
        [*common("false"), *of_description()],
    ),
}
"""Every launch by name, for `nics up` and the files in `launch/`."""
