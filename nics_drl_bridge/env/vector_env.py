"""The vector environment: many worlds of the fast simulator in the same arrays."""

import math
import mmap
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from nics_drl_bridge import defaults
from nics_drl_bridge.arguments import check_arguments, check_count, format_value
from nics_drl_bridge.env import guard, reset_options
from nics_drl_bridge.env.bridge_env import RENDER_FPS, check_render_mode
from nics_drl_bridge.env.kernels import compute_episode_seeds
from nics_drl_bridge.env.registry import make_task
from nics_drl_bridge.env.snapshot import Snapshot, find_goals
from nics_drl_bridge.env.task import (
    Episodes,
    Facts,
    Flags,
    Info,
    Memory,
    Observation,
    Outcome,
    Task,
    make_team_space,
    total,
)
from nics_drl_bridge.env.teaching import Teacher, Teaching
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import SimulatorModel, open_model
from nics_drl_bridge.interface import NS_PER_S, Array, RobotView
from nics_drl_bridge.lidar.arrays import AnyArray
from nics_drl_bridge.lidar.shapes import BODY
from nics_drl_bridge.robot import DEFAULT_ROBOT
from nics_drl_bridge.sim.scenes import Scenes
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world_set import AnyWorld, load_worlds

Rows = slice | NDArray[np.intp] | Flags
LARGE = 2**20  # size from which `zeros` asks the operating system for new pages [bytes]
MODES = {
    mode.value: mode for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)
}


