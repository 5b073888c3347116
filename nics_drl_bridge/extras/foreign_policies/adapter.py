"""Runs a foreign network: from an observation to its inputs, and from its outputs to commands.

The network itself runs unchanged; everything around it is numpy, for one observation at a time.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from nics_drl_bridge.errors import PolicyError, suggest
from nics_drl_bridge.extras.foreign_policies.mapping import (
    TWIST,
    Choices,
    ForeignPolicy,
    InputPart,
    Limits,
    Numbers,
    OutputCommand,
    Scaled,
)
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.lidar.arrays import AnyArray
from nics_drl_bridge.policy.file.onnx_session import Rows, run_network
from nics_drl_bridge.robot.spec import RobotSpec

FIELDS = dict(zip(TWIST, ("linear.x", "linear.y", "angular.z"), strict=True))
DTYPES = {
    "tensor(float)": np.float32,
    "tensor(double)": np.float64,
    "tensor(float16)": np.float16,
    "tensor(int64)": np.int64,
    "tensor(int32)": np.int32,
    "tensor(int8)": np.int8,
    "tensor(uint8)": np.uint8,
    "tensor(bool)": np.bool_,
}
AFTER_SCAN = 6  # elements of an observation after the scan: goal and velocity
Entries = dict[str, Array]
"""Content of a state by name, each (K,)."""


def clamp(values: Array, limits: Limits | None) -> Array:
    """Clamps values between two limits; None leaves them as they are."""
    return values if limits is None else np.clip(values, *limits)


def scale(values: Array, scaled: Scaled) -> Array:
    """Scales values as a mapping describes it: clamp, subtract, divide, clamp."""
    values = clamp(values, scaled.limits)
    values = (values - np.asarray(scaled.subtract)) / np.asarray(scaled.divide)
    return clamp(values, scaled.clip)


def measure_part(part: InputPart, scan_parts: int, outputs: Mapping[str, int]) -> int:
    """Returns the number of elements of a part, given the sizes of the network's outputs."""
    size = 1
    if part.of == "scan":
        size = scan_parts
    elif part.of == "constant":
        size = len(part.value) if isinstance(part.value, tuple) else 1
    elif part.output is not None:
        size = outputs.get(part.output, 1)
    return size * part.history


def _is_number(output: AnyArray) -> bool:
    """Returns True for one integer, which chooses by its value."""
    return np.issubdtype(output.dtype, np.integer) and output.size == 1


