"""The mapping of a foreign policy: the meaning of each input and output of its network."""

from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from nics_drl_bridge.config import Schema

Numbers = float | tuple[float, ...]
Limits = tuple[float, float]
Quantity = Literal[
    "scan",
    "goal.distance",
    "goal.bearing",
    "goal.cosine",
    "goal.sine",
    "goal.x",
    "goal.y",
    "velocity.forward",
    "velocity.left",
    "velocity.turn",
    "last.forward",
    "last.left",
    "last.turn",
    "last.output",
    "constant",
]
TWIST = ("forward", "left", "turn")  # [m/s, m/s, rad/s]
MOST_SCANS = 64  # maximum length of a scan history


class Scaled(Schema):
    """Scaling of network inputs: clamp to `limits`, (x - subtract) / divide, clamp to `clip`."""

    # minimum and maximum before scaling; None: no clamping
    limits: Limits | None = None
    # subtracted after that: one number for all elements, or one per element
    subtract: Numbers = 0.0
    # divisor of the result: one number for all elements, or one per element
    divide: Numbers = 1.0
    clip: Limits | None = None  # minimum and maximum after scaling; None: no clamping

    @field_validator("divide")
    @classmethod
    def _check_divisor(cls, divide: Numbers) -> Numbers:
        if 0.0 in (divide if isinstance(divide, tuple) else (divide,)):
            raise ValueError("must not be 0")
        return divide

    @field_validator("limits", "clip")
    @classmethod
    def _check_order(cls, limits: Limits | None) -> Limits | None:
        if limits is not None and not limits[0] < limits[1]:
            raise ValueError("must be [minimum, maximum]")
        return limits


class InputPart(Scaled):
    """Consecutive elements of an input: one quantity, in SI units unless scaled."""

    of: Quantity  # the quantity; the guide lists all quantities with their units
    clockwise: bool = False  # reverse the order of a scan
    # number of time steps, including the current one
    history: int = Field(default=1, ge=1, le=MOST_SCANS)
    newest_first: bool = False  # reverse the order of a history
    # the output whose previous value is `last.output`
    output: str | None = None
    value: Numbers | None = None  # numbers of a `constant`

    @model_validator(mode="after")
    def _check_keys(self) -> "InputPart":
        for key, owner in (("output", "last.output"), ("value", "constant")):
            if (getattr(self, key) is not None) != (self.of == owner):
                verb = "needs" if self.of == owner else "has no"
                raise ValueError(f"`of: {self.of}` {verb} `{key}:`")
        if self.clockwise and self.of != "scan":
            raise ValueError(f"`of: {self.of}` has no `clockwise:`")
        return self


class ForeignInput(Scaled):
    """An input of the network: its parts in order, then scaled as a whole."""

    # quantities that fill the input, in order
    parts: tuple[InputPart, ...] = Field(min_length=1)


class ForeignState(Schema):
    """A state of the network: an input that receives an output of the previous step."""

    next: str  # name of that output
    start: Numbers = 0.0  # value at the start of an episode


class OutputCommand(Schema):
    """A command from an output element: clamp to `limits`, x * multiply + add, clamp to `clip`."""

    of: str | None = None  # name of the output; None: the command is always `add`
    index: int = Field(default=0, ge=0)  # index of the element in the flattened output
    # minimum and maximum before scaling; None: no clamping
    limits: Limits | None = None
    multiply: float = 1.0  # factor on the element
    add: float = 0.0  # added after multiplying, in the unit of the command
    # minimum and maximum of the command; None: only the robot's own limits
    clip: Limits | None = None


class Choices(Schema):
    """Commands to choose from: by the maximum of an output, or by its integer value."""

    of: str  # name of the output that selects
    # the commands, in order; a command left out of a row is 0
    commands: tuple[dict[str, float], ...] = Field(min_length=1)


class ForeignPolicy(Schema):
    """A foreign network, and the meaning of its inputs and outputs.

    Commands are `forward` and `left` [m/s] and `turn` [rad/s], or have the robot's own names.
    """

    kind: Literal["foreign policy"]  # identifies the kind of file
    # an .onnx file or a LEAPP bundle, relative to the mapping
    network: str = Field(min_length=1)
    # robot to drive unless the caller names one: a shipped robot or a model
    robot: str | None = None
    # time between commands [s]; None: the robot's
    control_period: float | None = Field(default=None, gt=0.0, le=10.0)
    scan: Any = None  # as in `sectors.layout_of`; None: the beams of the robot's lidar
    # the network's inputs, by name
    inputs: dict[str, ForeignInput] = Field(min_length=1)
    # the network's recurrent inputs, by name
    states: dict[str, ForeignState] = Field(default_factory=dict)
    # the commands, by name
    outputs: dict[str, OutputCommand] = Field(default_factory=dict)
    # instead of `outputs`: fixed commands that the network chooses from
    choices: Choices | None = None

    @model_validator(mode="after")
    def _check_outputs(self) -> "ForeignPolicy":
        if bool(self.outputs) == (self.choices is not None):
            raise ValueError("give either `outputs:` or `choices:`")
        return self
