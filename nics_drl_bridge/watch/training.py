"""Shows some worlds of a training from time to time, at no cost while no page is open."""

import time
from typing import Protocol

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.watch.frame import Frame, Stage, Track, WorldFrame
from nics_drl_bridge.watch.server import PageServer

MOST_WORLDS = 9
PERIOD_S = 0.1  # between two frames [s]


class Envs(Protocol):
    """Vector envs that are stepped together, like `TrainingWorlds`."""

    envs: tuple[BridgeVectorEnv, ...]


class TrainingView:
    """Shows the first worlds of each vector env; call it after each step of all envs."""

    def __init__(self, server: PageServer, training: Envs) -> None:
        self._server = server
        envs = training.envs
        worlds_per_env = max(1, MOST_WORLDS // len(envs))
        sizes = [len(env.world.members) for env in envs]
        self._worlds = [  # each with the index of the first member of its world set
            (env, n, sum(sizes[:k]), Track())
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
        for env, n, _, trail in self._worlds:
            trail.add(env.simulator.data.pose[n], int(env.simulator.data.steps[n]))
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
        for env, n, first, trail in self._worlds:
            shot = env.snapshot(n)
            name = f"{env.world.name} {n}"
            time_s = shot.step * env.model.control_period
            place = first + shot.member
            worlds.append(WorldFrame(shot, name, place, trail.paths, time_s=time_s))
        period_s = self._worlds[0][0].model.control_period
        return Frame(self._steps * period_s, tuple(worlds), self.note)