class Adapter:
    """A foreign network with a mapping, for a robot and the layout of an observation.

    Raises PolicyError, which names the place, if they do not fit together.
    """

    def __init__(
        self,
        mapping: ForeignPolicy,
        robot: RobotSpec,
        scan_parts: int,
        range_max: float,
        session: Any,
        source: str,
    ) -> None:
        self._mapping = mapping
        self._robot = robot
        self._scan_parts = scan_parts
        self._range_max = range_max
        self._session = session
        self._source = source
        self._empty_inputs = {
            end.name: self._make_empty_input(end) for end in session.get_inputs()
        }
        self._names = [end.name for end in session.get_outputs()]
        self._check_names()
        # of zeros
        self._outputs = self._run_network(self._empty_inputs)
        self._output_sizes = {name: made.size for name, made in self._outputs.items()}
        self._check_inputs()
        self._check_states()
        self._commands = self._check_commands()
        _, entries = self._step(np.zeros(scan_parts + AFTER_SCAN), {})
        # size of each entry of the state, in order
        self._state_sizes = {name: entries[name].size for name in self._list_kept()}

    @property
    def state_size(self) -> int:
        """Number of elements of the state; it starts with zeros."""
        return sum(self._state_sizes.values())

    def run(self, observation: Rows, *state: Rows) -> list[AnyArray]:
        """Returns action and command (1, C), and the next state (1, S), for (1, O) and (1, S)."""
        past = self._unpack_state(state[0][0]) if state else {}
        values, following = self._step(observation[0].astype(float), past)
        low = self._robot.command_low
        high = self._robot.command_high
        command = np.clip(values, low, high)
        action = np.clip(2.0 * (command - low) / (high - low) - 1.0, -1.0, 1.0)
        rows = [action, command]
        if state:
            entries = [following[name] for name in self._state_sizes]
            rows.append(np.concatenate([np.zeros(0), *entries]))
        return [row.astype(np.float32)[None] for row in rows]

    def _unpack_state(self, state: Array) -> Entries:
        """Returns the entries of a state (S,); none before the first step."""
        past: Entries = {}
        first = 0
        for name, size in self._state_sizes.items():
            past[name] = state[first : first + size].astype(float)
            first += size
        return past if past and past["begun"][0] > 0.0 else {}

    def _step(self, observation: Array, past: Entries) -> tuple[Array, Entries]:
        """Returns the command (C,) and all entries of this step.

        `past` contains the kept entries of the previous step; it is empty at first.
        """
        following: Entries = {"begun": np.ones(1)}
        feeds = {
            name: self._feed(name, observation, past, following)
            for name in self._empty_inputs
        }
        outputs = self._run_network(feeds)
        for name, state in self._mapping.states.items():
            following[f"state {name}"] = outputs[state.next].ravel()
        for name, made in outputs.items():
            following[f"output {name}"] = made.ravel()
        return self._compute_command(outputs, following), following

    def _list_kept(self) -> list[str]:
        """Returns the names of the entries that a step needs from the previous step."""
        kept = [f"state {name}" for name in self._mapping.states]
        for name, mapped in self._mapping.inputs.items():
            for k, part in enumerate(mapped.parts):
                if part.history > 1:
                    kept.append(f"history {name} {k}")
                if part.output is not None:
                    kept.append(f"output {part.output}")
                elif part.of.startswith("last."):
                    kept.append("twist")
        return list(dict.fromkeys(["begun", *kept])) if kept else []

    def _make_empty_input(self, end: Any) -> AnyArray:
        """Returns zeros for an input of the session. Raises PolicyError for other types."""
        is_fixed = all(isinstance(size, int) for size in end.shape)
        if end.type not in DTYPES or not is_fixed:
            reason = f"is {end.type} of shape {end.shape}, which can't be filled."
            raise self._make_error(f"inputs.{end.name}", reason)
        return np.zeros(end.shape, DTYPES[end.type])

    def _run_network(self, feeds: Mapping[str, AnyArray]) -> dict[str, Any]:
        outputs = run_network(self._session, self._source, dict(feeds))
        return dict(zip(self._names, outputs, strict=True))

    def _make_error(self, place: str, reason: str) -> PolicyError:
        return PolicyError(self._source, place, reason)

    # Whether network, mapping and robot fit together.

    def _check_names(self) -> None:
        mapping = self._mapping
        inputs = self._empty_inputs
        for place, names in (("inputs", mapping.inputs), ("states", mapping.states)):
            for name in names:
                if name not in inputs:
                    fix = suggest(name, inputs)
                    raise self._make_error(
                        f"{place}.{name}", f"the network has no such input; {fix}"
                    )
        for name in inputs:
            if name not in mapping.inputs and name not in mapping.states:
                reason = "the network has this input, but the mapping does not; add it."
                raise self._make_error(f"inputs.{name}", reason)
            if name in mapping.inputs and name in mapping.states:
                reason = "is also listed under inputs; keep one of the two."
                raise self._make_error(f"states.{name}", reason)
        for place, name in self._list_used_outputs():
            if name not in self._names:
                fix = suggest(name, self._names)
                raise self._make_error(
                    place, f"the network has no output {name!r}; {fix}"
                )

    def _list_used_outputs(self) -> Iterator[tuple[str, str]]:
        """Yields places in the mapping that name an output, each with the output's name."""
        mapping = self._mapping
        for key, command in mapping.outputs.items():
            if command.of is not None:
                yield f"outputs.{key}.of", command.of
        for key, state in mapping.states.items():
            yield f"states.{key}.next", state.next
        if mapping.choices is not None:
            yield "choices.of", mapping.choices.of
        for key, mapped in mapping.inputs.items():
            for k, part in enumerate(mapped.parts):
                if part.output is not None:
                    yield f"inputs.{key}.parts.{k}.output", part.output

    def _check_inputs(self) -> None:
        for name, mapped in self._mapping.inputs.items():
            sizes = [
                measure_part(part, self._scan_parts, self._output_sizes)
                for part in mapped.parts
            ]
            empty = self._empty_inputs[name]
            if sum(sizes) != empty.size:
                parts = zip(mapped.parts, sizes, strict=True)
                listed = ", ".join(f"{part.of} {size}" for part, size in parts)
                takes = f"the network takes {empty.shape}"
                reason = f"{takes}, but the parts have {sum(sizes)} ({listed})."
                raise self._make_error(f"inputs.{name}", reason)
            self._check_scaling(mapped, sum(sizes), f"inputs.{name}")
            for k, part in enumerate(mapped.parts):
                size = sizes[k] // part.history
                self._check_scaling(part, size, f"inputs.{name}.parts.{k}")

    def _check_states(self) -> None:
        for name, state in self._mapping.states.items():
            size = self._empty_inputs[name].size
            made = self._output_sizes[state.next]
            if size != made:
                reason = (
                    f"{state.next!r} has {made} elements, but the state has {size}."
                )
                raise self._make_error(f"states.{name}.next", reason)
            self._check_count(state.start, size, f"states.{name}.start")

    def _check_scaling(self, scaled: Scaled, size: int, place: str) -> None:
        self._check_count(scaled.subtract, size, f"{place}.subtract")
        self._check_count(scaled.divide, size, f"{place}.divide")

    def _check_count(self, values: Numbers, size: int, place: str) -> None:
        if isinstance(values, tuple) and len(values) != size:
            reason = f"has {len(values)} numbers, but {size} are needed."
            raise self._make_error(place, reason)

    def _check_commands(self) -> tuple[str, ...]:
        """Checks the commands; returns their names: `TWIST` or the robot's own."""
        outputs = self._mapping.outputs
        choices = self._mapping.choices
        if choices is not None:
            size = self._outputs[choices.of].size
            count = len(choices.commands)
            if size != count and not _is_number(self._outputs[choices.of]):
                reason = (
                    f"are {count}, but the output {choices.of!r} has {size} elements."
                )
                raise self._make_error("choices.commands", reason)
            named = {name for row in choices.commands for name in row}
            return self._choose_command_names(named, "choices")
        names = self._choose_command_names(outputs, "outputs")
        needed = ("forward", "turn") if names == TWIST else names
        for name in needed:
            if name not in outputs:
                reason = "is missing; name the output to use."
                raise self._make_error(f"outputs.{name}", reason)
        fields = [command.cmd_vel for command in self._robot.command]
        for name, command in outputs.items():
            if names == TWIST and FIELDS[name] not in fields:
                reason = (
                    f"the robot {self._robot.name!r} has no command for it; remove it."
                )
                raise self._make_error(f"outputs.{name}", reason)
            size = math.inf if command.of is None else self._output_sizes[command.of]
            if command.index >= size:
                reason = f"the output {command.of!r} has only {size} elements"
                reason = f"is {command.index}, but {reason}."
                raise self._make_error(f"outputs.{name}.index", reason)
        return names

    def _choose_command_names(
        self, named: Iterable[str], place: str
    ) -> tuple[str, ...]:
        """Returns `TWIST` if it contains all names, else the robot's own, which then must."""
        robot = self._robot
        commands = tuple(command.name for command in robot.command)
        if all(name in TWIST for name in named):
            if not robot.takes_cmd_vel:
                fix = f"map {', '.join(commands)}."
                reason = f"the robot {robot.name!r} is not driven by cmd_vel; {fix}"
                raise self._make_error(place, reason)
            return TWIST
        for name in named:
            if name not in commands:
                fix = suggest(name, (*TWIST, *commands))
                reason = f"the robot has no such command; {fix}"
                raise self._make_error(f"{place}.{name}", reason)
        for name, mapped in self._mapping.inputs.items():
            for part in mapped.parts:
                if part.of.startswith("last.") and part.output is None:
                    owners = "policies that command forward, left and turn"
                    reason = f"{part.of} is only available to {owners}."
                    raise self._make_error(f"inputs.{name}", reason)
        return commands

    # Inputs.

    def _feed(
        self, name: str, observation: Array, past: Entries, following: Entries
    ) -> AnyArray:
        empty = self._empty_inputs[name]
        mapped = self._mapping.inputs.get(name)
        if mapped is not None:
            rows = [
                self._read_part(
                    f"history {name} {k}", part, observation, past, following
                )
                for k, part in enumerate(mapped.parts)
            ]
            values = scale(np.concatenate(rows), mapped)
        else:
            start = np.resize(self._mapping.states[name].start, empty.size)
            values = past.get(f"state {name}", start)
        return values.reshape(empty.shape).astype(empty.dtype)

    def _read_part(
        self,
        key: str,
        part: InputPart,
        observation: Array,
        past: Entries,
        following: Entries,
    ) -> Array:
        row = scale(self._read_quantity(part, observation, past), part)
        if part.history == 1:
            return row
        earlier = past.get(key, np.tile(row, part.history - 1))
        rows = np.concatenate([earlier, row])  # oldest first
        following[key] = rows[len(row) :]
        if part.newest_first:
            rows = rows.reshape(part.history, -1)[::-1].ravel()
        return rows

    def _read_quantity(
        self, part: InputPart, observation: Array, past: Entries
    ) -> Array:
        """Returns a quantity (K,) in SI units."""
        scan = observation[: self._scan_parts] * self._range_max
        distance, cosine, sine, *velocity = observation[self._scan_parts :]
        if part.of == "scan":
            return scan[::-1] if part.clockwise else scan
        if part.of == "constant":
            return np.atleast_1d(np.asarray(part.value, float))
        if part.output is not None:
            nothing = np.zeros(self._output_sizes[part.output])
            return past.get(f"output {part.output}", nothing)
        kind, _, which = part.of.partition(".")
        if kind == "velocity":
            return np.array([velocity[TWIST.index(which)]])
        if kind == "last":
            return past.get("twist", np.zeros(3))[[TWIST.index(which)]]
        goal = {
            "distance": distance,
            "bearing": np.arctan2(sine, cosine),
            "cosine": cosine,
            "sine": sine,
            "x": distance * cosine,
            "y": distance * sine,
        }
        return np.array([goal[which]])

    # Outputs.

    def _compute_command(self, outputs: Mapping[str, Any], following: Entries) -> Array:
        """Returns the robot's command (C,), NaN for a choice that does not exist."""
        choices = self._mapping.choices
        if choices is None:
            mapped = self._mapping.outputs
            values = np.array(
                [
                    self._read_element(mapped.get(name, OutputCommand()), outputs)
                    for name in self._commands
                ]
            )
        else:
            values = self._choose(choices, outputs[choices.of].ravel())
        if self._commands != TWIST:
            return values
        following["twist"] = values
        if self._robot.steers:
            speed, angle = self._robot.bicycle.command(values)
            values = np.array([speed, values[1], angle])
        return self._robot.from_fields(values)

    def _read_element(
        self, command: OutputCommand, outputs: Mapping[str, Any]
    ) -> float:
        value = np.array(command.add)
        if command.of is not None:
            element = outputs[command.of].ravel()[command.index].astype(float)
            value = clamp(element, command.limits) * command.multiply + command.add
        return float(clamp(value, command.clip))

    def _choose(self, choices: Choices, output: AnyArray) -> Array:
        nothing = np.full(len(self._commands), np.nan)  # never sent to a robot
        if np.isnan(output.astype(float)).any():
            return nothing
        if _is_number(output):
            index = int(output[0])
        else:
            index = int(output.argmax())
        if not 0 <= index < len(choices.commands):
            return nothing
        chosen = choices.commands[index]
        return np.array([chosen.get(name, 0.0) for name in self._commands])
