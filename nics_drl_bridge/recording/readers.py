"""Readers of recordings: `FORMATS` recognises a recording and names the function that reads it."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.recording.bag_file import is_bag
from nics_drl_bridge.recording.bag_reader import load_bag
from nics_drl_bridge.recording.csv_folder import load_csv_folder
from nics_drl_bridge.recording.recording import Recording, load_recording
from nics_drl_bridge.recording.topic_roles import TopicRoles
from nics_drl_bridge.robot.spec import RobotSpec

ROS_1 = ".bag"


class Format(NamedTuple):
    """A format of recordings; the reader gets path, robot and roles of topics."""

    name: str
    recognises: Callable[[Path], bool]
    read: Callable[[Path, RobotSpec | None, TopicRoles], Recording]
    has_topics: bool = False


FORMATS = (
    Format("a rosbag2", lambda p: p.exists() and is_bag(p), load_bag, has_topics=True),
    Format("a folder of CSV files", Path.is_dir, lambda path, *_: load_csv_folder(path)),
    Format("an .npz file", lambda p: p.suffix == ".npz", lambda path, *_: load_recording(path)),
)
"""The first that recognises a path reads it."""


def read_recording(
    path: str | Path, spec: RobotSpec | None = None, topics: TopicRoles | None = None
) -> Recording:
    """Reads any of `FORMATS`, a bag with its robot; RecordingError: missing, or unreadable."""
    path, topics = Path(path), topics or TopicRoles()
    found = next((each for each in FORMATS if each.recognises(path)), None)
    if topics != TopicRoles() and not (found and found.has_topics):
        advice = "leave out --topics and --topic, which are for bags only"
        raise RecordingError(f"{path}: is no bag; {advice}.")
    if found is not None:
        return found.read(path, spec, topics)
    if not path.exists():
        raise RecordingError(f"{path}: no such file or folder; check the path.")
    if path.suffix == ROS_1:
        command = f"rosbags-convert --src {path.name} --dst {path.stem}"
        raise RecordingError(f"{path}: is a bag of ROS 1; make a rosbag2 of it with `{command}`.")
    names = " nor ".join(each.name for each in FORMATS)
    raise RecordingError(f"{path}: is neither {names}; give one of these.")
