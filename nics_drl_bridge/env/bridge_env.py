"""BridgeEnv: one task over one backend, as a Gymnasium environment."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env.navigation import Navigation, Verdict
from nics_drl_bridge.errors import MISSING_ROS, ConfigError, nearest
from nics_drl_bridge.generator import SimulatorModel, open_model
from nics_drl_bridge.interface import Backend, RobotView, Start
from nics_drl_bridge.sim.scenes import sample_scene
from nics_drl_bridge.sim.world import World, load_world

Array = NDArray[np.float64]

BACKENDS = {
    "sim": "nics_drl_bridge.env.sim_backend:SimBackend",
    "dds": "nics_drl_bridge.nodes.dds_backend:DdsBackend",
}
"""Where each backend lives. Named as text, so that an env in process never imports ROS 2."""


class BridgeEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """Drive a robot to a goal by lidar, in the fast simulator or over ROS 2.

    ## Description

    A robot stands in a walled field among round obstacles and has to reach a goal without
    touching anything: the navigation task of the paper. The robot is either simulated in this
    process (`backend="sim"`) or whatever is behind the ROS 2 topics `cmd_vel`, `scan` and
    `odom` (`backend="dds"`): a simulator node or the vehicle. Task, spaces and numbers are the
    same.

    ## Action Space

    `Box(-1, 1, (C,), float32)`: each command of the robot, scaled between its limits. For the
    Ackermann robot: speed and steering angle.

    ## Observation Space

    `Box((B + 6,), float32)`, B beams:

    | Num | Observation | Min | Max | Unit |
    |---|---|---|---|---|
    | 0 to B - 1 | range in shares of the greatest; 1 free, 0 too close or unknown | 0 | 1 | - |
    | B | distance to the goal | 0 | inf | m |
    | B + 1, B + 2 | cosine, sine of the bearing of the goal | -1 | 1 | - |
    | B + 3, B + 4 | estimated velocity forward, left | -inf | inf | m/s |
    | B + 5 | estimated turn rate | -inf | inf | rad/s |

    ## Rewards

    `info["reward_terms"]` holds the terms: `progress`, 1 per metre of approach; `time`, -0.01
    per step; `success`, 10 at the goal; `collision`, -10 at a touch.

    ## Starting State

    The seed fixes obstacles, start pose, goal and noise; the robot stands still. `reset`
    takes `options={"start": (x, y, heading), "goal": (x, y)}` to override them.

    ## Episode End

    Terminated when the goal is nearer than 0.3 m or something touches the footprint, both
    judged by what the robot itself knows; truncated after 300 steps.

    ## Arguments

    Args:
        backend: `sim`, `dds`, or an object of your own with `reset`, `step` and `close`.
        model: a SimulatorModel, its folder, or the name of a shipped robot.
        world: a World, its YAML file, or the name of a shipped one.
        backend_options: passed to the backend, see `SimBackend` and `DdsBackend`.
        render_mode: none yet.

    Raises:
        ConfigError, ModelError: an unknown name or a wrong file.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - Gymnasium's own declaration

    def __init__(
        self,
        backend: str | Backend = "sim",
        model: str | SimulatorModel = "ackermann",
        world: str | World = "arena",
        backend_options: dict[str, Any] | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.render_mode = render_mode
        self.model = open_model(model) if isinstance(model, str) else model
        self.world = load_world(world) if isinstance(world, str) else world
        self.task = Navigation(self.model.robot, self.model.lidar)
        self.observation_space = self.task.observation_space
        self.action_space = self.task.action_space
        self.goal: Array = np.zeros(2)
        self._view: RobotView | None = None
        self._backend = (
            make_backend(backend, self.model, self.world, **(backend_options or {}))
            if isinstance(backend, str)
            else backend
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begins an episode; see Gymnasium."""
        super().reset(seed=seed)
        episode = int(self.np_random.integers(2**31)) if seed is None else int(seed)
        scene = sample_scene(self.world, self.model.robot.footprint_radius, episode)
        options = options or {}
        start = np.asarray(options.get("start", scene.starts[0]), dtype=np.float64)
        self.goal = np.asarray(options.get("goal", scene.goals[0]), dtype=np.float64)
        self._view = self._backend.reset(Start(episode, start))
        facts = {"episode_seed": episode, "start": start, "bodies": scene.bodies}
        return self.task.observe(self._view, self.goal), self._info(self._view, facts)

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Applies an action for one control period; see Gymnasium."""
        if self._view is None:
            raise gymnasium.error.ResetNeeded("call reset() before step().")
        if not np.isfinite(action).all():
            raise gymnasium.error.InvalidAction(f"action {action!r}: holds NaN or inf.")
        # After an error in the backend, only a reset leads back.
        before, self._view = self._view, None
        self._view, facts = self._backend.step(self.task.command(action))
        verdict = self.task.judge(self._view, self.goal)
        terms = self.task.reward(before, self._view, self.goal, verdict)
        info = self._info(self._view, facts) | _ending(verdict, terms)
        ended = bool(verdict.reached | verdict.touched)
        reward = float(sum(terms.values()))
        return self.task.observe(self._view, self.goal), reward, ended, False, info

    def _info(self, view: RobotView, facts: dict[str, Any]) -> dict[str, Any]:
        return {
            "goal": self.goal.copy(),
            "pose": view.pose,
            "scan_age_s": view.scan_age_s,
            "odom_age_s": view.odom_age_s,
            **facts,
        }

    def close(self) -> None:
        """Leaves the robot with a zero command."""
        self._backend.close()


def _ending(verdict: Verdict, terms: dict[str, Array]) -> dict[str, Any]:
    return {
        "is_success": bool(verdict.reached & ~verdict.touched),
        "collision": bool(verdict.touched),
        "reward_terms": {name: float(value) for name, value in terms.items()},
    }


def make_backend(name: str, model: SimulatorModel, world: World, **options: Any) -> Backend:
    """A backend by name.

    Raises:
        ConfigError: unknown name, or its library is missing.
    """
    if name not in BACKENDS:
        raise ConfigError(f"unknown backend {name!r}; {nearest(name, BACKENDS)}")
    module, _, factory = BACKENDS[name].partition(":")
    try:
        made: Backend = getattr(import_module(module), factory)(model, world, **options)
    except ModuleNotFoundError as error:
        raise ConfigError(f"backend {name!r} {MISSING_ROS.format(module=error.name)}") from None
    return made
