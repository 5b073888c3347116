"""The contract of a policy file: the training behind it, and the robot that it requires."""

import base64
import dataclasses
import json
import math
import reprlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from nics_drl_bridge.config import Schema, share_folder, validate
from nics_drl_bridge.env.registry import TASKS
from nics_drl_bridge.env.task import Task
from nics_drl_bridge.errors import ConfigError, PolicyError, shorten
from nics_drl_bridge.files import hash_bytes
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.lidar.sectors import ScanLayout
from nics_drl_bridge.lidar.sensor import AnySensor
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.robot.spec import RobotSpec

FORMAT = "nics_drl_bridge/policy/1"
SUFFIX = ".onnx"
MAPPINGS = (".yaml", ".yml")  # suffixes of the files that map a foreign policy
GOLDEN = 16
GOLDEN_SEED = 0
# maximum magnitude of golden observations, if their limits are wider
GOLDEN_SPREAD = 3.0
GAP_PERIODS = 5  # control periods without an observation after which the state is reset
MOST_ENTRIES = 20_000
Rows = NDArray[np.float32]


def shipped() -> Path:
    """Returns the folder of the shipped policy files."""
    return share_folder() / "config" / "policies"


class TaskEntry(Schema):
    """The task of a policy."""

    # a name in `env.registry.TASKS`, or the name of a user's class
    name: str = Field(min_length=1)
    options: dict[str, Any]  # all options except `scan` and `sensors`
    sha256: str = Field(pattern="^[0-9a-f]{64}$")  # of name, options and observation


class ObservationEntry(Schema):
    """Input of the network: `scan_parts` scan elements first, then the others with their limits."""

    size: int = Field(ge=1, le=200_000)
    scan_parts: int = Field(ge=0)
    rest_low: tuple[float, ...]
    rest_high: tuple[float, ...]


class StateEntry(Schema):
    """State of a policy: graph input `state_in` and output `state_out`, both (n, size)."""

    size: int = Field(ge=1, le=200_000)
    # value of each element at the start of an episode
    start: float = Field(ge=-1e6, le=1e6)
    # maximum time between two observations [s]; a longer gap resets the state
    longest_gap: float = Field(gt=0.0)


def decode_rows(text: str) -> Rows:
    """Decodes an array (16, ...) of golden pairs. Raises ValueError if it is damaged."""
    data = base64.b64decode(text, validate=True)
    return np.frombuffer(data, "<f4").reshape(GOLDEN, -1)


class GoldenEntry(Schema):
    """Sixteen input-output pairs that the graph must reproduce; float32, little endian, base64.

    For a policy with a state they form one episode, starting at its first step.
    """

    observations: str  # (16, O) observations
    actions: str  # (16, C) actions, or (16, 1) discrete ones
    commands: str  # (16, C) commands in SI units

    @field_validator("observations", "actions", "commands")
    @classmethod
    def _check_finite(cls, text: str) -> str:
        if not np.isfinite(decode_rows(text)).all():
            raise ValueError("must be finite numbers")
        return text

    def rows(self, name: str) -> Rows:
        """Returns one of the arrays, (16, ...)."""
        return decode_rows(getattr(self, name))


class Contract(Schema):
    """Everything a policy file states about itself and the model it was trained in."""

    format: Literal["nics_drl_bridge/policy/1"]
    robot: RobotSpec
    lidar: LidarSpec
    # sectors of the observed scan; None: the beams of exactly this lidar
    scan: ScanLayout | None
    sensors: tuple[AnySensor, ...] = ()  # additional sensors that the policy observes
    task: TaskEntry
    observation: ObservationEntry
    # None: the policy has no state
    state: StateEntry | None = None
    # maximum number of observations per run; None: no maximum
    batch: Literal[1] | None = None
    # foreign network: the meaning of its inputs and outputs, see
    # `extras.foreign_policies`
    foreign: dict[str, Any] | None = None
    actions: Literal["continuous", "discrete"]
    control_period: float = Field(gt=0.0, le=10.0)  # time between commands [s]
    # time limit of the training episodes; older files lack it
    max_episode_steps: int | None = Field(default=None, ge=1)
    model_fingerprint: str = Field(pattern="^[0-9a-f]{16}$")
    provenance: dict[str, Any]  # command, seed and versions that produced the file
    # hash of the graph, including the weights
    graph_sha256: str = Field(pattern="^[0-9a-f]{64}$")
    golden: GoldenEntry  # pairs that the graph must reproduce
    checksums: dict[str, str] | None = None  # of older files; not read

    @field_validator("provenance")
    @classmethod
    def _check_plain(cls, provenance: dict[str, Any]) -> dict[str, Any]:
        for value in provenance.values():
            is_plain = isinstance(value, str | int | float | bool | None)
            if not is_plain or (isinstance(value, float) and not math.isfinite(value)):
                raise ValueError("must contain only text and finite numbers")
        return provenance