class BridgeVectorEnv(gymnasium.vector.VectorEnv[Observation, AnyArray, AnyArray]):
    """A task in `num_envs` worlds at once, for training.

    ## Description

    Task, spaces, rewards, ends and results equal those of `BridgeEnv` with
    `backend="sim"`: world i after `reset(seed=s)` is bit-identical to a single env
    after `reset(seed=s + i)`, even in later episodes, for any `num_envs` and number of
    threads.

    ## Spaces, Rewards, Starting State, Episode End

    Those of `BridgeEnv` with a leading (N,). `info` is like that of Gymnasium's `SyncVectorEnv`:
    each entry is an array (N, ...) with a mask `_name`. `reset` takes
    `options={"start": ..., "goal": ...}` for all worlds that it resets, and with
    `options={"reset_mask": (N,) bool}` it resets only those.

    ## Arguments

    `num_envs` is N; `model` (or `robot`), `world`, `task`, `task_options` are those of
    `BridgeEnv`. An episode is truncated after `max_episode_steps`. `autoreset_mode` is
    `NextStep` (an ended world is reset in the next step, which ignores its action) or
    `SameStep` (immediately; the last observation is in `info["final_obs"]`). With
    `copy=True` the caller may keep what `step` returns; with False the next step reuses
    the observation array. `render_mode` is `rgb_array`, of every world, or None. Other
    arguments are those of the FastSimulator: `renderer` (`baked` by default, or
    `exact`), `threads`, which does not affect the results, and `randomisation`, see
    `BridgeEnv`. Raises ConfigError or ModelError for an unknown name or a wrong file.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium's own declaration
        "render_modes": ["rgb_array"],
        "render_fps": RENDER_FPS,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    @check_arguments("BridgeVectorEnv", FastSimulator, without=("worlds", "robots"))
    def __init__(
        self,
        num_envs: int = 1,
        model: str | SimulatorModel | None = None,
        world: str | AnyWorld = defaults.WORLD,
        task: str | type[Task] | Task = defaults.TASK,
        task_options: dict[str, Any] | None = None,
        max_episode_steps: int = defaults.EPISODE_STEPS,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        copy: bool = True,
        *,
        render_mode: str | None = None,
        **simulation: Any,
    ) -> None:
        self._pictures: list[Any] = []
        check_render_mode(render_mode, self.metadata)
        check_count("num_envs", num_envs)
        check_count("max_episode_steps", max_episode_steps)
        check_count("threads", simulation.get("threads", 1))
        self._closed = False
        self.num_envs = num_envs
        self.render_mode = render_mode
        self._limit = max_episode_steps
        self.copy = copy
        mode = getattr(autoreset_mode, "value", autoreset_mode)
        if not isinstance(mode, str) or mode not in MODES:
            raise ConfigError(
                f"autoreset_mode {format_value(mode)}: must be one of {', '.join(MODES)}."
            )
        self._mode = MODES[mode]
        self.metadata = {**self.metadata, "autoreset_mode": self._mode}
        self.model = open_model(DEFAULT_ROBOT if model is None else model)
        self.world = load_worlds(world)
        self.task = make_task(task, self.model, task_options)
        self.robots = self.task.robots
        self.single_observation_space = make_team_space(
            self.task.observation_space, self.robots
        )
        self.single_action_space = make_team_space(self.task.action_space, self.robots)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.simulator = FastSimulator(
            self.model, self.world, num_envs, self.robots, **simulation
        )
        self._teacher: Teacher | None = None
        self._each: tuple[int, ...] = (num_envs, self.robots, -1)
        if not self.task.action_space.shape:
            self._each = (num_envs, self.robots)
        self._period_ns = round(self.model.control_period * NS_PER_S)
        self._allocate()

    def _allocate(self) -> None:
        count = self.num_envs
        robots = self.robots
        parts = self.task.observation_space.shape[0]
        self._out = np.zeros((count, robots, parts), np.float32)
        self._reward = np.zeros((count, robots))
        self.ended = np.zeros((count, robots), np.bool_)
        self._awaits_reset = np.zeros(count, np.bool_)
        self._first = np.zeros(count, np.int64)
        self._episode = np.full(count, -1)
        self._starts = np.zeros((count, robots, 3))
        self._bodies = np.zeros((count, self.simulator.sampler.count, BODY))
        self.memory: Memory = {}
        # also False after an exception, which may leave some worlds a step behind
        self.ready = False

    def teach(self, given: Teaching) -> None:
        """Adds teaching rewards, and repetitions in `SameStep`, from the next reset on."""
        self._teacher = Teacher(given, self.simulator)

    @property
    def changing(self) -> Facts:
        """Arrays that change from step to step, by name; see `policy.train.checkpoint`."""
        own = {
            "ended": self.ended,
            "awaits_reset": self._awaits_reset,
            "first": self._first,
            "episode": self._episode,
            "starts": self._starts,
            "bodies": self._bodies,
        }
        data = {
            # Checkpoints store the plain numbers of structured arrays.
            f"data.{name}": rows.view(np.int64) if rows.dtype.names else rows
            for name, rows in self.simulator.data._asdict().items()
        }
        known = self._teacher.changing if self._teacher else {}
        return {**own, **data, **known, "goals": self.simulator.goals}

    @guard.refuse_after_close
    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, Info]:
        """Starts an episode in every world; world i takes its seeds from `seed + i`."""
        reset_options.check_reset(seed, options, self.num_envs)
        super().reset(seed=seed if isinstance(seed, int) else None)
        count = self.num_envs
        chosen = np.ones(count, np.bool_)
        if options and "reset_mask" in options:
            mask = np.asarray(options["reset_mask"])
            if mask.shape != (count,) or mask.dtype != np.bool_ or not mask.any():
                raise ConfigError(
                    f"options['reset_mask'] of shape {mask.shape}, {mask.dtype}: must be "
                    f"({count},) bool with at least one True."
                )
            chosen = mask.copy()
        if not (self.ready or chosen.all()):
            raise gymnasium.error.ResetNeeded(
                "reset all worlds before you reset some of them."
            )
        listed: Sequence[int | None]
        if seed is None:
            listed = [None] * count
        elif isinstance(seed, Sequence | np.ndarray):
            listed = seed
        else:
            listed = range(seed, seed + count)
        if len(listed) != count:
            raise ConfigError(f"{len(listed)} seeds for {count} worlds; give one each.")
        # These worlds restart with a seed.
        seeded = chosen & np.array([one is not None for one in listed])
        seeds = np.array([one or 0 for one in listed], np.int64)
        # Seeds are drawn for worlds that never had one.
        new = chosen & (self._episode < 0) & ~seeded
        if new.any():
            first = int(self.np_random.integers(2**31))
            seeds = np.where(new, first + np.arange(count), seeds)
            seeded = seeded | new
        self.ready = False
        self._first[seeded] = seeds[seeded]
        self._episode[seeded] = -1
        if not chosen.all():  # the other worlds keep their observation
            self._out[...] = self.task.observation(
                self._make_view(slice(None)), self.memory
            )
        self._begin(np.flatnonzero(chosen), self._out, options)
        facts = self._get_known() | self._get_beginnings()
        infos = add_masks(facts, chosen, True)
        self.ready = True
        out = self._out.copy() if self.copy else self._out
        return flatten(out), infos

    def _begin(
        self,
        worlds: NDArray[np.intp],
        out: Observation,
        options: dict[str, Any] | None = None,
    ) -> None:
        if not len(worlds):
            return
        self._episode[worlds] += 1
        seeds = np.empty(len(worlds), np.int64)
        compute_episode_seeds(self._first[worlds], self._episode[worlds], seeds)
        starts = None
        if options and "start" in options:
            starts = np.empty((len(worlds), self.robots, 3))
            reset_options.write_option(starts, "start", options["start"])

        def places(scenes: Scenes) -> Array | None:
            if starts is not None:
                radius = self.model.robot.footprint_radius
                reset_options.check_places("start", starts, scenes, self.world, radius)
            return starts

        scenes = self.simulator.reset(seeds, worlds, places)
        if self._teacher is not None:
            self._teacher.begin(worlds, scenes)
        self._bodies[worlds] = scenes.bodies
        self._starts[worlds] = self.simulator.data.pose[worlds]
        goals = self.simulator.goals[worlds]
        episodes = Episodes(seeds, self._starts[worlds], goals)
        memory = reset_options.begin_task(
            self.task, episodes, options, scenes, self.world, "start", "reset_mask"
        )
        for name, rows in memory.items():
            if name not in self.memory:
                self.memory[name] = np.zeros(
                    (self.num_envs, *rows.shape[1:]), rows.dtype
                )
            self.memory[name][worlds] = rows
        self.ended[worlds] = False
        self._awaits_reset[worlds] = False
        seen = self.task.observation(self._make_view(worlds), memory)
        out[worlds] = self.task.check_result(
            "observation", seen, (len(worlds), *out.shape[1:])
        )

    def _make_view(self, rows: Rows) -> RobotView:
        data = self.simulator.data
        readings = self.simulator.readings
        return RobotView(
            data.odom[rows],
            data.twist[rows],
            data.ranges[rows],
            sensed={name: readings[name][rows] for name in readings},
        )

    @guard.refuse_after_close
    def step(self, actions: AnyArray) -> tuple[Observation, Array, Flags, Flags, Info]:
        """Advances every world by one control period; see Gymnasium.

        Each thread advances its part of the worlds, see `_advance`. Worlds whose episode
        is over then begin another: at once in `SameStep`, in the next step in `NextStep`.
        """
        if not self.ready:
            raise gymnasium.error.ResetNeeded("call reset() before step().")
        given = guard.check_action(actions, self.action_space, "actions").reshape(
            self._each
        )
        self.ready = False
        out = np.empty_like(self._out) if self.copy else self._out
        # Worlds that begin another episode are stepped with the others; their outcome is dropped.
        resetting = self._awaits_reset.copy()
        run = self.simulator.run_parts
        outcome = join_outcomes(
            run(lambda part: self._advance(part, given[part], out, resetting))
        )
        terminated = np.asarray(self.ended.all(axis=1))
        truncated = self.simulator.data.steps >= self._limit
        reward = np.where(resetting, 0.0, total(self._reward))
        done = terminated | truncated
        infos: Info = {}
        facts = self._describe(outcome)
        if self._mode is AutoresetMode.NEXT_STEP:
            self._awaits_reset = done
            self._add_infos(infos, facts, resetting)
        else:
            if done.any():
                infos |= self._get_final(flatten(out), done, facts)
                self._repeat_failed(done, facts)
                run(lambda p: self._begin(p.start + np.flatnonzero(done[p]), out))
            self._add_infos(infos, facts, done)
        self.ready = True
        return flatten(out), reward, terminated, truncated, infos

    def _describe(self, outcome: Outcome) -> Info:
        """Returns the facts of a step, in arrays of the caller's own."""
        data = self.simulator.data
        return {
            "stamp_ns": data.steps * self._period_ns,
            "true_pose": self._drop_robot_axis(data.pose).copy(),
            "true_collision": self._drop_robot_axis(data.collided).astype(np.bool_),
            **self._copy_rows(outcome.info),
            "reward_terms": self._copy_rows(outcome.terms),
        }

    def _advance(
        self, part: slice, actions: AnyArray, out: Observation, resetting: Flags
    ) -> Outcome:
        """Moves the worlds of a part, lets the task judge the step, and begins due episodes."""
        data = self.simulator.data
        ended = self.ended[part]
        command = self.task.drive(actions, ended)
        ranges = data.ranges[part]
        before = RobotView(
            data.odom[part].copy(),
            data.twist[part].copy(),
            ranges.copy() if self.task.needs_last_scan else ranges,
        )
        self.simulator.step_part(part, command)
        memory = {name: rows[part] for name, rows in self.memory.items()}
        outcome = self.task.take_step(out[part], before, self._make_view(part), memory)
        if self._teacher is not None:
            outcome = self._teacher.judge(part, outcome)
        if self.robots > 1:
            outcome = outcome.stop_rewards(ended)
        nothing = np.zeros(ended.shape)
        self._reward[part] = sum(outcome.terms.values(), nothing)
        self.ended[part] = ended | outcome.ended
        self._begin(part.start + np.flatnonzero(resetting[part]), out)
        return outcome

    def _get_final(self, rows: Observation, done: Flags, facts: Info) -> Info:
        """Returns the last observation and info of the worlds that are done."""
        observations = np.full(self.num_envs, None, dtype=object)
        # Only for ended worlds, because each needs its own object.
        for n in np.flatnonzero(done):
            observations[n] = rows[n].copy()
        final = self._get_known() | facts
        final_info = add_masks({"final_info": final}, done, True)
        return add_masks({"final_obs": observations}, done) | final_info

    def _repeat_failed(self, done: Flags, facts: Info) -> None:
        """Makes the teacher's choice of failed episodes begin again, from the same seed."""
        if self._teacher is None:
            return
        # A task that tells no success never fails.
        success = facts.get("is_success", done)
        success = success.reshape(self.num_envs, -1).all(axis=1)
        # The next episode of these worlds then has the seed of this one.
        self._episode[self._teacher.find_repeats(done, success)] -= 1

    def _add_infos(self, infos: Info, facts: Info, began: Flags) -> None:
        infos |= add_masks(self._get_known(), np.ones_like(began))
        any_began = bool(began.any())
        if any_began:
            infos |= add_masks(self._get_beginnings(), began, True)
        if not began.all():
            infos |= add_masks(facts, ~began, any_began)

    # Facts as arrays (N, ...) for worlds with one robot, or (N, M, ...) for teams.

    def _get_known(self) -> Info:
        shown = {name: self.memory[name] for name in self.task.shown}
        known = self._copy_rows({**shown, "pose": self.simulator.data.odom})
        known["scan_age_s"] = np.zeros(self.num_envs)
        known["odom_age_s"] = np.zeros(self.num_envs)
        return known

    def _get_beginnings(self) -> Info:
        beginnings: Info = {
            "episode_seed": self.simulator.data.seeds,
            "start": self._drop_robot_axis(self._starts),
            "bodies": self._bodies,
        }
        drawn = dict(self.simulator.drawn)
        for name, values in drawn.items():
            if values.ndim > 1:
                drawn[name] = self._drop_robot_axis(values)
        if drawn:
            beginnings["randomisation"] = drawn
        return beginnings

    def _copy_rows(self, values: Facts) -> Facts:
        return {
            name: self._drop_robot_axis(rows).copy() for name, rows in values.items()
        }

    def _drop_robot_axis(self, rows: AnyArray) -> AnyArray:
        return rows[:, 0] if self.robots == 1 else rows

    def close_extras(self, **_: Any) -> None:
        """Marks the env as closed; there is nothing to free."""
        self._closed = True

    @guard.refuse_after_close
    def render(self) -> tuple[Any, ...] | None:
        """Draws every world; see Gymnasium."""
        if self.render_mode is None:
            return None
        if not self._pictures:
            # imported here because it loads matplotlib
            from nics_drl_bridge.env.rendering import WorldPicture

            self._pictures = [
                WorldPicture(self.model, self.world) for _ in range(self.num_envs)
            ]
        return tuple(
            picture.draw(self.snapshot(n)) for n, picture in enumerate(self._pictures)
        )

    def snapshot(self, n: int) -> Snapshot:
        """Returns the state of world n for a picture, in arrays that `step` does not change."""
        data = self.simulator.data
        return Snapshot(
            data.pose[n].copy(),
            data.ranges[n].copy(),
            self.simulator.obstacles_of(np.array([n]))[0],
            find_goals(self.memory, n),
            int(data.member[n]),
            int(data.steps[n]),
            data.odom[n].copy(),
        )


