"""Templates: what a kind of robot knows by itself, so that a robot's file may leave it out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from nics_drl_bridge.errors import ConfigError

Given = Mapping[str, Any]  # a part of a robot's file
Ranges = Mapping[str, tuple[float, float]]
# Generous range of a component of the body twist in the state, in both directions, and its unit.
TWIST_RANGES = {"vx": (10.0, "m/s"), "vy": (10.0, "m/s"), "wz": (10.0, "rad/s")}
SHARES = 1.0  # range of a command without a unit, in both directions


def usual(name: str, unit: str, reach: float, field: str | None = None) -> dict[str, Any]:
    """Returns a command as a template has it."""
    data = {"name": name, "unit": unit, "min": -reach, "max": reach}
    return data if field is None else data | {"cmd_vel": field}


TWIST = (
    usual("forward_command", "m/s", 1.0, "linear.x"),
    usual("turn_command", "rad/s", 2.0, "angular.z"),
)
SIDEWAYS = usual("left_command", "m/s", 1.0, "linear.y")
STEERED = (
    usual("speed_command", "m/s", 1.0, "linear.x"),
    usual("steering_command", "rad", 0.5, "angular.z"),
)
STEERED_STATE = (
    {"name": "speed", "unit": "m/s", "min": -10.0, "max": 10.0, "follows": "speed_command"},
    {"name": "steering", "unit": "rad", "min": -1.5, "max": 1.5, "follows": "steering_command"},
)
LAGS = {"wheel_lag": 0.1}
STEERED_LAGS = {"speed_lag": 0.1, "steering_lag": 0.1}
WHEELS = tuple(usual(f"{side}_wheel", "rad/s", 10.0) for side in ("left", "right"))
FOUR_WHEELS = tuple(
    usual(f"{end}_{side}_wheel", "rad/s", 10.0)
    for end in ("front", "rear")
    for side in ("left", "right")
)


def names_of(way: Sequence[Given]) -> tuple[str, ...]:
    """Returns the usual names of commands."""
    return tuple(one["name"] for one in way)


@dataclass(frozen=True)
class Template:
    """Parts of a robot of one kind, in the form of its file."""

    # ways in which such a robot is commanded, of which the first is usual; none: any commands
    commands: tuple[tuple[Given, ...], ...] = ()
    moves: tuple[str, ...] = ()  # components of the body twist that are its state, or
    state: tuple[Given, ...] = ()  # a state that follows the commands
    parameters: Mapping[str, float] = field(default_factory=dict)
    lengths: Mapping[str, float] = field(default_factory=dict)  # in radii of the footprint

    def filled(self, given: Given, ranges: Ranges) -> dict[str, Any]:
        """Returns a robot's whole file; ConfigError if the names of its commands do not fit."""
        kind = given["kind"]
        data = {"name": kind, **given, "textbook": kind}
        del data["kind"]
        command = self._command(given, ranges)
        data["command"] = command
        names = [one.get("name") for one in command if isinstance(one, Mapping)]
        data["state"] = self._state(names) if given.get("state") is None else given["state"]
        own = given.get("parameters", {})
        if isinstance(own, Mapping):
            sizes = self._lengths(given)
            data["parameters"] = {**sizes, **self.parameters, **own}
            data["assumed"] = sorted(set(sizes) - set(own))
        return data

    def _command(self, given: Given, ranges: Ranges) -> list[Any]:
        own = given.get("command")
        if own is not None and not _mappings(own):
            return own  # type: ignore[no-any-return]  # the check of the whole file reports it
        names = [one.get("name") for one in own] if own is not None else list(ranges)
        way = max(self.commands, key=lambda way: _alike(way, names, own or ()), default=())
        known = {one["name"]: one for one in way}
        if own is None and way and ranges and set(names) != set(known):
            fault = f"commands of the kind {given['kind']!r} are {_list(known)}, not {_list(names)}"
            fix = "name them so, or list them in that order under `command:` of the robot"
            raise ConfigError(f"robot {given.get('name', given['kind'])!r}: {fault}; {fix}.")
        if own is None:
            own = [{"name": name} for name in (names or known)]
        if not own:
            fix = "name them under `command:` of the robot, or give a recording"
            raise ConfigError(
                f"the commands of a robot of the kind {given['kind']!r} are not known; {fix}."
            )
        places = [known.get(one.get("name")) for one in own]
        if None in places and len(own) == len(way):
            places = list(way)  # names of the user's own, in the usual order
        return [_whole(place or {}, one, ranges) for place, one in zip(places, own, strict=True)]

    def _state(self, taken: list[Any]) -> list[Given]:
        if not self.moves:
            own = dict(zip(names_of(self.commands[0]), taken, strict=False))
            own |= {name: name for name in taken if name in own}
            return [{**one, "follows": own.get(one["follows"])} for one in self.state]
        return [
            {
                "name": f"body_{dof}" if dof in taken else dof, "unit": TWIST_RANGES[dof][1],
                "min": -TWIST_RANGES[dof][0], "max": TWIST_RANGES[dof][0], "twist": dof,
            }
            for dof in self.moves
        ]  # fmt: skip

    def _lengths(self, given: Given) -> dict[str, float]:
        radius = given.get("footprint_radius")
        if not isinstance(radius, int | float):
            return {}
        return {name: round(share * radius, 4) for name, share in self.lengths.items()}


def _mappings(own: Any) -> bool:
    return isinstance(own, list | tuple) and all(isinstance(one, Mapping) for one in own)


def _alike(way: tuple[Given, ...], names: list[Any], own: Any) -> int:
    """Counts the commands of a way that are given by name or unit."""
    units = [one.get("unit") for one in own]
    return sum(one["name"] in names or one["unit"] in units for one in way)


def _list(names: Any) -> str:
    return ", ".join(repr(str(name)) for name in names)


def _whole(template: Given, own: Given, ranges: Ranges) -> dict[str, Any]:
    """Returns a command with its unit and range: its own, else the recorded, else the usual one."""
    data = {"unit": "1", **template, **own}
    if data["unit"] == "1":
        data = {"min": -SHARES, "max": SHARES, **data}
    low, high = ranges.get(data.get("name", ""), (0.0, 0.0))
    if low < high or low:  # at rest, a command is 0
        data |= {"min": own.get("min", min(low, 0.0)), "max": own.get("max", max(high, 0.0))}
    return data
