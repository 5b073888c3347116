"""Opens a recording, whatever it is kept in."""

from __future__ import annotations

from pathlib import Path

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.kinematics.bag_reader import is_bag, load_bag
from nics_drl_bridge.kinematics.csv_reader import load_csv_folder
from nics_drl_bridge.kinematics.recording import Recording, load_npz
from nics_drl_bridge.kinematics.spec import RobotSpec
from nics_drl_bridge.kinematics.topic_roles import TopicRoles


def read_recording(
    path: str | Path, spec: RobotSpec | None = None, topics: TopicRoles | None = None
) -> Recording:
    """Reads a recording: an `.npz` of this package, a rosbag2, or a folder of CSV files.

    Args:
        path: the file or the folder.
        spec: the robot, which tells what a bag's `cmd_vel` and joints mean.
        topics: which topic of a bag plays which role; guessed by default.

    Returns:
        The recording.

    Raises:
        RecordingError: there is none, or it can't be read.
    """
    path = Path(path)
    if path.exists() and is_bag(path):
        if spec is None:
            raise RecordingError(f"{path}: is a bag; say of which robot, with a RobotSpec.")
        return load_bag(path, topics or TopicRoles(), spec)
    if topics is not None and topics != TopicRoles():
        raise RecordingError(f"{path}: is no bag; topics can be given for a bag only.")
    if path.is_dir():
        return load_csv_folder(path)
    if path.suffix == ".npz":
        return load_npz(path)
    if not path.exists():
        raise RecordingError(f"{path}: no such file or folder; check the path.")
    raise RecordingError(
        f"{path}: is neither an .npz file nor a folder of CSV files nor a rosbag2; give one of "
        "these."
    )
