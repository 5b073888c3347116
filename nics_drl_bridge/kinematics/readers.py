"""Opens a recording, whatever it is kept in."""

from __future__ import annotations

from pathlib import Path

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.kinematics.csv_reader import load_csv_folder
from nics_drl_bridge.kinematics.recording import Recording, load_npz


def read_recording(path: str | Path) -> Recording:
    """Reads a recording: an `.npz` of this package, or a folder of CSV files.

    Args:
        path: the file or the folder.

    Returns:
        The recording.

    Raises:
        RecordingError: there is none, or it can't be read.
    """
    path = Path(path)
    if path.is_dir():
        return load_csv_folder(path)
    if path.suffix == ".npz":
        return load_npz(path)
    if not path.exists():
        raise RecordingError(f"{path}: no such file or folder; check the path.")
    raise RecordingError(
        f"{path}: is neither an .npz file nor a folder of CSV files; give one of these."
    )
