"""Opens a recording, whatever it is kept in."""

from __future__ import annotations

from pathlib import Path

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.kinematics.bag_file import is_bag
from nics_drl_bridge.kinematics.bag_reader import load_bag
from nics_drl_bridge.kinematics.csv_reader import load_csv_folder
from nics_drl_bridge.kinematics.recording import Recording, load_npz
from nics_drl_bridge.kinematics.spec import RobotSpec
from nics_drl_bridge.kinematics.topic_roles import TopicRoles

ROS_1 = ".bag"


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
        raise RecordingError(
            f"{path}: is no bag; leave out --topics and --topic, which are for bags only."
        )
    if path.is_dir():
        return load_csv_folder(path)
    if path.suffix == ".npz":
        return load_npz(path)
    if not path.exists():
        raise RecordingError(f"{path}: no such file or folder; check the path.")
    if path.suffix == ROS_1:
        raise RecordingError(
            f"{path}: is a bag of ROS 1; make a rosbag2 of it with `rosbags-convert --src "
            f"{path.name} --dst {path.stem}`."
        )
    raise RecordingError(
        f"{path}: is neither an .npz file nor a folder of CSV files nor a rosbag2; give one of "
        "these."
    )