def flatten(observations: Observation) -> Observation:
    """Concatenates observations of each world's robots to (N, M O), without a copy."""
    return observations.reshape(len(observations), -1)


def join_outcomes(parts: Sequence[Outcome]) -> Outcome:
    """Joins the outcomes of consecutive parts of the worlds."""
    if len(parts) == 1:
        return parts[0]
    ended = np.concatenate([part.ended for part in parts])
    terms = _join_facts([part.terms for part in parts])
    return Outcome(terms, ended, _join_facts([part.info for part in parts]))


def _join_facts(parts: Sequence[Facts]) -> Facts:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def zeros(shape: tuple[int, ...], dtype: np.dtype[Any]) -> AnyArray:
    """Returns zeros; unwritten pages of large arrays cost neither time nor memory.

    `numpy.zeros` does the same until the C library reuses such memory and has to clear all of it,
    which took a fifth of a step with many obstacles.
    """
    size = math.prod(shape) * dtype.itemsize
    if size < LARGE or not hasattr(mmap, "MAP_PRIVATE"):  # Windows
        return np.zeros(shape, dtype)
    pages = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE)
    if hasattr(mmap, "MADV_NOHUGEPAGE"):
        pages.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(pages, dtype).reshape(shape)


def add_masks(
    facts: Mapping[str, Any], mask: Flags, blank_others: bool = False
) -> Info:
    """Pairs facts (N, ...) with masks `_name` (N,), like Gymnasium.

    With `blank_others`, the facts of worlds outside the mask are zero.
    """
    paired: Info = {}
    gone = ~mask
    most = 2 * np.count_nonzero(mask) > len(mask)
    for name, values in facts.items():
        paired[name] = values
        paired[f"_{name}"] = mask.copy()
        if isinstance(values, Mapping):
            paired[name] = add_masks(values, mask, blank_others)
        elif blank_others and most:
            paired[name] = values.copy()
            paired[name][gone] = np.zeros((), values.dtype)
        elif blank_others:
            paired[name] = zeros(values.shape, values.dtype)
            paired[name][mask] = values[mask]
    return paired
