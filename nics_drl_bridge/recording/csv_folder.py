"""Reader of a folder of CSV files: a car's drive under a motion-capture system."""

import csv
from pathlib import Path

import numpy as np

from nics_drl_bridge.config import no_device
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording.recording import SLOWEST_SAMPLING_S, Recording, Stream

COLUMNS = {
    "cmd.csv": ("linear.x", "angular.z", "time [s]"),
    "vrpn.csv": ("x", "y", "z", "qx", "qy", "qz", "qw", "time [ns]"),
    "L_wheel.csv": ("wheel speed", "time [s]"),
    "R_wheel.csv": ("wheel speed", "time [s]"),
    "acceleration.csv": ("ax", "ay", "az", "time [s]"),
}  # of each file; none has a header line
REQUIRED = ("cmd.csv", "vrpn.csv")
ROBOT_CLOCK, POSE_CLOCK = "robot", "mocap"
MAX_DURATION_S = 1e6
MAX_DURATION_RATIO = 100.0
MOST_BYTES = 64 * 2**20
MOST_ROWS = 500_000
LONGEST_ROW = 1000  # in characters


def load_csv_folder(path: str | Path) -> Recording:
    """Reads a car's drive from CSV files; RecordingError names the file, the row and the fix."""
    # `cmd.csv` (linear.x, angular.z) and `vrpn.csv` are required, wheels are read in pairs.
    path = Path(path)
    if not path.is_dir():
        raise RecordingError(f"{path}: no such folder; check the path.")
    for name in REQUIRED:
        if not (path / name).is_file():
            fault = f"the file {name!r} is missing"
            raise RecordingError(f"{path}: {fault}; a folder needs {REQUIRED}.")
    tables = {name: _read(path / name) for name in COLUMNS if (path / name).exists()}
    command, vrpn = tables["cmd.csv"], tables["vrpn.csv"]
    _check_units(path, tables)
    wheels = None
    if "L_wheel.csv" in tables and "R_wheel.csv" in tables:
        left, right = tables["L_wheel.csv"], tables["R_wheel.csv"]
        at_left = np.interp(left[:, 1], right[:, 1], right[:, 0])
        wheels = Stream(left[:, 1], np.stack([left[:, 0], at_left], axis=1), ROBOT_CLOCK)
    qx, qy, qz, qw = vrpn[:, 3:7].T
    heading = np.arctan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy**2 + qz**2))
    poses = np.stack([vrpn[:, 0], vrpn[:, 1], heading], axis=1)
    return Recording(
        Stream(command[:, 2], command[:, :2], ROBOT_CLOCK),
        Stream(vrpn[:, 7] * 1e-9, poses, POSE_CLOCK), wheels=wheels, source=str(path),
    )  # fmt: skip


def _read(path: Path) -> Array:
    """Reads the numbers of a file and checks them row by row; time is the last column."""
    no_device(path)
    try:
        rows = [(line, row) for line, row in enumerate(csv.reader(_lines(path)), 1) if row]
        if not rows:
            raise ValueError("is empty; record the drive anew")
        table = np.array([_numbers(line, row, COLUMNS[path.name]) for line, row in rows])
        for k in np.flatnonzero(np.diff(table[:, -1]) < 0.0)[:1]:
            fault = f"time runs backwards ({table[k, -1]:.6f}, then {table[k + 1, -1]:.6f})"
            raise ValueError(f"row {rows[k + 1][0]}: {fault}; sort the rows, or cut the file there")
        if path.name == "vrpn.csv":
            norm = np.linalg.norm(table[:, 3:7], axis=1)
            for k in np.flatnonzero(np.abs(norm - 1.0) > 0.05)[:1]:
                fault = f"the quaternion has the length {norm[k]:.3f} and not 1"
                advice = "check the order of the columns (x, y, z, qx, qy, qz, qw, time)"
                raise ValueError(f"row {rows[k][0]}: {fault}; {advice}")
    except UnicodeDecodeError:
        why = "is not UTF-8 text; it must hold comma-separated numbers"
    except (OSError, csv.Error) as error:
        why = f"can't be read ({error})"
    except ValueError as error:
        why = str(error)
    else:
        return table
    raise RecordingError(f"{path}: {why}.")


def _lines(path: Path) -> list[str]:
    """Reads the lines of a file; refuses files and lines larger than those of any drive."""
    if path.stat().st_size > MOST_BYTES:
        raise ValueError(f"is larger than {MOST_BYTES // 2**20} MB, which no drive is; cut it")
    lines = path.read_bytes().split(b"\n")
    if len(lines) > MOST_ROWS:
        raise ValueError(f"has {len(lines)} rows, and a drive at most {MOST_ROWS}; cut it")
    for k, line in enumerate(lines, 1):
        if len(line) > LONGEST_ROW:
            raise ValueError(f"row {k} has {len(line)} characters, which no row has; remove it")
    return [str(line, "utf-8") for line in lines]


def _numbers(line: int, row: list[str], columns: tuple[str, ...]) -> list[float]:
    if len(row) != len(columns):
        needed = f"{len(columns)} are needed ({', '.join(columns)})"
        raise ValueError(f"row {line} has {len(row)} columns where {needed}; mend or remove it")
    values = []
    for name, text in zip(columns, row, strict=True):
        try:
            values.append(float(text))
        except ValueError:
            fault = f"row {line}: {name} is {text[:40]!r}, which is no number"
            advice = "mend the row, or remove it (these files have no header)"
            raise ValueError(f"{fault}; {advice}") from None
    if not np.isfinite(values).all():
        raise ValueError(f"row {line} holds NaN or inf; remove the row")
    return values


def _check_units(path: Path, tables: dict[str, Array]) -> None:
    """Refuses files whose durations differ; commands that are seconds apart show which is wrong."""
    times = tables["cmd.csv"][:, -1]
    seconds, step = np.ptp(times), np.median(np.diff(times)) if len(times) > 1 else 0.0
    for name, table in tables.items():
        unit, factor = ("nanoseconds", 1e-9) if name == "vrpn.csv" else ("seconds", 1.0)
        lasted = np.ptp(table[:, -1]) * factor
        alike = seconds == 0.0 or 1 / MAX_DURATION_RATIO < lasted / seconds < MAX_DURATION_RATIO
        if seconds > MAX_DURATION_S or (not alike and step > SLOWEST_SAMPLING_S):
            fault = f"lasts {seconds:.3g} s, with {step:.3g} s from one command to the next"
            raise RecordingError(f"{path / 'cmd.csv'}: {fault}; its stamps must be in seconds.")
        if not alike:
            fault = f"lasts {lasted:.3g} s where the commands last {seconds:.3g} s"
            raise RecordingError(f"{path / name}: {fault}; its stamps must be in {unit}.")
