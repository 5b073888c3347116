"""The contract of a policy file: its training, and the robot that it needs."""

import base64
import dataclasses
import json
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
from nics_drl_bridge.errors import ConfigError, PolicyError
from nics_drl_bridge.files import hash_bytes
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.lidar.sectors import ScanLayout
from nics_drl_bridge.lidar.sensor import AnySensor
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.robot.spec import RobotSpec

FORMAT = "nics_drl_bridge/policy/1"
SUFFIX = ".onnx"
MAPPINGS = (".yaml", ".yml")  # suffixes of the mapping of a foreign policy
GOLDEN = 16
GOLDEN_SEED = 0
# distance from zero of golden observations, if their limits are wider
GOLDEN_SPREAD = 3.0
GAP_PERIODS = 5  # control periods without an observation after which a state is reset
MOST_ENTRIES = 20_000
CHECKSUM = 8  # hexadecimal digits of a field's checksum, which detects mistakes but is no signature
Rows = NDArray[np.float32]


def shipped() -> Path:
    """The folder of the policy files that come with the package."""
    return share_folder() / "config" / "policies"


class TaskEntry(Schema):
    """The task of a policy."""

    name: str = Field(
        min_length=1
    )  # as in `env.registry.TASKS`, or the name of a user's class
    options: dict[str, Any]  # all of its options except `scan` and `sensors`
    sha256: str = Field(pattern="^[0-9a-f]{64}$")  # over name, options and observation


class ObservationEntry(Schema):
    """Input of the network: `scan_parts` that are a scan, then others with their limits."""

    size: int = Field(ge=1, le=200_000)
    scan_parts: int = Field(ge=0)
    rest_low: tuple[float, ...]
    rest_high: tuple[float, ...]


class StateEntry(Schema):
    """State of a policy, which its graph takes and gives: `state_in` and `state_out` (n, size)."""

    size: int = Field(ge=1, le=200_000)
    start: float = Field(ge=-1e6, le=1e6)  # each element when an episode begins
    longest_gap: float = Field(
        gt=0.0
    )  # between two observations [s]; after a longer one: as above


class GoldenEntry(Schema):
    """Sixteen pairs that must be reproduced; float32, little endian, in base 64.

    Those of a policy with a state are one episode, from its first step on.
    """

    observations: str  # (16, O)
    actions: str  # (16, C), or (16, 1) discrete
    commands: str  # (16, C) SI

    def rows(self, name: str) -> Rows:
        """One of the arrays as (16, ...). Raises ValueError if it is damaged."""
        data = base64.b64decode(getattr(self, name), validate=True)
        return np.frombuffer(data, "<f4").reshape(GOLDEN, -1)


class Contract(Schema):
    """All that a policy file states about itself and the model that it was trained in."""

    format: Literal["nics_drl_bridge/policy/1"]
    robot: RobotSpec
    lidar: LidarSpec
    scan: (
        ScanLayout | None
    )  # sectors of its observations; None: the beams of exactly this lidar
    sensors: tuple[AnySensor, ...] = ()  # further ones that it observes
    task: TaskEntry
    observation: ObservationEntry
    # None: each action follows from one observation alone
    state: StateEntry | None = None
    # greatest number of observations in one run; None: any
    batch: Literal[1] | None = None
    actions: Literal["continuous", "discrete"]
    control_period: float = Field(gt=0.0, le=10.0)  # time between commands [s]
    # time limit of the episodes that it learnt in; older files do not tell it
    max_episode_steps: int | None = Field(default=None, ge=1)
    model_fingerprint: str = Field(pattern="^[0-9a-f]{16}$")
    provenance: dict[str, Any]  # command, seed and versions of its making
    graph_sha256: str = Field(
        pattern="^[0-9a-f]{64}$"
    )  # of the graph, including the weights
    golden: GoldenEntry  # pairs that must be reproduced
    checksums: dict[str, str]  # of each entry above, by its path

    @field_validator("provenance")
    @classmethod
    def _plain(cls, provenance: dict[str, Any]) -> dict[str, Any]:
        if any(
            not isinstance(v, str | int | float | bool | None)
            for v in provenance.values()
        ):
            raise ValueError("must hold words and numbers only")
        return provenance


def contract_of(
    task: Task,
    model: SimulatorModel,
    golden: Mapping[str, Rows],
    graph_sha256: str,
    provenance: Mapping[str, Any],
    state: tuple[int, float] | None = None,
    batch: Literal[1] | None = None,
    max_episode_steps: int | None = None,
) -> str:
    """Writes the contract of a policy as JSON; the state is its size and start value.

    Raises ConfigError if an entry has a wrong type.
    """
    entry = task_entry(task)
    observation = observation_entry(task)
    data: dict[str, Any] = {
        "format": FORMAT,
        "robot": task.robot.model_dump(mode="json"),
        "lidar": task.lidar.model_dump(mode="json"),
        "scan": None if task.scan is None else task.scan.model_dump(mode="json"),
        "task": {**entry, "sha256": _task_hash(entry, observation)},
        "observation": observation,
        "actions": task.actions,
        "control_period": model.control_period,
        "model_fingerprint": model.fingerprint,
        "provenance": dict(provenance),
        "graph_sha256": graph_sha256,
        "golden": {
            name: base64.b64encode(np.ascontiguousarray(rows, "<f4").tobytes()).decode()
            for name, rows in golden.items()
        },
    }
    if task.sensors:
        data["sensors"] = [sensor.model_dump(mode="json") for sensor in task.sensors]
    if state is not None:
        gap = GAP_PERIODS * model.control_period
        data["state"] = {"size": state[0], "start": state[1], "longest_gap": gap}
    if batch is not None:
        data["batch"] = batch
    if max_episode_steps is not None:
        data["max_episode_steps"] = max_episode_steps
    data["checksums"] = checksums(data)
    validate(data, Contract, "policy")
    return json.dumps(data, allow_nan=False)


