"""Model-predictive path integral control (Williams and others 2017), as a policy."""

import math
import os
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env.task import still
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.generator import BUILTIN_SEED, CONTROL_PERIOD_S, SimulatorModel
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.identify import identify
from nics_drl_bridge.policy.planners import mppi_kernels as kernels
from nics_drl_bridge.policy.planners.local_map import (
    MOST_M,
    outline_of,
    rays_of,
    scratch_of,
    split_observation,
)
from nics_drl_bridge.policy.planners.local_map_kernels import (
    Clearance,
    FootprintDiscs,
    MapScratch,
    ScanRays,
)
from nics_drl_bridge.recording import textbook
from nics_drl_bridge.robot.braking import Braking, find_braking
from nics_drl_bridge.robot.kernels import SERIES, make_terms, replace_coefficients
from nics_drl_bridge.robot.kinds import compute_steady_twist
from nics_drl_bridge.robot.taylor import TaylorModel
from nics_drl_bridge.threads import run_parts

SETTLED_S = 3.0  # time to the steady state of a held command
FINEST = 0.25  # maximum rollout step as a fraction of a lag
FEWEST = 8  # minimum number of robots per thread
CLEARANCE = Clearance(margin=0.08, soft=0.4)
WORTH = kernels.Worth(near=4.0, early=0.3, change=0.02, astray=0.2)


