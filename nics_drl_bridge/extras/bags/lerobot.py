"""Frames as a LeRobot dataset, format v3.0: Parquet and JSON, which `LeRobotDataset` opens."""

import json
from collections.abc import Collection, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.extras.bags.frames import BagFrames, Feature
from nics_drl_bridge.files import check_folder, whole_folder, write_text

if TYPE_CHECKING:
    from pyarrow import Table

VERSION = "v3.0"
INFO = "meta/info.json"
STATS = "meta/stats.json"
TASKS = "meta/tasks.parquet"
NUMBERED = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA = f"data/{NUMBERED}"
EPISODES = f"meta/episodes/{NUMBERED}"
# files of a folder, and their greatest sizes
CHUNK_FILES = 1000
FILE_MB = 100
VIDEO_MB = 200
SUCCESS = "next.success"
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
INDEX = "__index_level_0__"  # as pandas names the column of an index without a name
Columns = dict[str, NDArray[Any]]


def check_output(folder: str | Path) -> None:
    """Raises ConfigError if a dataset can't be written to a folder, before the bag is read."""
    if find_spec("pyarrow") is None:
        raise ConfigError(
            f"{folder}: a dataset needs the library pyarrow; pip install pyarrow."
        )
    check_folder(folder, INFO)


def write_dataset(
    frames: BagFrames,
    folder: str | Path,
    task: str,
    robot: str | None = None,
    succeeded: Collection[int] | None = None,
) -> None:
    """Writes a dataset, whole or not at all; it replaces one that is there. Raises ConfigError.

    `task` says in words what the robot was to do; `succeeded` are the numbers of the episodes in
    which it did, or None where that is not known.
    """
    check_output(folder)
    import pyarrow

    columns = _columns(frames, succeeded)
    ends = np.cumsum(frames.lengths)
    files = _files(frames)
    with whole_folder(folder, INFO, _is_of_a_dataset) as root:
        rows = []
        for k, (end, length) in enumerate(zip(ends, frames.lengths, strict=True)):
            part = {
                name: column[end - length : end] for name, column in columns.items()
            }
            rows.append(
                _episode_row(k, int(end), int(length), task, files[k], _stats(part))
            )
        for number in dict.fromkeys(files):
            inside = [k for k, each in enumerate(files) if each == number]
            begin = ends[inside[0]] - frames.lengths[inside[0]]
            end = ends[inside[-1]]
            some = {name: column[begin:end] for name, column in columns.items()}
            _write(_table(some), root / _numbered(DATA, number))
        _write(pyarrow.Table.from_pylist(rows), root / _numbered(EPISODES, 0))
        _write(_tasks(task), root / TASKS)
        for name, told in (
            (INFO, _info(frames, columns, robot)),
            (STATS, _stats(columns)),
        ):
            write_text(root / name, json.dumps(told, indent=4) + "\n")


def _is_of_a_dataset(name: str) -> bool:
    """True for the path of a file of any dataset in its folder."""
    return name.split("/")[0] in ("data", "meta", "videos", "images")


def _columns(frames: BagFrames, succeeded: Collection[int] | None) -> Columns:
    """The columns of all frames: features (T, D), and flags and indices (T,)."""
    lengths = frames.lengths
    total = int(frames.lengths.sum())
    episode = np.repeat(np.arange(len(lengths)), lengths)
    frame = np.arange(total) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    columns: Columns = {
        name: feature.values for name, feature in frames.features.items()
    }
    if succeeded is not None:
        for k in sorted(succeeded):
            if not 0 <= k < len(lengths):
                last = f"the episodes are 0 to {len(lengths) - 1}"
                raise ConfigError(f"--succeeded {k}: there is no such episode; {last}.")
        reached = np.isin(episode, sorted(succeeded))
        columns[SUCCESS] = reached & (frame == np.repeat(lengths, lengths) - 1)
    return columns | {
        "timestamp": (frame / frames.fps).astype(np.float32),
        "frame_index": frame,
        "episode_index": episode,
        "index": np.arange(total),
        "task_index": np.zeros(total, dtype=np.int64),
    }


