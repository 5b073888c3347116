"""Where a drive is written to: an `.npz` file, or the folder of a rosbag2."""

from __future__ import annotations

import os
import tempfile
from importlib.util import find_spec
from pathlib import Path

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.kinematics.bag_writer import write_bag
from nics_drl_bridge.kinematics.recording import Recording, save_recording
from nics_drl_bridge.kinematics.spec import RobotSpec

NPZ = ".npz"


def check_out(path: str | Path) -> Path:
    """The `.npz` file, or the folder of a rosbag2, that a recording is to be written to.

    Raises:
        ConfigError: it is there already, or has a suffix that is neither's.
    """
    path = Path(path)
    if path.exists():
        raise ConfigError(f"{path}: is there already; give another name, or remove it.")
    if path.suffix not in (NPZ, ""):
        raise ConfigError(
            f"{path}: unknown kind of recording {path.suffix!r}; name a file *{NPZ}, or the "
            "folder of a rosbag2 without suffix."
        )
    if path.suffix != NPZ and find_spec("rosbags") is None:
        raise ConfigError(
            f"{path}: writing a rosbag2 needs the library rosbags; install it with pip install "
            f"'nics_drl_bridge[bags]', or name a file *{NPZ}."
        )
    return path


def write_drive(recording: Recording, path: str | Path, spec: RobotSpec) -> None:
    """Writes a recording, whole or not at all: `.npz`, or else a rosbag2 in MCAP.

    Raises:
        RecordingError: it can't be written.
    """
    path = Path(path)
    if path.suffix == NPZ:
        save_recording(recording, path)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as temporary:
        folder = Path(temporary) / path.name
        write_bag(recording, folder, spec)
        os.rename(folder, path)