@dataclass(frozen=True)
class Mppi:
    """Planner that samples rollouts in the robot's model, with its true outline.

    It maps only the current scan. Without a model it uses the robot's textbook model; raises
    ConfigError if there is none.
    """

    task: Navigation
    model: SimulatorModel | None = None
    samples: int = 256  # rollouts per round
    horizon: float = 2.0  # [s]
    knots: int = 4  # actions along a rollout, interpolated linearly
    # standard deviation of the noise in the rounds after the first
    spreads: tuple[float, ...] = (
        0.4,
        0.2,
    )
    # temperature of the rollout weights, as a path length [m]
    temperature: float = 0.05
    clearance: Clearance = CLEARANCE
    worth: kernels.Worth = WORTH
    seed: int = 0

    def __post_init__(self) -> None:
        _ = self._halt

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Plans the actions; see `Policy`."""
        parts = split_observation(self.task, observation)
        out = np.empty((len(parts[0]), len(self.task.robot.command)))
        self._plan(out, *parts)
        actions = out.astype(np.float32)
        return actions[0] if observation.ndim == 1 else actions

    def _plan(self, *arrays: Array) -> None:
        """Plans for the rows of arrays (N, ...) on all cores, each core with its own memory."""
        count = max(1, min(os.cpu_count() or 1, len(arrays[0]) // FEWEST))
        cuts = np.linspace(0, len(arrays[0]), count + 1).astype(int).tolist()

        def part(rows: slice) -> None:
            scratch, lanes = self._free.pop() if self._free else self._memory()
            kernels.plan_all(
                *(array[rows] for array in arrays),
                (*self._sense, scratch),
                self._plant,
                self._sampling,
                self.worth,
                lanes,
            )
            self._free.append((scratch, lanes))

        run_parts(part, [slice(*ends) for ends in pairwise(cuts)])

    @cached_property
    def _free(self) -> list[tuple[MapScratch, kernels.RollOuts]]:
        return []  # memory that no thread is using

    def _memory(self) -> tuple[MapScratch, kernels.RollOuts]:
        robot, (_, outline, clearance) = self.task.robot, self._sense
        low, high = self.task.command_limits
        if self.task.robot.takes_cmd_vel:
            ends = np.stack([low, high])
        else:
            ends = np.zeros((1, len(low)))
        half = (
            math.hypot(*np.abs(compute_steady_twist(robot, ends))[:, :2].max(axis=0))
            * self.horizon
        )
        if self._halt.most > 0:
            half = self._reach
        half = min(half or np.inf, self.task.sight.range_max) + outline.outer
        scratch = scratch_of(self.task.scan_parts, outline, clearance, half)
        (states, count), many = self._plant.settled.shape, self.samples
        x = np.ones(states + count + 1)
        rate = np.zeros(3 + states)
        return scratch, kernels.RollOuts(
            np.zeros((6, many)),
            np.repeat(x[:, None], many, 1),
            np.repeat(rate[:, None], many, 1),
            np.zeros((many, self.knots, count)),
            np.zeros((self.knots, count)),
            np.zeros(count),
            x,
            rate,
            np.zeros(3),
            np.zeros(many),
            np.zeros(many),
            np.zeros(many, np.int64),
        )

    @cached_property
    def _sense(self) -> tuple[ScanRays, FootprintDiscs, Clearance]:
        return rays_of(self.task), outline_of(self.task.robot), self.clearance

    @cached_property
    def _kinematics(self) -> TaylorModel:
        if self.model is not None:
            return self.model.kinematics
        robot = self.task.robot
        return identify(
            textbook.record(robot, np.random.default_rng(BUILTIN_SEED)), robot
        ).model

    @property
    def _period(self) -> float:
        return CONTROL_PERIOD_S if self.model is None else self.model.control_period

    @cached_property
    def _top_twists(self) -> Array:
        """(K, 3) steady twists of the extreme commands."""
        robot = self.task.robot
        ends = np.array(list(product(*zip(*self.task.command_limits, strict=True))))
        if robot.takes_cmd_vel:
            return compute_steady_twist(robot, ends)
        state = ends @ self._plant.settled.T
        x = np.concatenate([state, self._kinematics.apply_curves(ends)], axis=-1)
        return self._kinematics.rates(x)[:, :3]

    @cached_property
    def _halt(self) -> kernels.Halt:
        """The stop at the end of a rollout; empty if the robot can stop within half a rollout."""
        robot = self.task.robot
        angles = np.array([variable.unit == "rad" for variable in robot.command])
        times = self._braking.time_s(self._top_twists)
        longest = float(np.max(times, initial=0.0))
        if longest <= 0.5 * self.horizon:
            return kernels.Halt(angles, still(robot), 0, math.inf)
        far = min(self._reach, self.task.sight.range_max, MOST_M)
        return kernels.Halt(
            angles, still(robot), math.ceil(longest / self._period), far
        )

    @property
    def _reach(self) -> float:
        """Distance covered by a rollout at full speed and the following stop [m]."""
        fastest = np.hypot(*np.abs(self._top_twists)[:, :2].max(axis=0))
        return float(fastest * self.horizon + self._braking.distance(fastest))

    @cached_property
    def _braking(self) -> Braking:
        limits = self.task.command_limits
        return find_braking(self.task.robot, self._kinematics, *limits)

    @cached_property
    def _plant(self) -> kernels.Plant:
        model = self._kinematics
        robot = self.task.robot
        period = self._period
        terms = make_terms(model)
        latency = float(model.delays.max(initial=0.0))
        if self.model is not None:
            latency += max(0.0, self.model.calibration.command_latency_s)
        decays = (
            (terms.dof >= 3)
            & (terms.degree == 1)
            & (terms.factors[:, 0] == terms.dof - 3)
        )
        fastest = np.abs(terms.coefficient[decays]).max(initial=0.0)
        substeps = min(
            max(1, math.ceil(period * fastest / FINEST)), round(period / model.dt)
        )
        rows = np.repeat(terms.coefficient[:, None], self.samples, axis=1)
        return kernels.Plant(
            replace_coefficients(terms, rows),
            terms,
            SERIES,
            period / substeps,
            substeps,
            latency,
            _settled(model, robot.command_high),
            *self.task.command_limits,
        )

    @cached_property
    def _sampling(self) -> kernels.Sampling:
        offers, noise = np.empty(
            (2, self.samples, self.knots, len(self.task.robot.command))
        )
        low, high = self.task.command_limits
        rest = 2.0 * (still(self.task.robot) - low) / (high - low) - 1.0
        kernels.draw(offers, noise, rest, self.seed)
        places = np.linspace(0.0, self.knots - 1.0, round(self.horizon / self._period))
        between = np.maximum(0.0, 1.0 - np.abs(places[:, None] - np.arange(self.knots)))
        return kernels.Sampling(
            offers, noise, np.array(self.spreads), between, self.temperature, self._halt
        )


def _settled(model: TaylorModel, high: Array) -> Array:
    """Returns the steady state (S, C) per unit of each command."""
    commands = np.diag(0.5 * high)
    pose = np.zeros((len(high), 3))
    state = np.zeros((len(high), model.state_size))
    for _ in range(round(SETTLED_S / model.dt)):
        pose, state = model.step(pose, state, commands)
    return np.ascontiguousarray((state / (0.5 * high)[:, None]).T)
