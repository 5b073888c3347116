"""Prints the frames of a dataset as LeRobot gives them; run by an interpreter that has lerobot."""

import importlib.util
import json
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType

# It is imported for pictures, of which there are none here.
if importlib.util.find_spec("torchvision") is None:
    for name in ("torchvision", "torchvision.transforms", "torchvision.transforms.v2"):
        module = sys.modules[name] = ModuleType(name)
        module.__spec__ = ModuleSpec(name, None)
        module.__version__ = "0"
        above, _, own = name.rpartition(".")
        if above:
            setattr(sys.modules[above], own, module)

from lerobot.datasets.lerobot_dataset import LeRobotDataset

whole = LeRobotDataset("local/drive", root=sys.argv[1], video_backend="pyav")
told: dict[str, list] = {}
for frame in whole:
    for key, value in frame.items():
        told.setdefault(key, []).append(
            value if isinstance(value, str) else value.tolist()
        )
step = 1.0 / whole.fps
ahead = {"action": [0.0, step, 2.0 * step]}
second = LeRobotDataset(
    "local/drive",
    root=sys.argv[1],
    episodes=[1],
    delta_timestamps=ahead,
    video_backend="pyav",
)
told["ahead"] = second[0]["action"].tolist()
print(json.dumps(told))
