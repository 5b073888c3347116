"""Connects a foreign network to the observation of a task and the commands of a robot."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto

from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.errors import PolicyError, suggest
from nics_drl_bridge.policy import foreign_mapping, graph_folding, onnx_graph, rehearsal
from nics_drl_bridge.policy.graph_builder import Builder
from nics_drl_bridge.robot.spec import RobotSpec

THEIRS = "network/"  # prefix of every name in the foreign graph
OLDEST_OPSET = 8  # first opset in which the operators used here broadcast
SLOWEST = 1e-6  # speed below which the steering angle is 0 [m/s]
FIELDS = dict(
    zip(foreign_mapping.TWIST, ("linear.x", "linear.y", "angular.z"), strict=True)
)


@dataclass(frozen=True)
class Network:
    """A foreign network, and its states if its own files describe them."""

    model: Any  # onnx.ModelProto
    # states by input name
    states: Mapping[str, foreign_mapping.ForeignState] = field(default_factory=dict)

    @property
    def inputs(self) -> dict[str, Any]:
        """Inputs by name, as onnx.ValueInfoProto; weights may be among them."""
        return {value.name: value for value in onnx_graph.inputs_of(self.model)}

    @property
    def outputs(self) -> dict[str, Any]:
        """Outputs by name, as onnx.ValueInfoProto."""
        return {value.name: value for value in self.model.graph.output}


class Composer:
    """Builds the graph of a policy file around a foreign network, for one observation at a time."""

    def __init__(
        self,
        network: Network,
        mapping: foreign_mapping.ForeignPolicy,
        task: Navigation,
        source: str,
    ) -> None:
        self._network = network
        self._mapping = mapping
        self._task = task
        self._source = source
        self._states = {**network.states, **mapping.states}
        self._build = Builder()
        self._past: dict[str, str] = {}  # content -> row of the current state
        self._next: dict[str, str] = {}  # content -> row of the next state
        self._check_names()

    def compose(self) -> tuple[Any, int]:
        """Returns the ModelProto and the size of its state."""
        build = self._build
        theirs = self._theirs()
        sizes = self._state_sizes()
        ends = np.cumsum([0, *sizes.values()])
        if sizes:
            ranges = zip(sizes, ends[:-1], ends[1:], strict=True)
            self._past = {
                n: build.pick(onnx_graph.STATE_IN, range(i, j)) for n, i, j in ranges
            }
        self._feed(theirs)
        build.nodes += theirs.graph.node
        build.weights += theirs.graph.initializer
        command = self._command()
        low, high = self._task.command_limits
        command = build.clamp(command, (low, high))
        build.add("Identity", command, name=onnx_graph.COMMAND)
        action = build.affine(
            command, 2.0 / (high - low), -1.0 - 2.0 * low / (high - low)
        )
        build.add("Identity", build.clamp(action, (-1.0, 1.0)), name=onnx_graph.ACTION)
        if sizes:
            self._remember()
            build.join([self._next[key] for key in sizes], name=onnx_graph.STATE_OUT)
        return self._model(theirs, int(ends[-1])), int(ends[-1])

    def _fault(self, place: str, reason: str) -> PolicyError:
        return PolicyError(self._source, place, reason)

    def _check_names(self) -> None:
        mapping = self._mapping
        inputs = self._network.inputs
        for name in (*mapping.inputs, *self._states):
            if name not in inputs:
                where = "inputs" if name in mapping.inputs else "states"
                fix = suggest(name, inputs)
                raise self._fault(
                    f"{where}.{name}", f"the network has no such input; {fix}"
                )
        for name in inputs:
            if name not in mapping.inputs and name not in self._states:
                reason = "the network has this input, but the mapping does not; add it."
                raise self._fault(f"inputs.{name}", reason)
            if name in mapping.inputs and name in self._states:
                raise self._fault(
                    f"states.{name}",
                    "is also listed under inputs; keep one of the two.",
                )
        for place, name in self._list_used_outputs():
            if name not in self._network.outputs:
                fix = suggest(name, self._network.outputs)
                raise self._fault(place, f"the network has no output {name!r}; {fix}")

    def _list_used_outputs(self) -> Iterator[tuple[str, str]]:
        """Yields each output that the mapping names, after the place where it does."""
        mapping = self._mapping
        for key, command in mapping.outputs.items():
            if command.of is not None:
                yield f"outputs.{key}.of", command.of
        for key, state in self._states.items():
            yield f"states.{key}.next", state.next
        if mapping.choices is not None:
            yield "choices.of", mapping.choices.of
        for key, mapped in mapping.inputs.items():
            for k, part in enumerate(mapped.parts):
                if part.output is not None:
                    yield f"inputs.{key}.parts.{k}.output", part.output

    # Shapes: the graph takes one observation at a time, so an open first dimension is 1.

    def _theirs(self) -> Any:
        """Returns the foreign graph with prefixed names, fixed shapes, and inputs to feed here."""
        model = onnx.ModelProto()
        model.CopyFrom(self._network.model)
        opsets = onnx_graph.opsets_of(model)
        version = max((opset.version for opset in opsets), default=0)
        if version < OLDEST_OPSET:
            reason = f"is {version}; {OLDEST_OPSET} or newer is needed."
            raise self._fault("network.opset", reason)
        for value in onnx_graph.inputs_of(model):
            dimensions = value.type.tensor_type.shape.dim
            sizes = self._shape(value.name)
            for dimension, size in zip(dimensions, sizes, strict=True):
                dimension.dim_value = size
        content = model.SerializeToString()
        rehearsal.rehearse("folding", content, self._source, opset=version)
        try:
            model = onnx.compose.add_prefix(model, THEIRS)
            self._made = graph_folding.fold_shapes(model.graph, version)
        except Exception as error:  # noqa: BLE001 - a damaged graph raises anything
            reason = f"its shapes are inconsistent ({onnx_graph.quote(error)})."
            raise self._fault("network", reason) from None
        return model

    def _shape(self, name: str) -> tuple[int, ...]:
        """Returns the shape of an input: an open first dimension is 1, others fit the parts."""
        shape = self._network.inputs[name].type.tensor_type.shape
        sizes = [d.dim_value if d.HasField("dim_value") else 0 for d in shape.dim]
        if sizes and sizes[0] == 0:
            sizes[0] = 1
        needed = self._given_size(name)
        if needed is not None and sizes.count(0) == 1:
            sizes[sizes.index(0)] = max(
                needed // max(math.prod(s for s in sizes if s), 1), 1
            )
        sizes = [size or 1 for size in sizes]
        if needed is not None and math.prod(sizes) != needed:
            parts = self._mapping.inputs[name].parts
            listed = ", ".join(f"{part.of} {self._part_size(part)}" for part in parts)
            reason = f"the network takes {tuple(sizes)}, but the parts have {needed} ({listed})."
            raise self._fault(f"inputs.{name}", reason)
        return tuple(sizes)

    def _given_size(self, name: str) -> int | None:
        """Returns the number of elements that an input's parts supply; None for a state."""
        if name not in self._mapping.inputs:
            return None
        return sum(map(self._part_size, self._mapping.inputs[name].parts))

    def _part_size(self, part: foreign_mapping.InputPart) -> int:
        size = 1
        if part.of == "scan":
            size = self._task.scan_parts
        elif part.of == "constant":
            size = len(part.value) if isinstance(part.value, tuple) else 1
        elif part.output is not None:
            size = self._output_size(part.output)
        return size * part.history

    def _output_size(self, name: str) -> int:
        """Returns the number of elements of an output, counting open dimensions as 1."""
        if hasattr(self, "_made"):
            sizes: Sequence[int] = self._made[THEIRS + name]
        else:
            sizes = [
                d.dim_value
                for d in self._network.outputs[name].type.tensor_type.shape.dim
            ]
        return math.prod(size or 1 for size in sizes)

    def _state_sizes(self) -> dict[str, int]:
        """Returns the number of elements of each entry in the state."""
        sizes = {f"state {name}": math.prod(self._shape(name)) for name in self._states}
        for name, mapped in self._mapping.inputs.items():
            for k, part in enumerate(mapped.parts):
                if part.of.startswith("last.") and part.output is None:
                    sizes["twist"] = len(foreign_mapping.TWIST)
                if part.output is not None:
                    sizes[f"output {part.output}"] = self._output_size(part.output)
                if part.history > 1:
                    kept = self._part_size(part) // part.history * (part.history - 1)
                    sizes[f"history {name} {k}"] = kept
        # The flag "begun" is 0 in the first step, then 1.
        return {"begun": 1, **sizes} if sizes else {}

    # Inputs.

    def _feed(self, theirs: Any) -> None:
        build = self._build
        types = {v.name: v.type.tensor_type.elem_type for v in theirs.graph.input}
        for name in self._network.inputs:
            if name in self._states:
                row = self._begun(
                    f"state {name}", self._states[name].start, f"states.{name}.start"
                )
            else:
                mapped = self._mapping.inputs[name]
                rows = [self._part(name, k, p) for k, p in enumerate(mapped.parts)]
                size = self._given_size(name) or 0
                self._check_scaled(mapped, size, f"inputs.{name}")
                row = rows[0] if len(rows) == 1 else build.join(rows)
                row = build.scale(row, mapped)
            row = build.add("Reshape", row, build.constant(self._shape(name), np.int64))
            build.add("Cast", row, name=THEIRS + name, to=types[THEIRS + name])

    def _check_scaled(
        self, scaled: foreign_mapping.Scaled, size: int, place: str
    ) -> None:
        for key in ("subtract", "divide"):
            values = getattr(scaled, key)
            if isinstance(values, tuple) and len(values) != size:
                reason = f"has {len(values)} numbers, but {size} elements are scaled."
                raise self._fault(f"{place}.{key}", reason)

    def _begun(self, key: str, start: Any, place: str = "") -> str:
        """Returns the name of a state entry, replaced by its start value in the first step."""
        past = self._past[key]
        size = self._state_sizes()[key]
        if isinstance(start, tuple) and len(start) != size:
            raise self._fault(
                place, f"has {len(start)} numbers, but the state has {size}."
            )
        if not np.any(start):
            return past
        return self._build.select(
            self._past["begun"], past, self._build.constant([start])
        )

    def _part(self, name: str, k: int, part: foreign_mapping.InputPart) -> str:
        build = self._build
        size = self._part_size(part) // part.history
        self._check_scaled(part, size, f"inputs.{name}.parts.{k}")
        row = build.scale(self._quantity(name, part), part)
        if part.history == 1:
            return row
        key = f"history {name} {k}"
        first = build.join([row] * (part.history - 1))
        # oldest first
        past = build.select(self._past["begun"], self._past[key], first)
        rows = build.join([past, row])
        self._next[key] = build.pick(rows, range(size, size * part.history))
        if part.newest_first:
            places = (
                np.arange(size * part.history).reshape(part.history, size)[::-1].ravel()
            )
            rows = build.pick(rows, places.tolist())
        return rows

    def _quantity(self, name: str, part: foreign_mapping.InputPart) -> str:
        """Returns a quantity as a row, in SI units."""
        build = self._build
        scan = self._task.scan_parts
        of, _, which = part.of.partition(".")
        if of == "scan":
            places = range(scan)[::-1] if part.clockwise else range(scan)
            shares = build.pick(onnx_graph.INPUT, places)
            return build.affine(shares, self._task.sight.range_max, 0.0)
        if of == "constant":
            return build.constant(
                np.reshape(np.asarray(part.value, np.float32), (1, -1))
            )
        if of == "velocity":
            return build.pick(
                onnx_graph.INPUT, [scan + 3 + foreign_mapping.TWIST.index(which)]
            )
        if part.output is not None:
            return self._past[f"output {part.output}"]
        if of == "last":
            choices = self._mapping.choices
            rows = [self._mapping.outputs] if choices is None else choices.commands
            if not all(name in foreign_mapping.TWIST for row in rows for name in row):
                reason = (
                    "is only available to policies that command forward, left and turn."
                )
                raise self._fault(f"inputs.{name}", f"{part.of} {reason}")
            return build.pick(self._past["twist"], [foreign_mapping.TWIST.index(which)])
        distance, cosine, sine = (
            build.pick(onnx_graph.INPUT, [scan + k]) for k in range(3)
        )
        if which == "bearing":
            return build.angle(cosine, sine)
        if which in ("x", "y"):
            return build.add("Mul", distance, cosine if which == "x" else sine)
        return {"distance": distance, "cosine": cosine, "sine": sine}[which]

    # Outputs.

    def _flat(self, name: str) -> str:
        """Returns an output as a row of float32."""
        made = self._made[THEIRS + name]
        if not all(made):
            reason = (
                f"returns {name!r} of shape {made}, which must be known before it runs."
            )
            raise self._fault("network", reason)
        flat = self._build.add(
            "Reshape", THEIRS + name, self._build.constant([1, -1], np.int64)
        )
        return self._build.add("Cast", flat, to=TensorProto.FLOAT)

    def _command(self) -> str:
        """Returns the row of the robot's command (1, C)."""
        if self._mapping.choices is not None:
            return self._chosen(self._mapping.choices)
        outputs = self._mapping.outputs
        robot = self._task.robot
        names = self._names(outputs, "outputs")
        if names == foreign_mapping.TWIST:
            self._check_twist(outputs)
        rows = [
            self._element(name, outputs.get(name, foreign_mapping.OutputCommand()))
            for name in names
        ]
        if names != foreign_mapping.TWIST:
            return self._build.join(rows)
        self._next["twist"] = self._build.join(rows)
        return self._of_twist(rows, robot)

    def _names(self, rates: Mapping[str, Any], place: str) -> tuple[str, ...]:
        """Returns the names that `rates` must have: a twist's, or those of the robot's commands."""
        robot = self._task.robot
        commands = tuple(command.name for command in robot.command)
        if all(name in foreign_mapping.TWIST for name in rates):
            if not robot.takes_cmd_vel:
                fix = f"map {', '.join(commands)}."
                reason = f"the robot {robot.name!r} is not driven by cmd_vel; {fix}"
                raise self._fault(place, reason)
            return foreign_mapping.TWIST
        for name in rates:
            if name not in commands:
                fix = suggest(name, (*foreign_mapping.TWIST, *commands))
                raise self._fault(
                    f"{place}.{name}", f"the robot has no such command; {fix}"
                )
        for name in commands:
            if name not in rates and place == "outputs":
                raise self._fault(
                    f"{place}.{name}", "is missing; name the output to use."
                )
        return commands

    def _check_twist(
        self, outputs: Mapping[str, foreign_mapping.OutputCommand]
    ) -> None:
        fields = [command.cmd_vel for command in self._task.robot.command]
        for name in ("forward", "turn"):
            if name not in outputs:
                raise self._fault(
                    f"outputs.{name}", "is missing; name the output to use."
                )
        for name in outputs:
            if FIELDS[name] not in fields:
                reason = f"the robot {self._task.robot.name!r} has no command for it; remove it."
                raise self._fault(f"outputs.{name}", reason)

    def _element(self, name: str, command: foreign_mapping.OutputCommand) -> str:
        build = self._build
        if command.of is None:
            return build.clamp(build.constant([[command.add]]), command.clip)
        size = self._output_size(command.of)
        if command.index >= size:
            reason = f"is {command.index}, but the output {command.of!r} has only {size} elements."
            raise self._fault(f"outputs.{name}.index", reason)
        row = build.clamp(
            build.pick(self._flat(command.of), [command.index]), command.limits
        )
        return build.clamp(
            build.affine(row, command.multiply, command.add), command.clip
        )

    def _of_twist(self, twist: Sequence[str], robot: RobotSpec) -> str:
        """Converts forward, left and turn to a row of commands, see `geometry.Bicycle.command`."""
        build = self._build
        rows = dict(zip(FIELDS.values(), twist, strict=True))
        if robot.steers:
            forward = rows["linear.x"]
            across = build.affine(rows["angular.z"], robot.bicycle.wheelbase, 0.0)
            size = build.add("Max", build.add("Abs", forward), build.constant(SLOWEST))
            sign = build.add("Div", forward, size)
            slope = build.add("Div", build.add("Mul", across, sign), size)
            rows["angular.z"] = build.add("Atan", slope)
            if robot.bicycle.front_drive:
                squares = [build.add("Mul", row, row) for row in (forward, across)]
                speed = build.add("Sqrt", build.add("Add", *squares))
                rows["linear.x"] = build.add("Mul", speed, sign)
        return build.join([rows[str(command.cmd_vel)] for command in robot.command])

    def _chosen(self, choices: foreign_mapping.Choices) -> str:
        """Returns the command selected by the maximum of an output, or by an integer output."""
        build = self._build
        robot = self._task.robot
        names = self._names(
            {name: 0.0 for row in choices.commands for name in row}, "choices"
        )
        rows = np.array(
            [[row.get(name, 0.0) for name in names] for row in choices.commands]
        )
        size = self._output_size(choices.of)
        beyond = ""
        kind = self._network.outputs[choices.of].type.tensor_type.elem_type
        if kind in onnx_graph.INTEGERS and size == 1:
            single, *ends = (
                build.constant(k, np.int64) for k in ([1], 0, len(rows) - 1)
            )
            choice = build.add("Reshape", THEIRS + choices.of, single)
            choice = build.add("Cast", choice, to=TensorProto.INT64)
            index = build.add("Clip", choice, *ends)
            # An integer that selects nothing gives a NaN command, which is never sent to a robot.
            beyond = build.add(
                "Cast", build.add("Sub", choice, index), to=TensorProto.FLOAT
            )
            beyond = build.add("Sqrt", build.add("Neg", build.add("Abs", beyond)))
        elif size == len(rows):
            index = build.add("ArgMax", self._flat(choices.of), axis=1, keepdims=0)
        else:
            reason = (
                f"are {len(rows)}, but the output {choices.of!r} has {size} elements."
            )
            raise self._fault("choices.commands", reason)
        commands = rows
        if names == foreign_mapping.TWIST:
            self._next["twist"] = build.add(
                "Gather", build.constant(rows), index, axis=0
            )
            if robot.steers:
                speed, angle = robot.bicycle.command(rows)
                commands = np.stack([speed, rows[:, 1], angle], axis=-1)
            commands = robot.from_fields(commands)
        chosen = build.add("Gather", build.constant(commands), index, axis=0)
        return build.add("Add", chosen, beyond) if beyond else chosen

    def _remember(self) -> None:
        self._next["begun"] = self._build.constant([[1.0]])
        for name, state in self._states.items():
            size = math.prod(self._shape(name))
            made = self._output_size(state.next)
            if size != made:
                reason = (
                    f"{state.next!r} has {made} elements, but the state has {size}."
                )
                raise self._fault(f"states.{name}.next", reason)
            self._next[f"state {name}"] = self._flat(state.next)
        for key in self._past:
            if key.startswith("output "):
                self._next[key] = self._flat(key.removeprefix("output "))

    def _model(self, theirs: Any, state: int) -> Any:
        width = self._task.observation_space.shape[0]
        commands = len(self._task.robot.command)
        inputs = {onnx_graph.INPUT: width}
        outputs = {
            onnx_graph.ACTION: commands,
            onnx_graph.COMMAND: commands,
        }
        if state:
            inputs[onnx_graph.STATE_IN] = outputs[onnx_graph.STATE_OUT] = state
        made = [
            [
                onnx.helper.make_tensor_value_info(n, TensorProto.FLOAT, [1, w])
                for n, w in ends
            ]
            for ends in (inputs.items(), outputs.items())
        ]
        graph = onnx.helper.make_graph(
            self._build.nodes, "foreign", *made, self._build.weights
        )
        opsets = onnx_graph.opsets_of(theirs)
        return onnx.helper.make_model(
            graph, opset_imports=opsets, ir_version=theirs.ir_version
        )
