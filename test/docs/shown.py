"""The `nics` lines of the pages, and the files that a reader has when he types them."""

from __future__ import annotations

import re
import runpy
import shlex
import shutil
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image

from docs.test_pages import FENCED, INDENTED, ROOT, text_of
from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.generator import builtin_model, save_model
from nics_drl_bridge.recording.recording import Recording, save_recording
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.robot.spec import load_robot

SHORT = {
    "train": ("--steps", "2048", "--episodes", "2"),
    "evaluate": ("--episodes", "1"),
    "watch": ("--episodes", "1"),
    "assure": ("--episodes", "1", "--faults", "0"),
}
ELSEWHERE = {
    r"nics (record|doctor (--model|--policy|--namespace)|bag record|watch --ros)": "hears a robot",
    r"nics doctor --load": "starts nodes",
    r"nics evaluate .*--hardware": "drives a robot",
    r"nics bag replay drive( --rate| --lockstep)": "feeds nodes",
    r"nics watch (?!.*--record)": "serves until Ctrl-C",
    r"nics train .*(--watch|--engine ray)": "serves until Ctrl-C, or needs a cluster",
    r"nics (up|arm|goal|stop)": "starts nodes, or talks to them",
    r"nics install": "needs a compiler",
    r"nics train --settings shipped_": "is a long training",
}
"""Lines that tests of the command itself run, as they need more than files or a short while."""
ROBOT = "kind: differential\nfootprint_radius: 0.2\n"
WORLD = "name: hall\nsize: [6.0, 6.0]\ngoal_distance: [2.0, 4.0]\n"
SDF = """<sdf version="1.6"><world name="hall"><model name="pillar"><static>true</static>
<pose>2 1 0.5 0 0 0</pose><link name="link"><collision name="c"><geometry><cylinder>
<radius>0.2</radius><length>1.0</length></cylinder></geometry></collision></link></model></world></sdf>
"""


def lines_of(page: Path) -> list[str]:
    """The lines of a page's blocks that begin with `nics`, in order."""
    plain = re.sub(r"\\\n\s+", "", FENCED.sub("", text_of(page)))
    lines = [
        line.strip() for block in INDENTED.findall(plain) for line in block.splitlines()
    ]
    return [line for line in lines if re.match(r"nics [a-z]", line)]


def runs_here(line: str) -> bool:
    return not any(re.match(pattern, line) for pattern in ELSEWHERE)


def drive_of(robot: str | Path, seed: int = 0) -> Recording:
    return record(load_robot(robot), np.random.default_rng(seed), 40.0, dt=0.02)


def drive(path: Path) -> None:
    """What `nics record` keeps of the reader's robot, else of the shipped one."""
    own = path.with_name("my_robot.yaml")
    save_recording(drive_of(own if own.exists() else "differential"), path)


def table(path: Path, seed: int = 0) -> None:
    """A drive as columns of text."""
    drive = drive_of("differential", seed)
    rows = np.column_stack([drive.pose.t, drive.pose.values, drive.command.values])
    np.savetxt(
        path,
        rows,
        delimiter=",",
        header="t,x,y,yaw,cmd_vel_x,cmd_vel_omega",
        comments="",
    )


def bag(path: Path) -> None:
    """The topics of a robot that somebody drives about, and its pose by a motion capture."""
    import bags

    env = BridgeEnv(model="differential", world="empty", estimator=True)
    data = env._backend.simulator.data
    rng = np.random.default_rng(2)
    topics: dict[str, list[Any]] = {}
    env.reset(seed=1)
    actions = np.repeat(rng.uniform(-0.8, 0.8, (60, 2)), 5, axis=0)
    for k, action in enumerate(actions, 1):
        t = 0.1 * k
        forward, _, turn = env.task.robot.to_cmd_vel(env.task.command(action))
        velocity = data.twist[0, 0].tolist()
        said = {
            "/odom": bags.moving_odometry(
                t, data.odom[0, 0].tolist(), velocity, covariance=0.01
            ),
            "/scan": bags.scan_of(env.task.lidar, t, data.ranges[0, 0]),
            "/cmd_vel": bags.twist(float(forward), 0.0, float(turn)),
            "/mocap": bags.pose_stamped(t, *data.pose[0, 0].tolist()),
        }
        for topic, message in said.items():
            topics.setdefault(topic, []).append((t, message))
        env.step(action)
    env.close()
    bags.write(path, topics)


