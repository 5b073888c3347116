"""The black box: the last half minute of the gate, written at each stop, for replay."""

import base64
import json
from dataclasses import fields, is_dataclass
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np

from nics_drl_bridge.config import read_text
from nics_drl_bridge.errors import ConfigError, shorten
from nics_drl_bridge.files import hash_bytes, write_parts
from nics_drl_bridge.gate import inputs, limits, state
from nics_drl_bridge.gate.gate import decide
from nics_drl_bridge.gate.inputs import Input
from nics_drl_bridge.gate.seal import SEAL, append_checksum
from nics_drl_bridge.gate.state import Decision, GateConfig, GateState

FORMAT = "nics_drl_bridge/black_box/4"
LATEST_S = 1e12
MOST_BYTES = 64 * 2**20  # maximum size of a file that is replayed
# maximum number of values in such a file; 30 s of a gate have 100,000
MOST_VALUES = 1_000_000
# maximum number of inputs that are replayed; each takes about 30 us
MOST_INPUTS = 20_000


class Entry(NamedTuple):
    """One input of the gate at a steady time [s], the state before it, and the decision."""

    now: float
    given: Input
    before: GateState
    decision: Decision


def write(config: GateConfig, entries: tuple[Entry, ...], path: str | Path) -> None:
    """Writes entries (at least one) to a file, completely or not at all."""
    head = format_head(config, entries[0].before)
    write_parts(path, append_checksum(chain([head], map(format_entry, entries))))


def format_head(config: GateConfig, state: GateState) -> bytes:
    """Returns the first line of a file: the state before the first entry."""
    return _format_record({"format": FORMAT, "config": config, "state": state})


def format_entry(entry: Entry) -> bytes:
    """Returns the line of an entry."""
    return _format_record(
        {"now": entry.now, "given": entry.given, "decision": entry.decision}
    )


def _format_record(record: dict[str, Any]) -> bytes:
    plain = {key: to_plain(part) for key, part in record.items()}
    return f"{json.dumps(plain)}\n".encode()


class Replay(NamedTuple):
    """Content of a black box, with the recorded decisions."""

    entries: tuple[Entry, ...]
    # indices of the entries whose replayed decision differs
    differing: tuple[int, ...]

    @property
    def story(self) -> list[str]:
        """Returns a line per change between passing and stopping, and one about the replay."""
        if not self.entries:
            return ["no inputs"]
        end = self.entries[-1].now
        lines = []
        before = "nothing"
        for entry in self.entries:
            cause = entry.decision.cause
            rule = "" if cause is None else cause.rule
            if rule != before:
                line = "commands pass" if cause is None else f"stopped by {cause.line}"
                lines.append(f"{entry.now - end:+8.3f} s  {line}")
            before = rule
        verdict = "all decided the same again"
        if self.differing:
            verdict = (
                f"{len(self.differing)} decided otherwise, first {self.differing[0]}"
            )
        spent = f"{len(self.entries)} inputs over {end - self.entries[0].now:.3f} s"
        return [*lines, f"{spent}: {verdict}"]


def replay(path: str | Path) -> Replay:
    """Repeats all decisions in a file. Raises ConfigError if it is not a complete black box."""
    head, *lines = _read_records(path)
    entries = []
    differing = []
    try:
        if len(lines) > MOST_INPUTS:
            fault = f"{len(lines)} inputs, where at most {MOST_INPUTS} are replayed"
            raise ValueError(fault)
        config = _read_kind(head["config"], GateConfig)
        state = _read_kind(head["state"], GateState)
        for index, line in enumerate(lines):
            entry = _read_entry(line, state)
            entries.append(entry)
            state, replayed = decide(config, state, entry.given, entry.now)
            if json.dumps(to_plain(replayed)) != json.dumps(line["decision"]):
                differing.append(index)
    except Exception as error:  # noqa: BLE001 - false records break the rules in any way
        reason = shorten(str(error), 120)
        raise ConfigError(
            f"{path}: is damaged ({reason}); it can't be replayed."
        ) from None
    return Replay(tuple(entries), tuple(differing))


def _read_entry(line: dict[str, Any], before: GateState) -> Entry:
    """Raises TypeError or ValueError for content that does not belong in a black box."""
    now = line["now"]
    if not (isinstance(now, float | int) and abs(now) < LATEST_S):
        raise ValueError("the time of an input is no time")
    given = _read_kind(line["given"], *get_args(Input))
    return Entry(now, given, before, _read_kind(line["decision"], Decision))


def _read_kind(plain: Any, *kinds: type) -> Any:
    value = from_plain(plain)
    if not isinstance(value, kinds):
        names = " or ".join(kind.__name__ for kind in kinds)
        raise TypeError(f"a {type(value).__name__} stands for a {names}")
    return value


def _read_records(path: str | Path) -> list[dict[str, Any]]:
    text = read_text(path, MOST_BYTES)
    values = sum(map(text.count, ",[{"))
    if values > MOST_VALUES:
        raise ConfigError(
            f"{path}: contains {values} values; a black box has at most {MOST_VALUES}."
        )
    try:
        lines = [json.loads(line) for line in text.splitlines()]
    except (ValueError, RecursionError):
        raise ConfigError(
            f"{path}: is not JSON, line by line; it can't be replayed."
        ) from None
    if not lines or not isinstance(lines[0], dict) or lines[0].get("format") != FORMAT:
        raise ConfigError(f"{path}: is not a black box of the gate ({FORMAT}).")
    content = text.encode()
    rest = content[: -len(SEAL % hash_bytes(b"").encode())]
    if content != rest + SEAL % hash_bytes(rest).encode():
        raise ConfigError(
            f"{path}: is damaged (its checksum does not match); it can't be replayed."
        )
    return lines[:-1]


KIND = "kind"
KINDS: dict[str, type] = {
    name: kind
    for name, kind in (vars(inputs) | vars(limits) | vars(state)).items()
    if isinstance(kind, type) and is_dataclass(kind)
}


def to_plain(value: Any) -> Any:
    """Returns a record of the gate as plain data for JSON; arrays and floats keep their bits."""
    if is_dataclass(value) and not isinstance(value, type):
        content = {
            field.name: to_plain(getattr(value, field.name)) for field in fields(value)
        }
        return {KIND: type(value).__name__, **content}
    if isinstance(value, np.ndarray):
        data = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode()
        return {
            KIND: "array",
            "type": value.dtype.str,
            "shape": list(value.shape),
            "data": data,
        }
    if isinstance(value, tuple):
        return [to_plain(part) for part in value]
    return value.item() if isinstance(value, np.generic) else value


def from_plain(value: Any) -> Any:
    """Returns the record from `to_plain`'s output. Raises ValueError if it is damaged."""
    if isinstance(value, list):
        return tuple(from_plain(part) for part in value)
    if not isinstance(value, dict):
        return value
    content = dict(value)
    kind = content.pop(KIND, None)
    try:
        if kind == "array":
            data = base64.b64decode(content["data"])
            return (
                np.frombuffer(data, np.dtype(content["type"]))
                .reshape(content["shape"])
                .copy()
            )
        return KINDS[kind](**{name: from_plain(part) for name, part in content.items()})
    except (KeyError, TypeError) as error:
        raise ValueError(f"{kind!r} can't be read ({error})") from None
