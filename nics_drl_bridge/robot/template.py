"""Templates: defaults of a kind of robot, which a robot's file may omit."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any

from nics_drl_bridge.errors import ConfigError, suggest

Part = Mapping[str, Any]  # a part of a robot's file
Ranges = Mapping[str, tuple[float, float]]
# Unit, and range in both directions, of a component of the body twist in the state
TWIST_RANGES = {"vx": ("m/s", 10.0), "vy": ("m/s", 10.0), "wz": ("rad/s", 10.0)}
# Range of a state that has a command in its own unit, as a multiple of the command's range
STATE_RANGE_FACTOR = 2.0
# Minimum similarity of a misspelt parameter: "steering_rate" is not "steering_lag"
MISSPELT_PARAMETER = 0.85
RATIO_RANGE = 1.0  # range of a command without a unit, in both directions


def make_command(
    name: str, unit: str, limit: float, field: str | None = None
) -> dict[str, Any]:
    """Returns a command of a template, with a range of `limit` in both directions."""
    command = {"name": name, "unit": unit, "min": -limit, "max": limit}
    if field is not None:
        command["cmd_vel"] = field
    return command


TWIST = (
    make_command("forward_command", "m/s", 1.0, "linear.x"),
    make_command("turn_command", "rad/s", 2.0, "angular.z"),
)
SIDEWAYS = make_command("left_command", "m/s", 1.0, "linear.y")
STEERED = (
    make_command("speed_command", "m/s", 1.0, "linear.x"),
    make_command("steering_command", "rad", 0.5, "angular.z"),
)
# Each follows the command with this field, whatever the command's name.
STEERED_STATE = (
    {"name": "speed", "unit": "m/s", "cmd_vel": "linear.x"},
    {"name": "steering", "unit": "rad", "cmd_vel": "angular.z"},
)
LAGS = {"wheel_lag": 0.1}
STEERED_LAGS = {"speed_lag": 0.1, "steering_lag": 0.1}
WHEELS = (
    make_command("left_wheel", "rad/s", 10.0),
    make_command("right_wheel", "rad/s", 10.0),
)
FOUR_WHEELS = (
    make_command("front_left_wheel", "rad/s", 10.0),
    make_command("front_right_wheel", "rad/s", 10.0),
    make_command("rear_left_wheel", "rad/s", 10.0),
    make_command("rear_right_wheel", "rad/s", 10.0),
)


def list_names(commands: Sequence[Part]) -> tuple[str, ...]:
    """Returns the names of commands."""
    return tuple(command["name"] for command in commands)


@dataclass(frozen=True)
class Template:
    """Default parts of a robot of one kind, in the form of its file."""

    # Sets of commands for such a robot, the usual set first; empty if it may have any commands
    commands: tuple[tuple[Part, ...], ...] = ()
    moves: tuple[str, ...] = ()  # components of the body twist that are states
    state: tuple[Part, ...] = ()  # states that follow commands
    parameters: Mapping[str, float] = field(default_factory=dict)
    # Further parameters, in radii of the footprint
    lengths: Mapping[str, float] = field(default_factory=dict)
    # Names of its commands by synonym, from which `nics inspect` guesses the kind
    words: Mapping[str, str] = field(default_factory=dict)

    def fill(self, robot: Part, ranges: Ranges) -> dict[str, Any]:
        """Returns a robot's complete file. Raises ConfigError if it has unknown names."""
        kind = robot["kind"]
        data = {"name": kind, **robot, "textbook": kind}
        del data["kind"]
        command = self._fill_command(robot, ranges)
        data["command"] = command
        if _is_mappings(command):
            data["state"] = self._fill_state(robot.get("state"), command)
        parameters = robot.get("parameters", {})
        radius = robot.get("footprint_radius")
        if not isinstance(parameters, Mapping) or not isinstance(radius, int | float):
            return data
        defaults = {name: round(k * radius, 4) for name, k in self.lengths.items()}
        defaults |= self.parameters
        missing = defaults.keys() - parameters.keys()
        for name in parameters:  # any name is allowed unless it looks misspelt
            if get_close_matches(str(name), missing, 1, MISSPELT_PARAMETER):
                raise ConfigError(
                    f"robot {data['name']!r}: unknown parameter {name!r}; "
                    f"{suggest(name, defaults)}"
                )
        data["parameters"] = {**defaults, **parameters}
        data["assumed"] = sorted(missing)
        return data

    def _fill_command(self, robot: Part, ranges: Ranges) -> Any:
        kind = robot["kind"]
        command = robot.get("command")
        if command is not None and not _is_mappings(command):
            return command  # validation of the whole file reports it
        names: list[Any] = list(ranges)
        if command is not None:
            names = [part.get("name") for part in command]
        units = [part.get("unit") for part in command or ()]

        def count_matches(commands: Sequence[Part]) -> int:
            return sum(c["name"] in names or c["unit"] in units for c in commands)

        usual = max(self.commands, key=count_matches, default=())
        by_name = {part["name"]: part for part in usual}
        by_name |= {part["name"].removesuffix("_command"): part for part in usual}
        if command is None and usual and ranges:
            fits = all(by_name.get(name) in usual for name in names)
            if not fits or len(usual) != len(names):
                needed = _join_names(n for n in by_name if not n.endswith("_command"))
                raise ConfigError(
                    f"robot {robot.get('name', kind)!r}: commands of the kind {kind!r} "
                    f"are {needed}, not {_join_names(names)}; use these names, or list "
                    "yours in that order under `command:` of the robot."
                )
        if command is None:
            command = [{"name": name} for name in (names or list_names(usual))]
        if not command:
            raise ConfigError(
                f"the commands of a robot of the kind {kind!r} are not known; name "
                "them under `command:` of the robot, or give a recording."
            )
        matches = [by_name.get(part.get("name")) for part in command]
        if None in matches and len(command) == len(usual):
            matches = list(usual)  # the user's own names, in the usual order
        return [
            _complete_command(match or {}, part, ranges)
            for match, part in zip(matches, command, strict=True)
        ]

    def _fill_state(self, state: Any, command: Sequence[Part]) -> Any:
        """Returns the user's state, completed from the usual one; by default the usual one."""
        taken = [part.get("name") for part in command]
        by_field = {part.get("cmd_vel"): part.get("name") for part in command}
        usual = []
        for part in self.state:
            name = part["name"]
            if name in taken:
                name = f"actual_{name}"
            follows = by_field.get(part["cmd_vel"])
            usual.append({"name": name, "unit": part["unit"], "follows": follows})
        for component in self.moves:
            name = f"body_{component}" if component in taken else component
            usual.append({"name": name, "twist": component})
        if state is None:
            return [_complete_state(part, command) for part in usual]
        if not _is_mappings(state):
            return state
        by_name = {part["name"]: part for part in usual}
        return [
            _complete_state({**by_name.get(part.get("name"), {}), **part}, command)
            for part in state
        ]


