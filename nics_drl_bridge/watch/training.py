"""Shows some worlds of a training from time to time, at no cost while no page is open."""

import time
from typing import NamedTuple, Protocol

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.watch.frame import Frame, Stage, Track, WorldFrame
from nics_drl_bridge.watch.server import PageServer

MOST_WORLDS = 9
PERIOD_S = 0.1  # between two frames [s]


class Envs(Protocol):
    """Vector envs that are stepped together, like `TrainingWorlds`."""

    envs: tuple[BridgeVectorEnv, ...]


class _ShownWorld(NamedTuple):
    """A world that is shown."""

    env: BridgeVectorEnv
    row: int  # its index in the vector env
    first_member: (
        int  # index in `Stage.worlds` of the first member of the env's world set
    )
    track: Track


class TrainingView:
    """Shows the first worlds of each vector env; call it after each step of all envs."""

    def __init__(self, server: PageServer, training: Envs) -> None:
        self._server = server
        envs = training.envs
        worlds_per_env = max(1, MOST_WORLDS // len(envs))
        sizes = [len(env.world.members) for env in envs]
        self._worlds = [
            _ShownWorld(env, n, sum(sizes[:k]), Track())
            for k, env in enumerate(envs[:MOST_WORLDS])
            for n in range(min(worlds_per_env, env.num_envs))
        ]
        self._shown_s = 0.0
        self._steps = 0
        self.note = ""
        self._measured = 0  # the last measured step
        names = ", ".join(env.world.name for env in envs)
        places = tuple(env.world for env in envs)
        server.set_stage(Stage(f"training in {names}", envs[0].model, places))

    def __call__(self) -> None:
        """Counts a step, and shows a frame if one is due and a page is open."""
        self._steps += 1
        if not self._server.watched:
            return
        now = time.monotonic()
        due = now - self._shown_s >= PERIOD_S
        for world in self._worlds:
            data = world.env.simulator.data
            world.track.add(data.pose[world.row], int(data.steps[world.row]))
        if not due:
            return
        if self._measured == self._steps - 1:
            self._shown_s = now
            self._server.publish(self._make_frame())
        else:
            # Velocities will be known after the next step.
            self._server.measure(self._make_frame())
        self._measured = self._steps

    def _make_frame(self) -> Frame:
        worlds = []
        for world in self._worlds:
            shot = world.env.snapshot(world.row)
            name = f"{world.env.world.name} {world.row}"
            time_s = shot.step * world.env.model.control_period
            place = world.first_member + shot.member
            paths = world.track.paths
            worlds.append(WorldFrame(shot, name, place, paths, time_s=time_s))
        period_s = self._worlds[0].env.model.control_period
        return Frame(self._steps * period_s, tuple(worlds), self.note)