def golden_observations(task: Task) -> Rows:
    """Observations (16, O) within the limits of a task's, always the same ones."""
    space = task.observation_space
    low = np.maximum(space.low, -GOLDEN_SPREAD)
    high = np.minimum(space.high, GOLDEN_SPREAD)
    rng = np.random.default_rng(GOLDEN_SEED)
    return rng.uniform(low, high, (GOLDEN, len(low))).astype(np.float32)


def task_entry(task: Task) -> dict[str, Any]:
    """Name and options of a task."""
    kind = type(task)
    path = f"{kind.__module__}:{kind.__name__}"
    name = next((name for name, place in TASKS.items() if place == path), kind.__name__)
    options = {
        field.name: getattr(task, field.name)
        for field in dataclasses.fields(task)
        if field.init and field.name not in ("robot", "lidar", "scan", "sensors")
    }
    return {"name": name, "options": options}


def observation_entry(task: Task) -> dict[str, Any]:
    """Observation of a task, as the entries of `ObservationEntry`."""
    space = task.observation_space
    parts = task.scan_parts
    return {
        "size": int(space.shape[0]),
        "scan_parts": parts,
        "rest_low": [float(value) for value in space.low[parts:]],
        "rest_high": [float(value) for value in space.high[parts:]],
    }


def _task_hash(entry: Mapping[str, Any], observation: Mapping[str, Any]) -> str:
    known = {
        "name": entry["name"],
        "options": entry["options"],
        "observation": observation,
    }
    return hash_bytes(json.dumps(known, sort_keys=True).encode())


def leaves(data: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yields every entry of nested mappings and lists with its path, as `robot.command.0.max`."""
    if isinstance(data, dict | list) and data:
        for key, value in data.items() if isinstance(data, dict) else enumerate(data):
            yield from leaves(value, f"{path}.{key}" if path else str(key))
    else:
        yield path, data


def checksums(data: Mapping[str, Any]) -> dict[str, str]:
    """Checksum of each entry except `checksums`, by path."""
    known = {name: value for name, value in data.items() if name != "checksums"}
    return {
        path: hash_bytes(json.dumps(v).encode())[:CHECKSUM] for path, v in leaves(known)
    }


def read_contract(text: str, source: str) -> Contract:
    """Reads and checks the contract of a policy file. Raises PolicyError, which names the field."""
    entries = sum(map(text.count, ",[{"))
    if entries > MOST_ENTRIES:
        reason = f"has {entries} entries, a contract at most {MOST_ENTRIES}; not read."
        raise PolicyError(source, "metadata", reason)
    try:
        data = json.loads(text, object_pairs_hook=_once, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        reason = f"is not JSON as `export_policy` writes it ({str(error)[:80]})"
        raise PolicyError(
            source, "metadata", f"{reason}; export the policy anew."
        ) from None
    given = data.get("format") if isinstance(data, dict) else None
    if given != FORMAT:
        reason = f"is {reprlib.repr(given)}, not {FORMAT!r}; export the policy with this version."
        raise PolicyError(source, "format", reason)
    try:
        contract = validate(data, Contract, source)
    except ConfigError as error:
        reason = str(error).removeprefix(f"{source}: ")
        # What is missing can't be added to a file that is signed.
        reason = reason.replace(
            "is missing; add it.", "is missing; export the policy anew."
        )
        quoted = reason.split("'")
        key = quoted[1] if len(quoted) > 2 and "key" in quoted[0] else "metadata"
        raise PolicyError(source, key, reason) from None
    _check_unchanged(data, source)
    _check_agreement(contract, source)
    return contract


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(dict(pairs)) != len(pairs):
        raise ValueError("a key stands twice")
    return dict(pairs)


def _no_constant(word: str) -> Any:
    raise ValueError(f"{word} is no number")


def _check_unchanged(data: dict[str, Any], source: str) -> None:
    now = checksums(data)
    then = data["checksums"]
    for path in (*now, *then):
        if now.get(path) != then.get(path):
            reason = "was changed after the export; take the file as it was exported."
            raise PolicyError(source, path, reason)


def _check_agreement(contract: Contract, source: str) -> None:
    observation = contract.observation
    scan = contract.scan
    parts = contract.lidar.beams if scan is None else scan.sectors
    name = "lidar.beams" if scan is None else "scan.sectors"
    rest = len(observation.rest_low)
    if observation.scan_parts != parts:
        reason = f"is {parts}, but observations hold {observation.scan_parts} parts of a scan."
        raise PolicyError(source, name, reason)
    if observation.size != parts + rest or len(observation.rest_high) != rest:
        reason = (
            f"is {observation.size}, not the {parts} of the scan and {rest} others."
        )
        raise PolicyError(source, "observation.size", reason)
    seen = observation.model_dump(mode="json")
    if contract.task.sha256 != _task_hash(contract.task.model_dump(), seen):
        raise PolicyError(
            source, "task.sha256", "does not belong to the task and observation."
        )
    commands = len(contract.robot.command)
    actions = 1 if contract.actions == "discrete" else commands
    sizes = {"observations": observation.size, "commands": commands, "actions": actions}
    for name, size in sizes.items():
        try:
            rows = contract.golden.rows(name)
        except ValueError:
            raise PolicyError(source, f"golden.{name}", "is damaged.") from None
        if rows.shape != (GOLDEN, size) or not np.isfinite(rows).all():
            reason = (
                f"must be {GOLDEN} rows of {size} finite numbers, not {rows.shape}."
            )
            raise PolicyError(source, f"golden.{name}", reason)
