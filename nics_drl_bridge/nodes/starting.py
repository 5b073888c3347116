"""The nodes that `nics up` and the launch files start, and their parameters; needs no ROS 2.

A launch is a list of parts. A part is a function that yields its nodes: `simulator`, `bridge`,
`description`. The parts of a launch determine its arguments. An empty argument leaves the value of
the parameter file, unless its description says otherwise.
"""

import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from nics_drl_bridge.config import (
    PACKAGE,
    find_config,
    list_shipped,
    parse_yaml,
    read_text,
    share_folder,
)
from nics_drl_bridge.errors import ConfigError, suggest
from nics_drl_bridge.nodes.parameters import BASE_FRAME, IMU, STAMPED, name_fleet
from nics_drl_bridge.robot import DEFAULT_ROBOT

FILE = Path(__file__).with_name("launches.yaml")
STATE_PUBLISHER = "robot_state_publisher"
RVIZ = "rviz2"
BASE_LINK = "base_link"  # base frame by default
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
FLAG_WORDS = {"true": True, "1": True, "false": False, "0": False, "": None}
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
        self.values: dict[str, Any] = dict(values)
        for name in FLAGS:
            word = self[name]
            if word.lower() not in FLAG_WORDS:
                raise ConfigError(
                    f"launch argument {name!r} is {word!r}; give true or false."
                )
            self.values[name] = FLAG_WORDS[word.lower()]
        file = self["params_file"]
        if file and not Path(file).is_file():
            raise ConfigError(f"params_file {file}: no such file; check the path.")
        self.model = self["model"] or DEFAULT_ROBOT
        shipped = share_folder() / "urdf" / f"{self.model}.urdf"
        self._opened: Any = None if shipped.is_file() else open_slowly(self.model)
        self.urdf = self["urdf"] or (str(shipped) if self._opened is None else "")
        space = self["namespace"].strip("/")
        self.fleet = parse_robots(self["robots"])
        self.whole = Robot(space, "", space)  # a single robot, or the simulator of all
        self.robots = [
            Robot(f"{space}/{name}".strip("/"), f"{name}/", space)
            for name in self.fleet
        ] or [self.whole]

    def __getitem__(self, name: str) -> Any:
        """Return an argument, a flag as True, False or None; "" if the launch does not have it."""
        return self.values.get(name, "")

    def choose_limits(self) -> str:
        """Return the gate's limits; by default the shipped limits of the given model, if any."""
        if self["limits"] or not self["model"]:
            return str(self["limits"])
        robot = self.model if self._opened is None else self._opened.robot.name
        return robot if robot in list_shipped("limits") else ""

    def describe_robot(self) -> str:
        """Return the URDF of the robot. Raises ConfigError if no argument names the robot."""
        own_file = self["params_file"] not in ("", str(find_config("bridge", "nodes")))
        if own_file and not (self["model"] or self["urdf"]):
            raise ConfigError(
                f"{STATE_PUBLISHER} has to know which robot it is; say model:=ROBOT or "
                "urdf:=FILE, or use_robot_state_pub:=false."
            )
        base = self[BASE_FRAME] or BASE_LINK
        laser = self["laser_frame"]
        shipped = base == BASE_LINK and laser in ("", SHIPPED_LASER)
        if self["urdf"] or (self.urdf and shipped):
            return read_text(self.urdf)
        from nics_drl_bridge.robot.urdf import make_urdf

        model = open_slowly(self.model) if self._opened is None else self._opened
        further = {sensor.frame: sensor.mount for sensor in model.sensors}
        return make_urdf(
            model.robot, model.lidar.mount, laser or model.lidar.frame, base, further
        )

    def start(
        self,
        package: str,
        executable: str,
        robot: Robot,
        parameters: Mapping[str, Any],
        arguments: Sequence[str] = (),
        remappings: Sequence[tuple[str, str]] = (),
    ) -> NodeStart:
        """Return a node with the given parameters; those that are empty or None are left out."""
        # As in Nav2, transforms stay in a namespace; a fleet shares one for transforms and map.
        alone = robot.transforms == robot.namespace
        place = "" if alone else f"/{robot.transforms}/".replace("//", "/")
        moved = TRANSFORMS if alone else (*TRANSFORMS, "map")
        return NodeStart(
            package=package,
            executable=executable,
            namespace=robot.namespace,
            parameters={
                name: value
                for name, value in parameters.items()
                if value not in (None, "")
            },
            params_file=self["params_file"] if package == PACKAGE else "",
            remappings=[
                *((name, f"{place}{name.strip('/')}") for name in moved),
                *remappings,
            ],
            arguments=arguments,
            log_level=self["log_level"],
        )


def simulator(setup: Setup) -> Iterator[NodeStart]:
    """Yield the simulator of all robots."""
    names = ["model", "world", BASE_FRAME, "laser_frame"]
    if setup["simulator"] == "dart":
        names.append("urdf")
    parameters = {
        "robots": list(setup.fleet) or 1,
        "episode_start": parse_start(setup["start"]),
        STAMPED: setup["stamped"],
        **{name: setup[name] for name in names},
    }
    executable = f"{setup['simulator']}_node"
    yield setup.start(PACKAGE, executable, setup.whole, parameters)


