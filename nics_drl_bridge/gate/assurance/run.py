"""A resumable run of a protocol, and the log of its episodes."""

import json
import os
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.files import format_json, lock_file, write_text
from nics_drl_bridge.gate.assurance.episodes import configure_gate, drive
from nics_drl_bridge.gate.assurance.limit_judge import LimitJudge
from nics_drl_bridge.gate.assurance.place import POLICY, Job, Place
from nics_drl_bridge.gate.assurance.protocol import CLAIMS, Protocol, Trial
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.generator import SimulatorModel

FORMAT = "nics_drl_bridge/assurance/1"
RESULT = "assurance.json"
LOG = "episodes.jsonl"
FAULT_LOG = "faults.jsonl"
Row = dict[str, Any]  # a trial in a log, with its outcome
Tell = Callable[[int, int], None]  # numbers of finished and of all trials


class Run:
    """Drives the trials of a protocol."""

    def __init__(self, protocol: Protocol, model: SimulatorModel) -> None:
        self.protocol = protocol
        self._model = model
        self._limits = load_limits(protocol.limits, model.robot)
        self._places: dict[tuple[str, bool], Place] = {}
        # Wrong limits must fail before a long run.
        configure_gate(model, protocol.limits)

    def open_place(self, world: str, kind: str) -> Place:
        """Returns the place of an episode; only the policy's are randomised."""
        is_policy = kind == POLICY
        if (world, is_policy) not in self._places:
            randomisation = self.protocol.randomisation if is_policy else None
            place = Place(self._model, world, self.protocol.policy, randomisation)
            self._places[world, is_policy] = place
        return self._places[world, is_policy]

    def drive(self, trial: Trial) -> Row:
        """Drives an episode."""
        place = self.open_place(trial.world, trial.kind)
        config = None
        if trial.gated:
            config = configure_gate(place.model, self.protocol.limits)
        slopes = self.protocol.claims == CLAIMS
        judge = LimitJudge(self._model.robot, self._limits, slopes)
        outcome = drive(place, config, Job(trial.kind, trial.seed), judge.see)
        violations = {name: n for name, n in judge.violations.items() if n}
        return asdict(outcome) | trial._asdict() | {"violations": violations}


def begin(folder: Path, protocol: Protocol) -> None:
    """Writes the protocol, or checks it against that of the existing run."""
    file = folder / RESULT
    if file.exists():
        protocol.check_same(read_result(folder)["protocol"], str(folder))
        return
    for log in (LOG, FAULT_LOG):
        if (folder / log).exists():
            raise ConfigError(
                f"{folder}: has a {log} without {RESULT}; choose another --out."
            )
    write_result(folder, protocol, complete=False)


def write_result(folder: Path, protocol: Protocol, **results: Any) -> None:
    """Writes the protocol with its hash, and results."""
    data = {
        "format": FORMAT,
        "protocol": protocol.data,
        "protocol_sha256": protocol.sha256,
        **results,
    }
    write_text(folder / RESULT, format_json(data, indent=1) + "\n")


def read_result(folder: Path) -> dict[str, Any]:
    """Returns what `write_result` wrote. Raises ConfigError for another file."""
    file = folder / RESULT
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
        if data["format"] == FORMAT and isinstance(data["protocol"], dict):
            return dict(data)
    except (ValueError, KeyError, TypeError):
        pass
    raise ConfigError(f"{file}: is not a result of nics assure; choose another --out.")


def drive_all(
    log: Path,
    trials: list[Trial],
    drive_rest: Callable[[list[Trial]], Iterable[Row]],
    tell: Tell,
) -> list[Row]:
    """Drives the trials missing from a log; returns all rows in order. May raise ConfigError.

    A trial without a row is repeated by the next run.
    """
    log.touch()
    with log.open("r+b") as file:
        lock_file(log, file)
        rows, size = read_rows(log, trials)
        file.truncate(size)  # a killed run may have left part of a line
        file.seek(size)
        tell(len(rows), len(trials))
        done = {_read_trial(row) for row in rows}
        for row in drive_rest([trial for trial in trials if trial not in done]):
            line = format_json(row)
            file.write(line.encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())
            rows.append(json.loads(line))
            tell(len(rows), len(trials))
    numbers = {trial: number for number, trial in enumerate(trials)}
    return sorted(rows, key=lambda row: numbers[_read_trial(row)])


def read_rows(log: Path, trials: list[Trial]) -> tuple[list[Row], int]:
    """Returns the complete rows of a log and their size [bytes]."""
    *lines, _ = log.read_bytes().split(b"\n")
    left = set(trials)
    rows = []
    for number, line in enumerate(lines, 1):
        try:
            row = json.loads(line)
            left.remove(_read_trial(row))
        except (ValueError, KeyError, TypeError):
            fault = f"line {number} is not an episode of this run"
            raise ConfigError(f"{log}: {fault}; choose another --out.") from None
        rows.append(row)
    return rows, sum(len(line) + 1 for line in lines)


def _read_trial(row: Row) -> Trial:
    return Trial(**{name: row[name] for name in Trial._fields})
