"""The end of a gate that has stopped many times: is it prompt, and is the first stop on disk?"""

from __future__ import annotations

import itertools
import json
import math
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from geometry_msgs.msg import TwistStamped
from parts.faulty_robot import Robot

from nics_drl_bridge.nodes import conversions
from nics_drl_bridge.nodes.processes import NodeProcess

END = "end_after_stops"
PATIENCE_S = 60.0
LIMIT_S = 2.0
FIRST_S = 0.5
"""The first stop comes so soon after the first command that is no number."""


@dataclass(frozen=True)
class Ended:
    """How a gate ended.

    Attributes:
        stops: of the robot before.
        exit_s: from SIGINT to its end [s].
        files: of the black box.
        first_kept: whether the first stop is among them.
    """

    stops: int = 0
    exit_s: float = math.nan
    files: int = 0
    first_kept: bool = False

    def summary(self) -> dict[str, Any]:
        """For the JSON object."""
        return {
            "n": self.stops,
            "exit_s": self.exit_s,
            "limit_s": LIMIT_S,
            "files": self.files,
            "first_kept": self.first_kept,
        }

    def missed(self) -> list[str]:
        """A sentence for each bar that was missed."""
        missed = []
        if self.stops < 2:
            missed.append(f"{END}: {self.stops} stops: nothing was measured")
        if not self.exit_s <= LIMIT_S:
            missed.append(
                f"{END}: ended {self.exit_s} s after SIGINT, limit {LIMIT_S} s"
            )
        if not self.first_kept:
            missed.append(
                f"{END}: the first stop is not among the {self.files} files kept"
            )
        return missed


def end_after_stops(
    robot: Robot,
    gate: NodeProcess | None,
    folder: Path,
    seconds: float,
    told: Callable[[str], None],
) -> Ended:
    """Sends good commands and NaN in turn for so long, then ends the gate.

    Raises:
        NoMotionError: the robot was not told to move.
    """
    robot.drive()
    sent = [0]
    first = [math.inf]

    def change(message: TwistStamped) -> TwistStamped:
        sent[0] += 1
        if sent[0] % 2:
            message.twist = conversions.twist_to_ros([math.nan, 0.0, 0.0])
            first[0] = min(first[0], time.monotonic())
        return message

    robot.heard.clear()
    robot.change["cmd_vel_raw"] = change
    robot.until(lambda: False, seconds)
    moved = [bool(twist.any()) for _, twist in robot.heard]
    stops = sum(a and not b for a, b in itertools.pairwise(moved))
    told(f"{END}: {stops} stops")
    if gate is None:
        return Ended(stops)
    began = time.monotonic()
    gate._process.send_signal(signal.SIGINT)
    robot.until(lambda: gate._process.poll() is not None, PATIENCE_S)
    took = time.monotonic() - began
    files = list((folder / "black_box").glob("*.jsonl"))
    times = [_end_of(file) for file in files]
    kept = any(first[0] - FIRST_S < when < first[0] + FIRST_S for when in times)
    return Ended(stops, round(took, 3), len(files), kept)


def _end_of(file: Path) -> float:
    """Steady time [s] of the last input in a black box, which is the stop that it tells of."""
    lines = file.read_text(encoding="utf-8").splitlines()
    return float(json.loads(lines[-2])["now"])
