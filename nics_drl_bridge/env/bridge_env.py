"""BridgeEnv: one task over one backend, as a Gymnasium environment."""

from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from typing import Any

import gymnasium
import numpy as np

from nics_drl_bridge import defaults, extensions
from nics_drl_bridge.arguments import check_arguments, check_options, format_value
from nics_drl_bridge.env import guard, reset_options
from nics_drl_bridge.env.direct import DirectSteps, bind_steps
from nics_drl_bridge.env.guard import guard_call, stop_on_error
from nics_drl_bridge.env.registry import make_task
from nics_drl_bridge.env.sim_backend import complete_backend, make_backend
from nics_drl_bridge.env.snapshot import Snapshot, find_gate, find_goals
from nics_drl_bridge.env.task import (
    Episodes,
    Info,
    Memory,
    Observation,
    Task,
    Terms,
    make_team_space,
    still,
    total,
)
from nics_drl_bridge.errors import ConfigError, suggest
from nics_drl_bridge.generator import SimulatorModel, open_model
from nics_drl_bridge.interface import Array, Backend, RobotView, Start
from nics_drl_bridge.lidar.arrays import AnyArray, Singles
from nics_drl_bridge.lidar.sensor import unread
from nics_drl_bridge.random_kernels import episode_seed
from nics_drl_bridge.robot import DEFAULT_ROBOT
from nics_drl_bridge.sim.randomisation import Randomisation
from nics_drl_bridge.sim.scenes import Scene, sample_scene
from nics_drl_bridge.sim.world_set import AnyWorld, load_worlds

RENDER_FPS = 10


