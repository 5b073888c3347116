"""How far does a newcomer get within the first hour, from a clean clone and a fresh environment?

`make setup` in a clone, then four roads, each in a folder of its own, by the commands of the pages:
a picture of a robot that moves; a robot of one's own, a TurtleBot3 Burger by its YAML file, to a
policy in `doorway`; a recording of one's own to a report; a task of one's own to a policy. What is
not committed is not in the clone. Typing and reading are not in the times. `compile_s` is the CPU
time of all cores that the set-up takes to compile the kernels, of which the clone has none.
"""

import json
import re
import shlex
import tempfile
from pathlib import Path

from bench import (
    ROOT,
    Bars,
    Benchmark,
    Control,
    Given,
    Result,
    at_least,
    at_most,
    run_benchmark,
    some_of,
)
from measuring.environments import inherit_for_newcomer, wait_for
from PIL import Image, ImageChops

LONGEST_S = {"picture": 180.0, "robot": 600.0, "recording": 600.0, "task": 600.0}
"""The set-up is included in the time of the picture; a reader may type for 5 minutes on top of that
of the robot."""
SUCCESS = {"robot": 0.9, "task": 0.5}
EXTENTS = {
    "moved_pixels": at_least(20, "picture: extent of what moves [pixels]"),
    "report_bytes": at_least(1, "recording: size of the report"),
    "compile_s": at_most(60, "compiling all kernels [s of a core]"),
    "kernels": at_least(100, "kernels that were compiled"),
}
COMPILED = re.compile(r"compiled (\d+) kernels in .*\((\d+) s of CPU\)")
BURGER = """name: my_robot
kind: differential
footprint: [[0.04, 0.1], [-0.1, 0.1], [-0.1, -0.1], [0.04, -0.1]]
lidar: turtlebot3_lds_02
lidar_mount: [-0.032, 0.0, 0.0]
parameters: {wheel_radius: 0.033, track: 0.16}
command:
  - {name: forward_command, unit: m/s, min: -0.22, max: 0.22, cmd_vel: linear.x}
  - {name: turn_command, unit: rad/s, min: -2.84, max: 2.84, cmd_vel: angular.z}
"""
TASK = "examples/own_task.py:Patrol"
ROADS = {
    "picture": ("nics watch differential --world circles --record moving.gif",),
    "robot": (
        "nics drive --robot my_robot.yaml --out my_robot",
        "nics train --robot my_robot --world doorway --out run --json",
    ),
    "recording": (
        "nics drive --robot my_robot.yaml --recording drive.npz --out textbook",
        "nics inspect drive.npz",
        "nics generate drive.npz --robot my_robot.yaml --world arena --out my_robot",
    ),
    "task": (
        f"nics train --task {TASK} --robot differential --world circles --steps 400000 --out run "
        "--json",
    ),
}


def moved(picture: Path) -> int:
    """Extent of what differs between the first and the last picture of an animation [pixels]."""
    with Image.open(picture) as film:
        first = film.convert("RGB")
        film.seek(film.n_frames - 1)
        box = ImageChops.difference(first, film.convert("RGB")).getbbox()
    return max(box[2] - box[0], box[3] - box[1]) if box else 0


def travelled(
    name: str, clone: Path, folder: Path, around: dict[str, str], control: str | None
) -> tuple[float, list[str]]:
    """Goes one of the roads; returns how long it took [s], and what each command printed."""
    folder.mkdir()
    (folder / "examples").symlink_to(clone / "examples")
    (folder / "my_robot.yaml").write_text(BURGER)
    taken = 0.0
    told = []
    for line in ROADS[name]:
        words = shlex.split(line)
        if control == "untrained" and words[1] == "train":
            words += ["--steps", "2048"]
        words[0] = str(clone / ".venv" / "bin" / "nics")
        seconds, printed = wait_for(words, folder, around)
        taken = taken + seconds
        told = [*told, printed]
    return taken, told


def measure(given: Given) -> Result:
    """How far does a newcomer get within the first hour, from a clean clone?

    See the head of this file.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        clone = folder / "clone"
        around = inherit_for_newcomer(folder)
        wait_for(["git", "clone", "--quiet", str(ROOT), str(clone)], folder, around)
        setup_s, told = wait_for(["sh", "-c", "make setup 2>&1"], clone, around)
        compiled = COMPILED.search(told)
        if compiled is None:
            raise RuntimeError(f"make setup compiled nothing:\n{told[-2000:]}")
        kernels, compile_s = compiled.groups()
        result: Result = {
            "seconds": {},
            "setup_s": setup_s,
            "success": {},
            "compile_s": float(compile_s),
            "kernels": int(kernels),
        }
        for road in given.roads:
            home = folder / road
            seconds, told = travelled(road, clone, home, around, given.control)
            result["seconds"][road] = seconds
            if road in SUCCESS:
                (world,) = json.loads(told[-1])["seeds"][0]["worlds"].values()
                result["success"][road] = world["success"]["value"]
        if "picture" in given.roads:
            result["seconds"]["picture"] += setup_s
            result["moved_pixels"] = moved(folder / "picture" / "moving.gif")
        if "recording" in given.roads:
            report = folder / "recording" / "my_robot" / "report.html"
            result["report_bytes"] = report.stat().st_size if report.is_file() else 0
    return result


def set_bars(result: Result) -> Bars:
    return {
        "seconds": {name: at_most(LONGEST_S[name]) for name in result["seconds"]},
        "success": {name: at_least(SUCCESS[name]) for name in result["success"]},
        **{name: bar for name, bar in EXTENTS.items() if name in result},
    }


BENCHMARKS = {
    "first_hour": Benchmark(
        measure,
        set_bars,
        {
            "untrained": Control(
                "the learning: a policy is trained for 2,048 steps",
                "success: robot",
                "--roads robot",
            )
        },
        {"roads": some_of(tuple(ROADS))},
        short=None,
    )
}

if __name__ == "__main__":
    run_benchmark(BENCHMARKS)
