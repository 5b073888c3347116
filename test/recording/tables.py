"""Tables for tests: a drive as columns, written as users have them, drafted and read."""

from pathlib import Path
from typing import Any

import numpy as np

from nics_drl_bridge.config import parse_yaml
from nics_drl_bridge.recording.mapping import DriveMapping
from nics_drl_bridge.recording.mapping_draft import propose_mapping
from nics_drl_bridge.recording.readers import open_source, read_recording
from nics_drl_bridge.recording.recording import Recording
from nics_drl_bridge.recording.survey import inspect_tables

MAP: dict[str, Any] = {
    "time": "t",
    "pose": {"x": "x", "y": "y", "heading": "yaw"},
    "command": {"v": "v", "w": "w"},
}


def drive(count: int = 200) -> dict[str, np.ndarray]:
    """Columns of a drive at 50 Hz: a curve at 0.5 m/s that turns by 0.25 rad/s."""
    t = np.arange(count) * 0.02
    yaw = 0.25 * t
    return {
        "t": t,
        "x": 2.0 * np.sin(yaw),
        "y": 2.0 - 2.0 * np.cos(yaw),
        "yaw": yaw,
        "v": np.full(count, 0.5),
        "w": np.where(t < 2.0, 0.25, 0.3),
    }


def write(
    path: Path, columns: dict[str, Any], separator: str = ",", header: bool = True
) -> Path:
    """Writes columns as text, a row per line."""
    rows = [separator.join(columns)] if header else []
    rows += [
        separator.join(f"{v:.12g}" if isinstance(v, float) else str(v) for v in row)
        for row in zip(*(np.asarray(c).tolist() for c in columns.values()), strict=True)
    ]
    path.write_text("\n".join(rows) + "\n")
    return path


def read(path: Path, changes: str = "") -> Recording:
    """Reads a recording by `MAP` with other keys, in YAML; null removes one."""
    return read_recording(path, mapping=change_map(changes))


def change_map(changes: str) -> DriveMapping:
    """Returns `MAP` with other keys, in YAML; null removes one."""
    given = MAP | (parse_yaml(changes, "changes") if changes else {})
    return DriveMapping.model_validate(
        {k: v for k, v in given.items() if v is not None}
    )


def draft(path: Path) -> tuple[str, dict[str, Any]]:
    """Returns the draft of a recording's mapping: its text, and the same as data."""
    with open_source(path) as source:
        text = propose_mapping(inspect_tables(source)).text
    return text, parse_yaml(text, "draft")


def read_draft(path: Path, drafted: dict[str, Any]) -> Recording:
    """Reads a recording by a draft."""
    return read_recording(path, mapping=DriveMapping.model_validate(drafted))
