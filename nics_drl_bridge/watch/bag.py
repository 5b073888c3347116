"""Shows a recorded drive as estimated by the middleware, with a time slider."""

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nics_drl_bridge.env.snapshot import Snapshot, locate_hits
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import S_PER_NS, Array
from nics_drl_bridge.lidar.shapes import BODY
from nics_drl_bridge.middleware.measurement import CMD_VEL, ODOM, POSE, SCAN
from nics_drl_bridge.middleware.playback import Playback, merge_messages, read_messages
from nics_drl_bridge.recording.messages import read_robot_command
from nics_drl_bridge.sim.world import World
from nics_drl_bridge.sim.world_set import AnyWorld
from nics_drl_bridge.watch.frame import Frame, Stage, Track, WorldFrame
from nics_drl_bridge.watch.server import Request

CAN = frozenset({"pause", "speed", "step", "seek", "restart"})
MARGIN_M = 1.0  # margin around the path and the lidar's hits, if no world is given
WITHIN = 98.0  # percentile of the hits that the shown area includes


class BagSource:
    """Plays a bag at the pace of its stamps, with a frame per scan or, without scans, per odometry.

    `topics` are by role, see `playback.choose_topics`. Without a world, the area follows from the
    path and the scans. Raises RecordingError if the bag can't be used.
    """

    def __init__(
        self,
        path: str | Path,
        model: SimulatorModel,
        topics: Mapping[str, str],
        world: AnyWorld | None = None,
        model_name: str = "",
    ) -> None:
        self._times, self._shots, lidar = _read(path, model, topics)
        self._model = replace(model, lidar=lidar)
        self._path = Path(path)
        self._world = world or make_world(self._model, self._shots)
        if len(self._times) > 1:
            self.period_s = float(np.median(np.diff(self._times)))
        else:
            self.period_s = 0.1
        self._now = 0
        self._model_name = model_name

    def stage(self) -> Stage:
        """See `show.FrameSource`."""
        span = float(self._times[0]), float(self._times[-1])
        return Stage(
            self._path.name,
            self._model,
            (self._world,),
            CAN,
            span_s=span,
            model_name=self._model_name,
        )

    def frame(self) -> Frame:
        """See `show.FrameSource`."""
        poses = np.array([shot.poses for shot in self._shots[: self._now + 1]])
        step = -(-len(poses) // Track.MOST)
        paths = tuple(
            np.concatenate([poses[::step], poses[-1:]])[:, :, :2].transpose(1, 0, 2)
        )
        state = "the end" if self._now == len(self._shots) - 1 else ""
        world = WorldFrame(self._shots[self._now], self._path.name, 0, paths, state)
        return Frame(float(self._times[self._now]), (world,))

    def advance(self) -> bool:
        """Advances to the next frame; stays at the last one."""
        self._now = min(self._now + 1, len(self._shots) - 1)
        return False

    def take(self, request: Request) -> bool:
        """See `show.FrameSource`."""
        seconds = request.value if request.kind == "seek" else 0.0
        if request.kind in ("seek", "restart"):
            self._now = max(0, bisect_right(self._times, seconds) - 1)
        return False

    def unfinished(self, _: int) -> bool:
        """Returns True until the end has been shown."""
        return self._now < len(self._shots) - 1

    def close(self) -> None:
        """Does nothing: the bag was read completely."""


def _read(
    path: str | Path, model: SimulatorModel, topics: Mapping[str, str]
) -> tuple[list[float], list[Snapshot], Any]:
    """Returns times since the first one [s], shots, and the lidar of the bag."""
    messages = read_messages(path, topics, model.gyro)
    playback = Playback(model, POSE in messages, any_lidar=True)
    stamps = list[int]()
    shots = list[Snapshot]()
    middleware = playback.middleware
    frame_role = SCAN if SCAN in messages else ODOM
    command: Array | None = None
    for role, message in merge_messages(messages):
        if role == CMD_VEL:
            command = read_robot_command(message.content, model.robot)
        used = playback.take(role, message.receive_ns, message.content)
        shows = used and role == frame_role
        if not shows or ODOM not in middleware.cache.newest:
            continue
        stamps.append(middleware.newest_ns or 0)
        view = middleware.view(stamps[-1])
        shots.append(
            Snapshot(
                view.pose[None],
                view.ranges[None],
                np.zeros((0, BODY)),
                np.zeros((0, 2)),
                step=len(shots),
                estimates=view.pose[None],
                covariance=middleware.estimator.covariance[None, :3, :3].copy(),
                commands=None if command is None else command[None],
            )
        )
    if not shots:
        raise RecordingError(
            f"{path}: none of its odometry and scans could be used; see nics bag info."
        )
    return [(stamp - stamps[0]) * S_PER_NS for stamp in stamps], shots, playback.lidar


def make_world(model: SimulatorModel, shots: list[Snapshot]) -> World:
    """Returns a field without walls that contains the path and most of the lidar's hits."""
    poses = np.concatenate([shot.poses[:, :2] for shot in shots])
    samples = shots[:: max(1, len(shots) // 50)]
    hits = [locate_hits(model.lidar, shot.poses[0], shot.ranges[0]) for shot in samples]
    hits_low, hits_high = np.percentile(
        np.concatenate([poses, *hits]), [100.0 - WITHIN, WITHIN], axis=0
    )
    low = np.minimum(hits_low, poses.min(axis=0)) - MARGIN_M
    high = np.maximum(hits_high, poses.max(axis=0)) + MARGIN_M
    return World(
        name="bag", bounds=(*low.tolist(), *high.tolist()), goal_distance=(0.0, 1.0)
    )
