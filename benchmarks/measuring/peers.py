"""Other simulators, measured one way for every benchmark: irsim_peer.py in a process of its own.

ir-sim and irsim-x both install the module `irsim`, so each gets an environment of its own, made
at first use from the package registry and kept in the user's cache folder. They go through the
same scenes as ours, and their rounds are timed in turn with ours, so that a slow moment of the
machine slows both.

Readings of a peer, all from the same process and scenes:

- `scan`: what their step calls to scan, alone.
- `period`: a control period of our task, observation, reward and autoreset included, of ten motions
  and one scan, as ours. That is equal work. It moves nine times by their inner functions, past what
  they offer to users.
"""

import json
import subprocess
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
from bench import Silence, at_least

from measuring.environments import NotInstalledError, clean, python_with
from nics_drl_bridge.defaults import EPISODE_STEPS
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.sim.scenes import Scene, sample_scene
from nics_drl_bridge.sim.world import World

WITH = ("numpy==2.4.6", "shapely==2.2.0", "matplotlib==3.11.2")
PEERS = {"ir_sim": ("ir-sim==2.12.0", *WITH), "irsim_x": ("irsim-x==1.1.4", *WITH)}
SCRIPT = Path(__file__).resolve().parent / "irsim_peer.py"
MODEL = open_model("differential")
RADIUS = 0.15
CIRCLES = 10
WORLD = World.model_validate(
    {
        "name": "ten circles",
        "size": [6.0, 6.0],
        "obstacles": [
            {
                "shapes": [{"kind": "circle", "radius": RADIUS}],
                "count": CIRCLES,
                "gap": 0.3,
            }
        ],
        "clearance": 0.3,
        "goal_distance": [2.0, 4.0],
    }
)
DRIVEN = {  # of a robot in a control period
    "moved_m_per_period": at_least(0.01),
    "beams_changed_per_period": at_least(100),
    "episodes": at_least(1),
}


class PeerFailedError(Exception):
    """A peer that is installed did not answer; the text says which, and its last word."""


@dataclass
class Peer:
    """A peer's process, and what it answered.

    Attributes:
        name: in `PEERS`.
        process: that answers a line with a line.
        log: its standard error.
        ranges: (N, B) of a scan at the start of each scene [m].
        times: of each reading, in all rounds but the first [s].
        drove: what shows that the robots of its tasks moved and saw.
    """

    name: str
    process: subprocess.Popen[str]
    log: IO[str]
    ranges: np.ndarray = field(default_factory=lambda: np.empty((0, 0), np.float32))
    times: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    drove: dict[str, float] = field(default_factory=dict)

    def answer(self) -> dict[str, Any]:
        """The next line. Raises PeerFailedError if there is none."""
        told = self.process.stdout.readline() if self.process.stdout else ""
        if told:
            return dict(json.loads(told))
        self.log.seek(0)
        last = self.log.read().strip().splitlines()[-1:] or ["no message"]
        raise PeerFailedError(f"{self.name} failed: {last[0]}")

    def round(self, counts: bool) -> None:
        """Has it time every reading a little further. Raises PeerFailedError."""
        if self.process.stdin is None or self.process.poll() is not None:
            self.answer()
            raise PeerFailedError(f"{self.name} ended")
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        told = self.answer()
        self.drove = {name: value for name, value in told.items() if name != "times"}
        for name, each in told["times"].items() if counts else ():
            self.times[name] += each

    def close(self) -> None:
        """Ends the process."""
        self.process.kill()
        self.process.communicate()
        self.log.close()

    def readings(self) -> dict[str, float]:
        """The median of each reading [s], and what shows that the robots drove."""
        found = {
            f"{name}_s": float(np.median(each)) for name, each in self.times.items()
        }
        return {**found, **self.drove}


def make_scenes(count: int) -> list[Scene]:
    """The scenes that everybody goes through, one for each episode."""
    footprint = MODEL.robot.footprint_radius
    return [sample_scene(WORLD, footprint, seed) for seed in range(count)]


