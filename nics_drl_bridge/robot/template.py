"""Templates: what a kind of robot knows by itself, so that a robot's file may leave it out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any

from nics_drl_bridge.errors import ConfigError, suggest

Given = Mapping[str, Any]  # a part of a robot's file
Ranges = Mapping[str, tuple[float, float]]
# Unit, and range in both directions, of a component of the body twist in the state; a state that a
# command tells in its own unit may come to a multiple of that.
TWIST_RANGES = {"vx": ("m/s", 10.0), "vy": ("m/s", 10.0), "wz": ("rad/s", 10.0)}
BEYOND = 2.0
# least likeness of a misspelt parameter: "steering_rate" is no "steering_lag"
MISSPELT = 0.85
SHARES = 1.0  # range of a command without a unit, in both directions


def usual(
    name: str, unit: str, reach: float, field: str | None = None
) -> dict[str, Any]:
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
# that follows the command of this field, whatever its name is
STEERED_STATE = (
    {"name": "speed", "unit": "m/s", "cmd_vel": "linear.x"},
    {"name": "steering", "unit": "rad", "cmd_vel": "angular.z"},
)
LAGS = {"wheel_lag": 0.1}
STEERED_LAGS = {"speed_lag": 0.1, "steering_lag": 0.1}
WHEELS = tuple(usual(f"{side}_wheel", "rad/s", 10.0) for side in ("left", "right"))
FOUR_WHEELS = tuple(
    usual(f"{end}_{side}_wheel", "rad/s", 10.0)
    for end in ("front", "rear")
    for side in ("left", "right")
)


def list_names(way: Sequence[Given]) -> tuple[str, ...]:
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
    lengths: Mapping[str, float] = field(
        default_factory=dict
    )  # in radii of the footprint
    # its commands by words that others have for them, from which `nics inspect` guesses the kind
    words: Mapping[str, str] = field(default_factory=dict)

    def filled(self, given: Given, ranges: Ranges) -> dict[str, Any]:
        """Returns a robot's whole file; ConfigError if the names of its commands do not fit."""
        kind = given["kind"]
        data = {"name": kind, **given, "textbook": kind}
        del data["kind"]
        data["command"] = command = self._command(given, ranges)
        if _mappings(command):
            data["state"] = self._state(given.get("state"), command)
        own = given.get("parameters", {})
        radius = given.get("footprint_radius")
        if isinstance(own, Mapping) and isinstance(radius, int | float):
            sizes = {
                name: round(share * radius, 4) for name, share in self.lengths.items()
            }
            usual = {**sizes, **self.parameters}
            for name in own:  # one of the user's own may have any other name
                if get_close_matches(str(name), usual.keys() - own.keys(), 1, MISSPELT):
                    fault = f"unknown parameter {name!r}; {suggest(name, usual)}"
                    raise ConfigError(f"robot {data['name']!r}: {fault}")
            data["parameters"], data["assumed"] = (
                {**usual, **own},
                sorted(set(usual) - set(own)),
            )
        return data

    def _command(self, given: Given, ranges: Ranges) -> Any:
        own = given.get("command")
        kind = given["kind"]
        if own is not None and not _mappings(own):
            return own  # the check of the whole file reports it
        names = [one.get("name") for one in own] if own is not None else list(ranges)
        way = max(
            self.commands, key=lambda way: _alike(way, names, own or ()), default=()
        )
        known = {one["name"]: one for one in way}
        known |= {name.removesuffix("_command"): one for name, one in known.items()}
        these = len(way) == len(names) and all(known.get(name) in way for name in names)
        if own is None and way and ranges and not these:
            usual = _list(name for name in known if not name.endswith("_command"))
            fault = f"commands of the kind {kind!r} are {usual}, not {_list(names)}"
            fix = (
                "name them so, or list them in that order under `command:` of the robot"
            )
            raise ConfigError(f"robot {given.get('name', kind)!r}: {fault}; {fix}.")
        if own is None:
            own = [{"name": name} for name in (names or list_names(way))]
        if not own:
            fix = "name them under `command:` of the robot, or give a recording"
            raise ConfigError(
                f"the commands of a robot of the kind {kind!r} are not known; {fix}."
            )
        places = [known.get(one.get("name")) for one in own]
        if None in places and len(own) == len(way):
            places = list(way)  # names of the user's own, in the usual order
        return [
            _whole(place or {}, one, ranges)
            for place, one in zip(places, own, strict=True)
        ]

    def _state(self, own: Any, command: Sequence[Given]) -> Any:
        """Returns the state: the user's own in so far as it is given, the usual one if None."""
        taken = [one.get("name") for one in command]
        usual = [dict(one) for one in self.state]
        for one in usual:  # it follows a command, by whatever name
            place = one.pop("cmd_vel")
            one["follows"] = {c.get("cmd_vel"): c.get("name") for c in command}.get(
                place
            )
            one["name"] = (
                f"actual_{one['name']}" if one["name"] in taken else one["name"]
            )
        usual += [
            {"name": f"body_{d}" if d in taken else d, "twist": d} for d in self.moves
        ]
        if own is not None and not _mappings(own):
            return own
        known = {one["name"]: one for one in usual}
        if own is None:
            chosen = usual
        else:
            chosen = [{**known.get(c.get("name"), {}), **c} for c in own]
        return [_ranged(one, command) for one in chosen]


def _mappings(own: Any) -> bool:
    """True for mappings whose names, units and places are words."""
    return isinstance(own, list | tuple) and all(
        isinstance(one, Mapping)
        and not any(isinstance(v, list | dict) for v in one.values())
        for one in own
    )


def _alike(way: Sequence[Given], names: Sequence[Any], own: Any) -> int:
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
        data |= {
            "min": own.get("min", min(low, 0.0)),
            "max": own.get("max", max(high, 0.0)),
        }
    return data


def _ranged(state: Given, command: Sequence[Given]) -> dict[str, Any]:
    """Returns a state with its unit and range, by the command that it follows, or by the twist."""
    unit, reach = TWIST_RANGES.get(state.get("twist", ""), (None, None))
    unit = state.get("unit", unit)
    telling = [one for one in command if one.get("unit") == unit and one.get("cmd_vel")]
    if follows := state.get("follows"):
        telling = [one for one in command if one.get("name") == follows]
    ends = [one.get(end) for one in telling for end in ("min", "max")]
    bounds = [abs(end) for end in ends if isinstance(end, int | float)]
    reach = BEYOND * max(bounds) if bounds else reach
    usual = {} if reach is None else {"unit": unit, "min": -reach, "max": reach}
    return {**usual, **state}