def map_of(path: Path) -> None:
    """A map of Nav2 with a room in it."""
    picture(path.with_suffix(".pgm"))
    given = {
        "image": f"{path.stem}.pgm",
        "resolution": 0.05,
        "origin": [-4.0, -4.0, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.25,
    }
    path.write_text(yaml.safe_dump(given))


def picture(path: Path) -> None:
    cells = np.full((160, 160), 255, np.uint8)
    cells[:4] = 0
    cells[-4:] = 0
    cells[:, :4] = 0
    cells[:, -4:] = 0
    Image.fromarray(cells).save(path)


def foreign(path: Path) -> None:
    """Somebody's network and its mapping, by the example that makes them."""
    import onnx

    example = runpy.run_path(str(ROOT / "examples" / "drive_foreign_policy.py"))
    onnx.save(example["network"](), path.with_name("theirs.onnx"))
    path.write_text(example["MAPPING"] + "robot: differential\n")


def model(path: Path) -> None:
    save_model(builtin_model("differential"), path)


def policy(path: Path) -> None:
    shutil.copy(ROOT / "config" / "policies" / "differential.onnx", path)


def text(content: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(content)


def shown(page: str, place: int) -> Callable[[Path], object]:
    """The text of a fenced block of a page."""
    blocks = [m["text"] for m in FENCED.finditer(text_of(ROOT / "docs" / page))]
    return lambda path: path.write_text(blocks[place])


def worlds(path: Path) -> None:
    path.mkdir()
    for k in range(2):
        (path / f"hall_{k}.yaml").write_text(WORLD)


SUPPLIES: dict[str, Callable[[Path], object]] = {
    "my_robot.yaml": text(ROBOT),
    "my_drive.csv": table,
    "SOURCE": table,
    "my_drive": bag,
    "drive": bag,
    "monday.csv": table,
    "tuesday.csv": partial(table, seed=1),
    "drive.npz": drive,
    "my_robot": model,
    "my_car": model,
    "my.onnx": policy,
    "my_world.yaml": text(WORLD),
    "my_worlds": worlds,
    "my_task.py": text(
        text_of(ROOT / "examples" / "own_task.py").replace("Patrol", "MyTask")
    ),
    "hall.world": text(SDF),
    "world_1.world": text(SDF),
    "my_map.yaml": map_of,
    "plan.png": picture,
    "theirs.yaml": foreign,
    "rear.yaml": shown("sensors.md", 0),
}
WRITES = ("--out", "-o", "--map", "--mcap", "--record", "--recording")


def supply(line: str, folder: Path) -> None:
    """Puts those files of a reader there that a line reads and no line before it wrote."""
    words = shlex.split(line, comments=True)
    read = [word for before, word in pairwise(words) if before not in WRITES]
    names = {
        "my_worlds" if "my_worlds" in word else re.split(r"[/:]", word)[0]
        for word in read
    }
    for (
        name,
        make,
    ) in SUPPLIES.items():  # in their order: a drive is of the robot that is there
        if name in names and not (folder / name).exists():
            make(folder / name)


def words_of(line: str, folder: Path) -> list[str]:
    """The words as a shell gives them to the command, with what makes it short."""
    words = shlex.split(line, comments=True)[1:]
    names = [
        sorted(p.name for p in folder.glob(w)) if w == "*.world" else [w] for w in words
    ]
    return [*(name for some in names for name in some), *SHORT.get(words[0], ())]
