"""The vector environment: many worlds of the fast simulator in one set of arrays."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.generator import SimulatorModel, open_model
from nics_drl_bridge.interface import RobotView
from nics_drl_bridge.lidar.scanner import Renderer
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import World, load_world

Observation = NDArray[np.float32]
Flags = NDArray[np.bool_]


class NavigationVectorEnv(gymnasium.vector.VectorEnv[Observation, Observation, NDArray[Any]]):
    """The navigation task in `num_envs` worlds at once, for training.

    Task, spaces and rewards are those of `BridgeEnv`. The robot's pose is what its odometry
    says, which drifts as the estimate of the single env does. A world that ended begins a new
    episode in the next step (`AutoresetMode.NEXT_STEP`).

    Args:
        num_envs: N.
        model: a SimulatorModel, its folder, or the name of a shipped robot.
        world: a World, its YAML file, or the name of a shipped one.
        max_episode_steps: after so many steps an episode is truncated.
        renderer: `baked` or `exact` lidar.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium's own declaration
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        model: str | SimulatorModel = "ackermann",
        world: str | World = "arena",
        max_episode_steps: int = 300,
        renderer: Renderer = "baked",
    ) -> None:
        self.num_envs, self._limit = num_envs, max_episode_steps
        self.model = open_model(model) if isinstance(model, str) else model
        self.world = load_world(world) if isinstance(world, str) else world
        self.task = Navigation(self.model.robot, self.model.lidar)
        self.single_observation_space = self.task.observation_space
        self.single_action_space = self.task.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.simulator = FastSimulator(self.model, self.world, num_envs, renderer=renderer)
        self._ended: Flags = np.zeros(num_envs, dtype=np.bool_)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins an episode in every world; world i takes its seeds from `seed + i`."""
        super().reset(seed=seed)
        if seed is not None or not hasattr(self, "_generators"):
            first = int(self.np_random.integers(2**31)) if seed is None else seed
            self._generators = [np.random.default_rng(first + n) for n in range(self.num_envs)]
        self._begin(np.arange(self.num_envs))
        self._ended[:] = False
        view = self._view()
        return self.task.observe(view, self._goals), {}

    def _begin(self, worlds: NDArray[np.intp]) -> None:
        seeds = [int(self._generators[n].integers(2**31)) for n in worlds]
        self.simulator.reset(seeds, worlds)  # type: ignore[arg-type]

    @property
    def _goals(self) -> NDArray[np.float64]:
        return self.simulator.goals[:, 0]

    def _view(self) -> RobotView:
        """The robots (N,) as they know themselves, in arrays of their own."""
        data = self.simulator.data
        return RobotView(data.odom[:, 0].copy(), data.twist[:, 0], data.ranges[:, 0], 0.0, 0.0, 0.0)

    def step(
        self, actions: Observation
    ) -> tuple[Observation, NDArray[np.float64], Flags, Flags, dict[str, Any]]:
        """One control period in every world; see Gymnasium."""
        if not np.isfinite(actions).all():
            raise gymnasium.error.InvalidAction("actions hold NaN or inf.")
        before = self._view()
        self.simulator.step(self.task.command(actions)[:, None])
        fresh = np.flatnonzero(self._ended)
        if len(fresh):
            self._begin(fresh)
        after = self._view()
        verdict = self.task.judge(after, self._goals)
        terms = self.task.reward(before, after, self._goals, verdict)
        reward = np.where(self._ended, 0.0, sum(terms.values()))
        terminated = (verdict.reached | verdict.touched) & ~self._ended
        truncated = (self.simulator.data.steps >= self._limit) & ~terminated & ~self._ended
        info = {
            "is_success": verdict.reached & ~verdict.touched & terminated,
            "collision": verdict.touched & terminated,
        }
        self._ended = terminated | truncated
        return self.task.observe(after, self._goals), reward, terminated, truncated, info