def describe_task(drawn: Sequence[Scene]) -> dict[str, Any]:
    """What a peer is told of the scenes."""
    lidar = MODEL.lidar
    return {
        "about": {
            "beams": lidar.beams,
            "angle_range": float(lidar.angles[-1] - lidar.angles[0]),
            "range_min": lidar.range_min,
            "range_max": lidar.range_max,
            "radius": RADIUS,
            "half": (np.array(WORLD.size) / 2.0).tolist(),
            "footprint": MODEL.robot.footprint_radius,
            "period": MODEL.control_period,
            "substeps": MODEL.timing[1],
            "goal_radius": Navigation(MODEL.robot, lidar).goal_radius,
            "limit": EPISODE_STEPS,
        },
        "scenes": [
            {
                "circles": one.bodies[:, :2].tolist(),
                "start": one.starts[0].tolist(),
                "goal": one.goals[0].tolist(),
            }
            for one in drawn
        ],
    }


def start_peer(name: str, task: Mapping[str, Any]) -> Peer:
    """A peer that has scanned each scene once.

    Raises:
        NotInstalledError: it can't be installed here.
        PeerFailedError: it did not answer.
    """
    python = python_with(name, PEERS[name])
    log = tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace")  # noqa: SIM115
    with tempfile.TemporaryDirectory() as folder:
        asked = Path(folder) / "task.json"
        asked.write_text(json.dumps(task))
        process = subprocess.Popen(
            [str(python), str(SCRIPT), str(asked)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            env=clean(),
        )
        peer = Peer(name, process, log)
        try:
            peer.ranges = np.array(peer.answer()["ranges"], dtype=np.float32)
        except PeerFailedError:
            peer.close()
            raise
    return peer


@dataclass(frozen=True)
class Measured:
    """Ours and the peers, timed in turn.

    Attributes:
        seconds: of the processor that each of our calls takes, the median [s].
        wall: likewise of the clock on the wall, for what runs on several threads [s].
        peers: readings of each peer that answered.
        ranges: (N, B) by each of them, of a scan at the start of each scene [m].
        missing: why a peer can't be installed here.
        failed: why a peer that is installed gave no readings.
    """

    seconds: dict[str, float]
    wall: dict[str, float]
    peers: dict[str, dict[str, float]]
    ranges: dict[str, np.ndarray]
    missing: dict[str, str]
    failed: dict[str, str]

    def describe(self) -> dict[str, Any]:
        """Returns what every benchmark tells about the peers, under the same keys."""
        return {
            "peer_readings": self.peers,
            "missing": self.missing,
            "failed": self.failed,
        }


def measure(
    calls: Mapping[str, Callable[[], object]],
    names: Sequence[str],
    drawn: Sequence[Scene],
    rounds: int,
) -> Measured:
    """Times our calls and the peers' readings, all in turn; the first round does not count."""
    found = Measured({}, {}, {}, {}, {}, {})
    peers: dict[str, Peer] = {}
    times: dict[str, list[np.ndarray]] = {name: [] for name in calls}
    try:
        for name in names:
            try:
                peers[name] = start_peer(name, describe_task(drawn))
                found.ranges[name] = peers[name].ranges
            except NotInstalledError as error:
                found.missing[name] = str(error)
            except PeerFailedError as error:
                found.failed[name] = str(error)
        for k in range(1 + rounds):
            for name, call in calls.items():
                begin = np.array([time.process_time(), time.perf_counter()])
                call()
                spent = np.array([time.process_time(), time.perf_counter()]) - begin
                times[name] += [spent] if k else []
            for name in [each for each in peers if each not in found.failed]:
                try:
                    peers[name].round(k > 0)
                except PeerFailedError as error:
                    found.failed[name] = str(error)
        for name, each in times.items():
            found.seconds[name], found.wall[name] = np.median(each, axis=0).tolist()
        found.peers.update(
            {
                name: one.readings()
                for name, one in peers.items()
                if name not in found.failed
            }
        )
    finally:
        for peer in peers.values():
            peer.close()
    return found


def set_bars(result: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the bars of the peers; those that can't be installed have none."""
    return {
        "failed": dict.fromkeys(result["failed"], Silence()),
        "peer_readings": dict.fromkeys(result["peer_readings"], DRIVEN),
    }