def make_contract(
    task: Task,
    model: SimulatorModel,
    golden: Mapping[str, Rows],
    graph_sha256: str,
    provenance: Mapping[str, Any],
    state: tuple[int, float] | None = None,
    foreign: Mapping[str, Any] | None = None,
    max_episode_steps: int | None = None,
) -> str:
    """Returns a policy's contract as JSON; `state` is the size and start value of its state.

    A `foreign` network takes one observation at a time. Raises ConfigError if an entry has a wrong
    type.
    """
    entry = describe_task(task)
    observation = describe_observation(task)
    data: dict[str, Any] = {
        "format": FORMAT,
        "robot": task.robot,
        "lidar": task.lidar,
        "scan": task.scan,
        "sensors": task.sensors,
        "task": {**entry, "sha256": _hash_task(entry, observation)},
        "observation": observation,
        "actions": task.actions,
        "control_period": model.control_period,
        "max_episode_steps": max_episode_steps,
        "model_fingerprint": model.fingerprint,
        "provenance": dict(provenance),
        "graph_sha256": graph_sha256,
        "golden": {
            name: base64.b64encode(np.ascontiguousarray(rows, "<f4").tobytes()).decode()
            for name, rows in golden.items()
        },
    }
    if state is not None:
        gap = GAP_PERIODS * model.control_period
        data["state"] = {"size": state[0], "start": state[1], "longest_gap": gap}
    if foreign is not None:
        data |= {"batch": 1, "foreign": dict(foreign)}
    contract = validate(data, Contract, "policy")
    return contract.model_dump_json(exclude={"checksums"})


def draw_golden_observations(task: Task) -> Rows:
    """Returns a fixed set of observations (16, O) within the task's observation space."""
    space = task.observation_space
    low = np.maximum(space.low, -GOLDEN_SPREAD)
    high = np.minimum(space.high, GOLDEN_SPREAD)
    rng = np.random.default_rng(GOLDEN_SEED)
    return rng.uniform(low, high, (GOLDEN, len(low))).astype(np.float32)


def describe_task(task: Task) -> dict[str, Any]:
    """Returns the name, options and hash of a task."""
    kind = type(task)
    path = f"{kind.__module__}:{kind.__name__}"
    name = next((name for name, place in TASKS.items() if place == path), kind.__name__)
    options = {
        field.name: getattr(task, field.name)
        for field in dataclasses.fields(task)
        if field.init and field.name not in ("robot", "lidar", "scan", "sensors")
    }
    return {"name": name, "options": options}


def describe_observation(task: Task) -> dict[str, Any]:
    """Returns a task's observation space as the fields of `ObservationEntry`."""
    space = task.observation_space
    parts = task.scan_parts
    return {
        "size": int(space.shape[0]),
        "scan_parts": parts,
        "rest_low": [float(value) for value in space.low[parts:]],
        "rest_high": [float(value) for value in space.high[parts:]],
    }


def _hash_task(entry: Mapping[str, Any], observation: Mapping[str, Any]) -> str:
    identity = {
        "name": entry["name"],
        "options": entry["options"],
        "observation": observation,
    }
    return hash_bytes(json.dumps(identity, sort_keys=True).encode())


def leaves(data: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yields every leaf of nested mappings and lists with its path, like `robot.command.0.max`."""
    if isinstance(data, dict | list) and data:
        for key, value in data.items() if isinstance(data, dict) else enumerate(data):
            yield from leaves(value, f"{path}.{key}" if path else str(key))
    else:
        yield path, data


def read_contract(text: str, source: str) -> Contract:
    """Reads and checks the contract of a policy file. Raises PolicyError, which names the field."""
    entries = sum(map(text.count, ",[{"))
    if entries > MOST_ENTRIES:
        raise PolicyError(
            source,
            "metadata",
            f"has {entries} entries, more than the {MOST_ENTRIES} of a contract; not read.",
        )
    try:
        data = json.loads(
            text, object_pairs_hook=_refuse_repeats, parse_constant=_refuse_constant
        )
    except (ValueError, RecursionError) as error:
        raise PolicyError(
            source,
            "metadata",
            f"is not the JSON that `export_policy` writes ({shorten(str(error), 80)}); "
            "export the policy again.",
        ) from None
    file_format = data.get("format") if isinstance(data, dict) else None
    if file_format != FORMAT:
        raise PolicyError(
            source,
            "format",
            f"is {reprlib.repr(file_format)}, not {FORMAT!r}; export the policy with this version.",
        )
    try:
        # A missing field can't be added to a signed file.
        contract = validate(data, Contract, source, "export the policy again")
    except ConfigError as error:
        raise PolicyError(source, error.key or "metadata", error.reason) from None
    _check_agreement(contract, source)
    return contract


def _refuse_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(dict(pairs)) != len(pairs):
        raise ValueError("a key occurs twice")
    return dict(pairs)


def _refuse_constant(word: str) -> Any:
    raise ValueError(f"{word} is not a number")


def _check_agreement(contract: Contract, source: str) -> None:
    observation = contract.observation
    scan = contract.scan
    parts = contract.lidar.beams if scan is None else scan.sectors
    name = "lidar.beams" if scan is None else "scan.sectors"
    rest = len(observation.rest_low)
    if observation.scan_parts != parts:
        raise PolicyError(
            source,
            name,
            f"is {parts}, but observations have {observation.scan_parts} scan elements.",
        )
    if observation.size != parts + rest or len(observation.rest_high) != rest:
        raise PolicyError(
            source,
            "observation.size",
            f"is {observation.size}, not {parts} scan elements plus {rest} others.",
        )
    seen = observation.model_dump(mode="json")
    if contract.task.sha256 != _hash_task(contract.task.model_dump(), seen):
        raise PolicyError(
            source, "task.sha256", "does not match the task and observation."
        )
