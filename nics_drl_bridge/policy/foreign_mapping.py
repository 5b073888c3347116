"""The mapping of a foreign policy: meaning of each input and output of somebody else's network."""

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
MOST_SCANS = 64  # of a history


class Scaled(Schema):
    """Numbers as a network takes them: cut to `limits`, (x - subtract) / divide, cut to `clip`."""

    limits: Limits | None = None  # least and greatest before scaling; None: not cut
    # subtracted first: one number for all elements, or one for each
    subtract: Numbers = 0.0
    # by which that is divided: one number for all elements, or one for each
    divide: Numbers = 1.0
    clip: Limits | None = None  # least and greatest after scaling; None: not cut

    @field_validator("divide")
    @classmethod
    def _not_zero(cls, divide: Numbers) -> Numbers:
        if 0.0 in (divide if isinstance(divide, tuple) else (divide,)):
            raise ValueError("must not be 0")
        return divide

    @field_validator("limits", "clip")
    @classmethod
    def _ordered(cls, limits: Limits | None) -> Limits | None:
        if limits is not None and not limits[0] < limits[1]:
            raise ValueError("must be [least, greatest]")
        return limits


class InputPart(Scaled):
    """Consecutive elements of an input: one quantity, in SI units unless scaled."""

    of: Quantity  # the quantity; the guide lists them with their units
    clockwise: bool = False  # order of a scan
    history: int = Field(
        default=1, ge=1, le=MOST_SCANS
    )  # steps of it, this and earlier ones
    newest_first: bool = False  # order of a history
    # the network's, whose numbers of the step before are `last.output`
    output: str | None = None
    value: Numbers | None = None  # of a `constant`

    @model_validator(mode="after")
    def _complete(self) -> "InputPart":
        for key, owner in (("output", "last.output"), ("value", "constant")):
            if (getattr(self, key) is not None) != (self.of == owner):
                verb = "needs" if self.of == owner else "has no"
                raise ValueError(f"`of: {self.of}` {verb} `{key}:`")
        if self.clockwise and self.of != "scan":
            raise ValueError(f"`of: {self.of}` has no `clockwise:`")
        return self


class ForeignInput(Scaled):
    """An input of the network: its parts in order, then scaled as a whole."""

    parts: tuple[InputPart, ...] = Field(
        min_length=1
    )  # quantities that fill it, in order


class ForeignState(Schema):
    """A state of the network, an input that takes an output of the step before."""

    next: str  # name of that output
    start: Numbers = 0.0  # its value when an episode begins


class OutputCommand(Schema):
    """A command by an element of an output: cut to `limits`, x * multiply + add, cut to `clip`."""

    of: str | None = None  # the output; None: the command is always `add`
    index: int = Field(default=0, ge=0)  # which element of the flattened output
    limits: Limits | None = None  # least and greatest before scaling; None: not cut
    multiply: float = 1.0  # factor on the element
    add: float = 0.0  # added after that, in the unit of the command
    # least and greatest command; None: the robot's own limits alone
    clip: Limits | None = None


class Choices(Schema):
    """Commands to choose from: by the greatest number of an output, or by its whole number."""

    of: str  # name of the output that chooses
    commands: tuple[dict[str, float], ...] = Field(
        min_length=1
    )  # in order; what a row omits is 0


class ForeignPolicy(Schema):
    """A network of somebody else, and what its inputs and outputs mean.

    Commands are `forward` and `left` [m/s] and `turn` [rad/s], or have the robot's own names.
    """

    kind: Literal["foreign policy"]  # says what the file is
    network: str = Field(
        min_length=1
    )  # an .onnx file or a LEAPP bundle, relative to the mapping
    # that it drives where none is named: a shipped one or a model
    robot: str | None = None
    control_period: float | None = Field(
        default=None, gt=0.0, le=10.0
    )  # None: the robot's [s]
    scan: Any = None  # as in `sectors.layout_of`; None: the beams of the robot's lidar
    inputs: dict[str, ForeignInput] = Field(
        min_length=1
    )  # the network's inputs, by their names
    states: dict[str, ForeignState] = Field(
        default_factory=dict
    )  # its recurrent inputs, by name
    outputs: dict[str, OutputCommand] = Field(
        default_factory=dict
    )  # the commands, by their names
    # instead of `outputs`: fixed commands, of which it chooses one
    choices: Choices | None = None

    @model_validator(mode="after")
    def _one_way_out(self) -> "ForeignPolicy":
        if bool(self.outputs) == (self.choices is not None):
            raise ValueError("give either `outputs:` or `choices:`")
        return self
