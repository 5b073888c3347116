"""BridgeParallelEnv: a task of a team as a PettingZoo environment; each robot is an agent."""

from copy import deepcopy
from typing import Any

import gymnasium
import numpy as np

from nics_drl_bridge import defaults, extensions
from nics_drl_bridge.arguments import check_arguments, check_count
from nics_drl_bridge.env.bridge_env import RENDER_FPS, BridgeEnv
from nics_drl_bridge.env.guard import stop_on_error
from nics_drl_bridge.env.task import Info, Task
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.lidar.arrays import AnyArray, Singles
from nics_drl_bridge.sim.randomisation import Randomisation
from nics_drl_bridge.sim.world_set import AnyWorld

with extensions.require_modules("BridgeParallelEnv"):
    from pettingzoo import ParallelEnv

Observations = dict[str, Singles]


class BridgeParallelEnv(ParallelEnv[str, Singles, AnyArray]):
    """A task of a team in the fast simulator; each robot is an agent.

    ## Description

    The agents are `robot_0` to `robot_<M - 1>`; all values equal those of `BridgeEnv` with the
    same arguments. An agent whose episode is over leaves `agents`; its robot stops and
    remains as an obstacle.

    ## Spaces, Rewards, Starting State, Episode End

    Each agent has those of one robot, documented in the task's class, see `CooperativeReaching` and
    `PursuitEvasion`. `infos[agent]` has its `reward_terms`, `pose`, `is_success`, `collision`.
    `truncations` are all True after `max_episode_steps`.

    ## Arguments

    Those of `BridgeEnv`, plus `max_episode_steps`, after which an episode is truncated.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - PettingZoo's own declaration
        "name": "nics_bridge_v0",
        "render_modes": ["human", "rgb_array"],
        "render_fps": RENDER_FPS,
        "is_parallelizable": True,
    }

    @check_arguments("BridgeParallelEnv")
    def __init__(
        self,
        model: str | SimulatorModel | None = None,
        world: str | AnyWorld = defaults.WORLD,
        task: str | type[Task] | Task = "cooperative_reaching",
        task_options: dict[str, Any] | None = None,
        max_episode_steps: int = defaults.EPISODE_STEPS,
        randomisation: str | Randomisation | None = None,
        render_mode: str | None = None,
    ) -> None:
        check_count("max_episode_steps", max_episode_steps)
        self.env = BridgeEnv(
            "sim",
            model,
            world,
            task,
            task_options,
            randomisation=randomisation,
            render_mode=render_mode,
        )
        self.render_mode = render_mode
        self._limit = max_episode_steps
        self._steps = 0
        self.possible_agents = [f"robot_{m}" for m in range(self.env.robots)]
        self.agents: list[str] = []
        of = self.env.task
        # Each agent has its own space, because a space contains a random generator.
        self.observation_spaces = {}
        self.action_spaces = {}
        for name in self.possible_agents:
            self.observation_spaces[name] = deepcopy(of.observation_space)
            self.action_spaces[name] = deepcopy(of.action_space)

    def observation_space(self, agent: str) -> gymnasium.Space[Any]:
        """Returns the observation space of an agent, always the same object."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gymnasium.Space[Any]:
        """Returns the action space of an agent, always the same object."""
        return self.action_spaces[agent]

    @stop_on_error
    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Info]]:
        """Starts an episode with all agents; see PettingZoo."""
        # PettingZoo's checker passes an option "options".
        if isinstance(options, dict):
            options = {
                name: value for name, value in options.items() if name != "options"
            }
        observation, info = self.env.reset(seed=seed, options=options)
        self.agents = list(self.possible_agents)
        self._steps = 0
        rows = observation.reshape(len(self.agents), -1)
        seen = dict(zip(self.agents, rows, strict=True))
        infos = {name: self._of(info, m) for m, name in enumerate(self.agents)}
        return seen, infos

    @stop_on_error
    def step(
        self, actions: dict[str, AnyArray]
    ) -> tuple[
        Observations,
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, Info],
    ]:
        """Advances one control period; see PettingZoo. Every remaining agent needs an action."""
        observation, terms, info = self.env.advance(self._join(actions))
        if self.render_mode == "human":
            self.env.render()
        self._steps += 1
        infos = {}
        rewards = {}
        ended = {}
        seen = {}
        for name in self.agents:
            m = self.possible_agents.index(name)
            paid = {key: float(terms[key][m]) for key in terms}
            infos[name] = {**self._of(info, m), "reward_terms": paid}
            rewards[name] = sum(paid.values())
            ended[name] = bool(self.env.ended[m])
            seen[name] = observation[m]
        truncated = dict.fromkeys(self.agents, self._steps >= self._limit)
        self.agents = [
            name for name in self.agents if not (ended[name] or truncated[name])
        ]
        return seen, rewards, ended, truncated, infos

    def _join(self, actions: object) -> Any:
        """Returns the team's action. Raises ConfigError if a remaining agent has none."""
        if not isinstance(actions, dict):
            raise ConfigError(
                f"actions of type {type(actions).__name__}: must be a dict with an action per "
                "agent."
            )
        missing = sorted(set(self.agents) - set(actions))
        if missing:
            raise ConfigError(
                f"no action for {', '.join(missing)}; each remaining agent must act."
            )
        space = self.env.task.action_space
        rest: Any = np.zeros(space.shape or (), space.dtype)
        # The env stops the robots of agents that have left, so their action does not matter.
        joint = [actions[n] if n in self.agents else rest for n in self.possible_agents]
        if self.env.robots == 1:
            return joint[0]
        return np.array(joint, space.dtype).ravel()

    def halt(self) -> None:
        """Stops every robot until the next reset; any exception does so too."""
        self.env.halt()

    def _of(self, value: Any, m: int) -> Any:
        """Returns robot m's row of a fact or a dict of facts; keeps facts about the world."""
        if isinstance(value, dict):
            of_world = ("goal", "bodies")
            return {
                n: one if n in of_world else self._of(one, m)
                for n, one in value.items()
            }
        if self.env.robots > 1 and isinstance(value, np.ndarray):
            return value[m]
        return value

    @stop_on_error
    def render(self) -> Any:
        """Draws the current world from above."""
        return self.env.render()

    @stop_on_error
    def close(self) -> None:
        """Closes the window."""
        self.env.close()