def bridge(setup: Setup) -> Iterator[NodeStart]:
    """Yield gate, middleware and policy of each robot."""
    managed = {name: setup[name] for name in ("autostart", IMU)}
    nodes: dict[str, dict[str, Any]] = {
        "command_gate": {
            "e_stop_required": setup["e_stop_required"] is not False,
            "limits": setup.choose_limits(),
        },
        "middleware_node": managed,
        "policy_node": {**managed, "policy": setup["policy"]},
    }
    for robot in setup.robots:
        frame = setup[BASE_FRAME]
        if robot.frames:
            frame = f"{robot.frames}{frame or BASE_LINK}"
        for node, parameters in nodes.items():
            shared = {
                "model": setup["model"],
                STAMPED: setup["stamped"],
                "use_sim_time": setup["use_sim_time"],
                BASE_FRAME: frame,
            }
            yield setup.start(PACKAGE, node, robot, {**shared, **parameters})


def description(setup: Setup) -> Iterator[NodeStart]:
    """Yield robot_state_publisher of each robot, and RViz, if requested."""
    timed = {"use_sim_time": setup["use_sim_time"]}
    if setup["use_robot_state_pub"]:
        drawn = setup.describe_robot()
        for robot in setup.robots:
            parameters = {
                **timed,
                "robot_description": drawn,
                "frame_prefix": robot.frames,
            }
            yield setup.start(STATE_PUBLISHER, STATE_PUBLISHER, robot, parameters)
    if setup["rviz"]:
        first = setup.robots[0]
        # the map is shared by all robots
        topics = [("/map", f"/{first.transforms}/map".replace("//", "/"))]
        topics += [(f"/{topic}", topic) for topic in SHOWN]
        yield setup.start(
            RVIZ, RVIZ, first, timed, ("-d", setup["rviz_config"]), topics
        )


@dataclass(frozen=True)
class Launch:
    """Parts that are started together; their arguments may have other defaults here."""

    about: str
    parts: Sequence[str]  # names in `PARTS`
    defaults: Values = field(default_factory=dict)
    left_out: Sequence[str] = ()  # names of arguments

    @property
    def arguments(self) -> list[Argument]:
        """The arguments that choose and configure the nodes."""
        groups = ["all", *self.parts]
        if "simulator" in self.parts or "bridge" in self.parts:
            groups.insert(1, "own_nodes")
        installed = "true" if find_prefix(STATE_PUBLISHER) else "false"
        arguments = []
        for group in groups:
            for name, entry in read_launches()["arguments"][group].items():
                default = entry.get("default", "")
                default = default.format(installed=installed, share=share_folder())
                default = self.defaults.get(name, default)
                choices = tuple(entry.get("choices", ()))
                argument = Argument(name, default, entry["about"], choices)
                if name not in self.left_out:
                    arguments.append(argument)
        return arguments

    def nodes(self, values: Values) -> list[NodeStart]:
        """Return the nodes for the given arguments. Raises BridgeError."""
        setup = Setup(complete(self.arguments, values))
        return list(chain.from_iterable(PARTS[part](setup) for part in self.parts))


@cache
def read_launches() -> dict[str, Any]:
    """Return the arguments by the parts that have them, and the launches by name."""
    return parse_yaml(read_text(FILE), str(FILE))


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


def open_slowly(model: str) -> Any:
    """Return an opened model; this takes seconds, so shipped models are not opened."""
    from nics_drl_bridge.generator import open_model

    return open_model(model)


def parse_robots(robots: str) -> tuple[str, ...]:
    """Return the namespaces of a fleet from a count or a list; none for one robot."""
    words = re.findall(r"[^\s,\[\]'\"]+", robots)
    if not robots:
        return ()
    if robots.count("[") != robots.count("]"):
        raise ConfigError(f"'robots' is {robots!r}; close the list, as in [ant, bee].")
    is_count = len(words) == 1 and words[0].isdecimal()
    names = name_fleet(int(words[0]) if is_count else words)
    return names if any(names) else ()


def parse_start(start: str) -> list[float] | None:
    """Return x, y, heading of each robot; None if left empty. Raises ConfigError."""
    words = re.findall(r"[^\s,\[\]]+", start)
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = [0.0]
    if len(numbers) % 3:
        raise ConfigError(
            f"launch argument 'start' is {start!r}; give x, y, heading [m, rad] of each robot, "
            "as in start:='[1.0, 0.0, 1.57]'."
        )
    return numbers or None


def find_prefix(package: str) -> Path | None:
    """Return the folder in which a ROS 2 package is installed, or None."""
    folders = [*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]
    for folder in map(Path, filter(None, folders)):
        if (
            folder / "share" / "ament_index" / "resource_index" / "packages" / package
        ).is_file():
            return folder
    return None


PARTS = {"simulator": simulator, "bridge": bridge, "description": description}


LAUNCHES = {
    name: Launch(**entry) for name, entry in read_launches()["launches"].items()
}
"""Every launch by name, for `nics up` and the files in `launch/`."""