def _files(frames: BagFrames) -> list[int]:
    """The number of the file of each episode; one that is too large has a file for itself."""
    width = (
        sum(4 * feature.values.shape[1] for feature in frames.features.values()) + 40
    )
    numbers = []
    number = 0
    filled = 0
    for length in frames.lengths:
        size = width * int(length)
        if filled and filled + size > FILE_MB * 2**20:
            number = number + 1
            filled = 0
        numbers.append(number)
        filled += size
    return numbers


def _place(number: int) -> dict[str, int]:
    return {"chunk_index": number // CHUNK_FILES, "file_index": number % CHUNK_FILES}


def _numbered(path: str, number: int) -> str:
    return path.format(**_place(number))


def _stats(columns: Mapping[str, NDArray[Any]]) -> dict[str, dict[str, list[Any]]]:
    found = {}
    for name, column in columns.items():
        table = column.reshape(len(column), -1).astype(np.float64)
        told = {"min": table.min(0), "max": table.max(0), "mean": table.mean(0)}
        told |= {"std": table.std(0), "count": np.array([len(table)])}
        told |= dict(
            zip(QUANTILES, np.quantile(table, list(QUANTILES.values()), 0), strict=True)
        )
        found[name] = {key: values.tolist() for key, values in told.items()}
    return found


def _episode_row(
    k: int,
    end: int,
    length: int,
    task: str,
    file: int,
    stats: Mapping[str, Mapping[str, Any]],
) -> dict[str, Any]:
    told: dict[str, Any] = {
        "episode_index": k,
        "tasks": [task],
        "length": length,
        "dataset_from_index": end - length,
        "dataset_to_index": end,
    }
    told |= {f"data/{key}": value for key, value in _place(file).items()}
    told |= {f"meta/episodes/{key}": value for key, value in _place(0).items()}
    for name, each in stats.items():
        told |= {f"stats/{name}/{key}": values for key, values in each.items()}
    return told


def _info(frames: BagFrames, columns: Columns, robot: str | None) -> dict[str, Any]:
    episodes = len(frames.lengths)
    return {
        "codebase_version": VERSION,
        "robot_type": robot,
        "total_episodes": episodes,
        "total_frames": int(frames.lengths.sum()),
        "total_tasks": 1,
        "chunks_size": CHUNK_FILES,
        "data_files_size_in_mb": FILE_MB,
        "video_files_size_in_mb": VIDEO_MB,
        "fps": frames.fps,
        "splits": {"train": f"0:{episodes}"},
        "data_path": DATA,
        "video_path": None,
        "features": {
            name: _described(column, frames.features.get(name))
            for name, column in columns.items()
        },
    }


def _described(column: NDArray[Any], feature: Feature | None) -> dict[str, Any]:
    shape = list(column.shape[1:]) or [1]
    names = list(feature.names) if feature and feature.names else None
    told: dict[str, Any] = {"dtype": column.dtype.name, "shape": shape, "names": names}
    return told | ({"info": dict(feature.info)} if feature and feature.info else {})


def _table(columns: Columns) -> "Table":
    import pyarrow

    def array(column: NDArray[Any]) -> Any:
        # What has one element is a scalar to LeRobot, and else a list of a fixed length.
        flat = pyarrow.array(np.ascontiguousarray(column).reshape(-1))
        wide = column.ndim > 1 and column.shape[1] > 1
        if wide:
            return pyarrow.FixedSizeListArray.from_arrays(flat, column.shape[1])
        return flat

    return pyarrow.table({name: array(column) for name, column in columns.items()})


def _tasks(task: str) -> "Table":
    """The tasks as pandas writes them: the text is the index of the table."""
    import pyarrow

    kinds = {"task_index": ("int64", "int64"), INDEX: ("unicode", "object")}
    described = [
        {
            "name": None if name == INDEX else name,
            "field_name": name,
            "pandas_type": kind,
            "numpy_type": numpy_kind,
            "metadata": None,
        }
        for name, (kind, numpy_kind) in kinds.items()
    ]
    pandas = {"index_columns": [INDEX], "column_indexes": [], "columns": described}
    table = pyarrow.table({"task_index": [0], INDEX: [task]})
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})


def _write(table: "Table", path: Path) -> None:
    from pyarrow import parquet

    path.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(table, path)