def _is_mappings(parts: Any) -> bool:
    """True for a sequence of mappings that contain no lists or mappings."""
    return isinstance(parts, list | tuple) and all(
        isinstance(part, Mapping)
        and not any(isinstance(value, list | dict) for value in part.values())
        for part in parts
    )


def _join_names(names: Iterable[Any]) -> str:
    return ", ".join(repr(str(name)) for name in names)


def _complete_command(usual: Part, command: Part, ranges: Ranges) -> dict[str, Any]:
    """Returns a command with its unit and range: its own, else recorded, else usual."""
    data = {"unit": "1", **usual, **command}
    if data["unit"] == "1":
        data = {"min": -RATIO_RANGE, "max": RATIO_RANGE, **data}
    low, high = ranges.get(data.get("name", ""), (0.0, 0.0))
    if low < high or low:
        # The range includes 0, the command at rest.
        data["min"] = command.get("min", min(low, 0.0))
        data["max"] = command.get("max", max(high, 0.0))
    return data


def _complete_state(state: Part, command: Sequence[Part]) -> dict[str, Any]:
    """Returns a state with its unit and range, taken from the command it follows or the twist."""
    unit, limit = TWIST_RANGES.get(state.get("twist", ""), (None, None))
    unit = state.get("unit", unit)
    follows = state.get("follows")
    ends: list[Any] = []
    for part in command:
        is_alike = part.get("unit") == unit and part.get("cmd_vel")
        if part.get("name") == follows if follows else is_alike:
            ends += [part.get("min"), part.get("max")]
    sizes = [abs(end) for end in ends if isinstance(end, int | float)]
    if sizes:
        limit = STATE_RANGE_FACTOR * max(sizes)
    if limit is None:
        return dict(state)
    return {"unit": unit, "min": -limit, "max": limit, **state}