class BridgeEnv(gymnasium.Env[Singles, AnyArray]):
    """A task for a robot, or a team, in the fast simulator or over ROS 2.

    ## Description

    A robot with a lidar stands among obstacles in a walled field and has a task, whose class
    documents observation, reward and end: `Navigation` (`NicsBridge/Navigation-v0`),
    `CooperativeReaching` and `PursuitEvasion` for teams, or your own (`NicsBridge/Task-v0`). The
    robot is either simulated in this process (`backend="sim"`) or whatever is behind the ROS 2
    topics `cmd_vel`, `scan` and `odom` (`backend="dds"` or `"ros"`): a simulator node or the
    vehicle. Task, spaces and units are the same.

    ## Action Space

    For one robot, `Box(-1, 1, (C,), float32)`: each command of the robot, scaled between its
    limits; for the Ackermann robot, speed [m/s] and steering angle [rad]. With
    `task_options={"actions": "discrete"}` it is `Discrete`, see `env.task.DRIVES`. For M robots
    the actions are concatenated: `Box(-1, 1, (M C,), float32)` or `MultiDiscrete`.

    ## Observation Space

    The task's `Box((O,), float32)`, or `Box((M O,), float32)` for a team, robot by robot;
    `observation.reshape(M, O)` separates the robots.

    ## Rewards

    The sum of the terms in `info["reward_terms"]`. For a team, terms are arrays (M,), and the
    reward also sums over the robots.

    ## Starting State

    The seed determines obstacles, start poses, goals and noise; the robots stand still. `reset`
    takes `options={"start": (x, y, heading), "goal": (x, y)}` to override start and goal, or any
    other entry of the task's memory by name.

    ## Episode End

    Terminated when the task has ended for every robot; robots of a team that end earlier stand
    still. Truncated after 300 steps, unless `gymnasium.make` gets another `max_episode_steps`.

    ## Arguments

    Args:
        backend: `sim`, `dds`, or your own object, see `interface.Backend`; it may lack `halt` and
            `facts`, see `env.sim_backend.CompletedBackend`.
        model: a SimulatorModel, its folder, or a shipped robot's name; else `DEFAULT_ROBOT`. The
            keyword `robot` means the same.
        world: a World, its YAML file, the name of a shipped one, or a list of these (a world set).
        task: a name, `path/to/file.py:ClassName`, a class, or a Task; see `env.registry.make_task`.
        task_options: arguments of the task's class.
        estimator: True inserts the robot's middleware (cache and EKF) between simulator
            and task, so that `sim` returns the same numbers as `dds`, which always uses
            it. False, the default of `sim`, takes pose and twist from odometry,
            bit-identical to the vector env.
        backend_options: arguments of a backend by name, see `SimBackend` and `DdsBackend`; it also
            gets `estimator`, `randomisation` and the number of robots if they are given.
        randomisation: quantities drawn in each episode: the name of a shipped one, a YAML file, or
            a Randomisation; the drawn values are in `info["randomisation"]` of a reset.
        render_mode: `rgb_array`, `human` (a page in the browser, see `watch`) or None.
        simulator: name of the simulator's node behind `dds`.

    Raises:
        ConfigError, ModelError: an unknown name or a wrong file.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium's own declaration
        "render_modes": ["human", "rgb_array"],
        "render_fps": RENDER_FPS,
    }

    @check_arguments("BridgeEnv")
    def __init__(
        self,
        backend: str | Backend = "sim",
        model: str | SimulatorModel | None = None,
        world: str | AnyWorld = defaults.WORLD,
        task: str | type[Task] | Task = defaults.TASK,
        task_options: dict[str, Any] | None = None,
        estimator: bool | None = None,
        backend_options: dict[str, Any] | None = None,
        randomisation: str | Randomisation | None = None,
        render_mode: str | None = None,
        simulator: str | None = None,
    ) -> None:
        check_render_mode(render_mode, self.metadata)
        check_options("backend_options", backend_options)
        self.render_mode = render_mode
        self._closed = False
        self.model = open_model(DEFAULT_ROBOT if model is None else model)
        self.world = load_worlds(world)
        self.task = make_task(task, self.model, task_options)
        self.robots = self.task.robots
        self.observation_space = make_team_space(
            self.task.observation_space, self.robots
        )
        self.action_space = make_team_space(self.task.action_space, self.robots)
        self.memory: Memory = {}
        self.scene: Scene | None = None
        self.ended = np.zeros(self.robots, np.bool_)
        self._view: RobotView | None = None  # always a batch of one, as tasks expect
        self._shape = (1, self.robots, self.task.observation_space.shape[0])
        self._row: Any = (0, 0) if self.robots == 1 else 0
        self._each = (1, self.robots, *(self.task.action_space.shape or ()))
        self._rest = np.tile(still(self.model.robot), (self.robots, 1))
        self._seed = 0
        self._episode = -1
        self._rehearsed = False
        self._picture: Any = None
        # outcome of the last step, for pictures
        self._commands = self._rest[None]
        self._facts = Info()
        self._steps = 0
        if isinstance(backend, str):
            robots = self.robots if self.robots > 1 else None
            own = {
                "estimator": estimator,
                "robots": robots,
                "randomisation": randomisation,
                "simulator": simulator,
            }
            options = dict(backend_options or {})
            for name, value in own.items():
                if value is not None:
                    options[name] = value
            backend = make_backend(backend, self.model, self.world, **options)
        self._backend = complete_backend(backend, self._drop_robot_axis(self._rest))

    @guard_call
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Singles, Info]:
        """Starts an episode; see Gymnasium. Raises ConfigError for a wrong seed or option."""
        reset_options.check_reset(seed, options)
        super().reset(seed=seed)
        self._episode += 1
        if seed is not None:
            self._seed = int(seed)
            self._episode = 0
        elif self._episode == 0:
            self._seed = int(self.np_random.integers(2**31))
        episode = int(episode_seed(self._seed, self._episode))
        radius = self.model.robot.footprint_radius
        draw = self._backend.facts().get("scenes")
        if draw:
            self.scene = draw([episode])[0]
        else:
            self.scene = sample_scene(self.world, radius, episode, self.robots)
        starts = np.array(self.scene.starts)
        if options and "start" in options:
            reset_options.write_option(starts[None], "start", options["start"])
            reset_options.check_places(
                "start", starts[None], [self.scene], self.world, radius
            )
        seeds = np.array([episode])
        episodes = Episodes(seeds, starts[None], self.scene.goals[None])
        if not self._rehearsed:
            self._try_task(episodes)
        memory = reset_options.begin_task(
            self.task, episodes, options, [self.scene], self.world, "start"
        )
        self._view = self._as_batch(
            self._backend.reset(Start(episode, self._drop_robot_axis(starts)))
        )
        if self._direct is not None:
            self._view = self._direct.view
        self.memory = memory
        self._commands = self._rest[None]
        self._facts = {}
        self._steps = 0
        self.ended = np.zeros(self.robots, np.bool_)
        facts: Info = {
            "episode_seed": episode,
            "start": self._drop_robot_axis(starts),
        }
        facts["bodies"] = self.scene.bodies.copy()
        drawn = self._backend.facts().get("randomisation")
        if drawn:
            facts["randomisation"] = drawn
        observation = self.task.observation(self._view, self.memory)
        self.task.check_result("observation", observation, self._shape)
        if self.render_mode == "human":
            self.render()
        return observation.reshape(-1), self._make_info(self._view, facts)

    def _try_task(self, episodes: Episodes) -> None:
        """Runs the task once at rest, because compiling while driving is too slow."""
        shape = (1, self.robots, self.model.lidar.beams)
        free = np.full(shape, np.inf, np.float32)
        sensed = unread(self.model.sensors, 1, self.robots)
        starts = episodes.starts
        view = RobotView(starts.copy(), 0.0 * starts, free, sensed=sensed)
        memory = self.task.start_episodes(episodes)
        with suppress(ConfigError):  # the task may refuse the made-up view
            out = np.empty(self._shape, np.float32)
            self.task.take_step(out, view, view, memory)
        self._rehearsed = True

    @cached_property
    def _direct(self) -> DirectSteps | None:
        return bind_steps(self._backend, self.task)

    def __getstate__(self) -> dict[str, Any]:
        state = dict(vars(self))
        state.pop("_direct", None)  # a copy binds its own simulator
        return state

    @guard_call
    def step(self, action: AnyArray) -> tuple[Observation, float, bool, bool, Info]:
        """Applies an action for one control period; see Gymnasium."""
        observation, terms, info = self._advance(action)
        # Sum in the vector env's order, for bit-identical rewards.
        if self.robots == 1:
            reward = 0.0
            for term in terms.values():
                reward += term
            terminated = bool(self.ended.item(0))
        else:
            reward = float(total(sum(terms.values(), np.zeros(self.robots))))
            terminated = bool(self.ended.all())
        info["reward_terms"] = terms
        if self.render_mode == "human":
            self.render()
        return observation, reward, terminated, False, info

    @guard_call
    def advance(self, action: AnyArray) -> tuple[Singles, Terms, Info]:
        """Advances one period; returns observations (M, O), reward terms (M,) by name, and `info`.

        Robots of a team that have `ended` (M,) get the stop command and no more reward.
        """
        observation, terms, info = self._advance(action)
        rows = {name: np.reshape(term, self.robots) for name, term in terms.items()}
        return observation.reshape(self._shape[1:]), rows, info

    def _advance(self, action: AnyArray) -> tuple[Singles, dict[str, Any], Info]:
        """Returns the observation (M O,), reward terms (M,), as numbers if M = 1, and `info`."""
        before = self._view
        if before is None:
            raise gymnasium.error.ResetNeeded("call reset() before step().")
        self._steps += 1
        direct = self._direct
        if direct is None:
            return self._advance_backend(before, action)
        if not direct.try_action(action):
            direct.commands[...] = self._make_commands(action)
        self._commands = direct.commands
        observation, terms, self.ended[0], info = direct.advance(self.memory)
        return observation, terms, info

    def _advance_backend(
        self, before: RobotView, action: AnyArray
    ) -> tuple[Singles, dict[str, Any], Info]:
        """Advances through the methods of backend and task, after the view `before`."""
        self._commands = self._make_commands(action)
        measured, facts = self._backend.step(self._commands[self._row])
        self._facts = facts
        view = self._as_batch(measured)
        out = np.empty(self._shape, np.float32)
        outcome = self.task.take_step(out, before, view, self.memory)
        if self.robots > 1:
            outcome = outcome.stop_rewards(self.ended[None])
        terms = {
            name: term[0] if self.robots > 1 else term.item()
            for name, term in outcome.terms.items()
        }
        self.ended = outcome.ended[0]
        self._view = view
        for name, values in outcome.info.items():
            row = values[self._row]
            facts[name] = row.copy() if row.ndim else row.item()
        return out.reshape(-1), terms, self._make_info(view, facts)

    def _make_commands(self, action: AnyArray) -> Array:
        given = guard.check_action(action, self.action_space, "action")
        commands = self.task.drive(given.reshape(self._each), self.ended[None])
        shape = (1, self.robots, len(self.model.robot.command))
        checked: Array = self.task.check_result("drive", commands, shape)
        return checked

    def halt(self) -> None:
        """Stops the robot until the next reset; any exception does so too."""
        self._view = None
        self._backend.halt()

    def _as_batch(self, view: RobotView) -> RobotView:
        lead = (1, self.robots, -1)
        sensed = {name: reading.reshape(lead) for name, reading in view.sensed.items()}
        return replace(
            view,
            pose=view.pose.reshape(lead),
            twist=view.twist.reshape(lead),
            ranges=view.ranges.reshape(lead),
            sensed=sensed,
        )

    def _drop_robot_axis(self, rows: AnyArray) -> AnyArray:
        return rows[0] if self.robots == 1 else rows

    def _make_info(self, view: RobotView, facts: Info) -> Info:
        info: Info = {
            name: self.memory[name][self._row].copy() for name in self.task.shown
        }
        info["pose"] = view.pose[self._row].copy()
        info["scan_age_s"] = view.scan_age_s
        info["odom_age_s"] = view.odom_age_s
        if view.sensed:
            info["sensed_age_s"] = view.sensed_age_s
        return info | facts

    @guard_call
    def render(self) -> Any:
        """Draws the current world from above; see Gymnasium."""
        if self.scene is None:
            raise gymnasium.error.ResetNeeded("call reset() before render().")
        if self.render_mode is None:
            return None
        if self._picture is None:
            self._picture = self._make_picture()
        return self._picture.draw(self.snapshot())

    def _make_picture(self) -> Any:
        if self.render_mode == "human":
            return extensions.load("viewers", "human")(
                self.model, self.world, RENDER_FPS
            )
        # imported here because it loads matplotlib
        from nics_drl_bridge.env.rendering import WorldPicture

        return WorldPicture(self.model, self.world)

    def snapshot(self) -> Snapshot:
        """Returns the world's state for a picture. Raises ResetNeeded before the first episode."""
        if self._view is None or self.scene is None:
            raise gymnasium.error.ResetNeeded("call reset() before render().")
        facts = self._backend.facts()
        known = self._facts
        view = self._view
        covariance = known.get("covariance")
        return Snapshot(
            poses=np.reshape(facts.get("true_pose", view.pose), (self.robots, 3)),
            ranges=view.ranges[0].copy(),
            bodies=facts.get("bodies", self.scene.bodies),
            goals=find_goals(self.memory),
            member=self.scene.member,
            step=self._steps,
            estimates=view.pose[0].copy(),
            covariance=None
            if covariance is None
            else np.reshape(covariance, (-1, 3, 3)),
            commands=self._commands[0].copy(),
            gate=find_gate(known),
        )

    @stop_on_error
    def close(self) -> None:
        """Stops the robot with a zero command and closes the page."""
        picture = self._picture
        self._picture = None
        self._closed = True
        try:
            self._backend.close()
        finally:
            if self.render_mode == "human" and picture is not None:
                picture.close()


def check_render_mode(mode: str | None, metadata: dict[str, Any]) -> None:
    """Raises ConfigError for a render mode that the env does not support."""
    known = metadata["render_modes"]
    if mode is not None and mode not in known:
        name = mode if isinstance(mode, str) else ""
        raise ConfigError(
            f"unknown render_mode {format_value(mode)}; {suggest(name, known)}"
        )
