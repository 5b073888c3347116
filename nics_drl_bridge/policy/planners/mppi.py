"""Model-predictive path integral control (Williams and others 2017), as a policy."""

import math
import os
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, product

import numpy as np

from nics_drl_bridge.env.task import still
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.generator import (
    CONTROL_PERIOD_S,
    SimulatorModel,
    generate_textbook_model,
)
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.lidar.arrays import Singles
from nics_drl_bridge.policy.planners import local_map as maps
from nics_drl_bridge.policy.planners.local_map_kernels import (
    Clearance,
    FootprintDiscs,
    Situation,
)
from nics_drl_bridge.policy.planners.mppi_kernels import (
    Plant,
    RollOuts,
    Sampling,
    draw,
    plan_all,
)
from nics_drl_bridge.robot.braking import Braking, find_braking
from nics_drl_bridge.robot.kernels import SERIES, make_terms, replace_coefficients
from nics_drl_bridge.robot.kinds import compute_steady_twist
from nics_drl_bridge.robot.taylor import TaylorModel
from nics_drl_bridge.threads import run_parts

HORIZON_S = 2.0  # time of a rollout
KNOTS = 4  # actions along a rollout
CLEARANCE = Clearance(margin=0.08, soft=0.4)
SETTLED_S = 3.0  # time to the steady state of a held command
FINEST = 0.25  # maximum rollout step as a fraction of a lag
FEWEST = 8  # minimum number of robots per thread


@dataclass(frozen=True)
class Mppi:
    """Planner that samples rollouts in the robot's model, with its true outline.

    It maps only the current scan. Without a model it uses the robot's textbook model; raises
    ConfigError if there is none.
    """

    task: Navigation
    model: SimulatorModel | None = None
    samples: int = 256  # rollouts per round
    seed: int = 0

    def __post_init__(self) -> None:
        _ = self._sampling

    def act(self, observation: Singles) -> Singles:
        """Plans the actions on all cores, each with its own memory; see `Policy`."""
        parts = maps.split_observation(self.task, observation)
        actions = np.empty((len(parts[0]), len(self.task.robot.command)))
        count = max(1, min(os.cpu_count() or 1, len(actions) // FEWEST))
        cuts = np.linspace(0, len(actions), count + 1).astype(int).tolist()

        def plan_part(rows: slice) -> None:
            around, lanes = self._free.pop() if self._free else self._make_memory()
            arrays = [array[rows] for array in (actions, *parts)]
            plan_all(*arrays, around, self._plant, self._sampling, lanes)
            self._free.append((around, lanes))

        run_parts(plan_part, [slice(*ends) for ends in pairwise(cuts)])
        planned = actions.astype(np.float32)
        return planned[0] if observation.ndim == 1 else planned

    @cached_property
    def _free(self) -> list[tuple[Situation, RollOuts]]:
        return []  # memory not in use by any thread

    @cached_property
    def _outline(self) -> FootprintDiscs:
        return maps.fill_outline(self.task.robot)

    def _make_memory(self) -> tuple[Situation, RollOuts]:
        half = self._fastest * HORIZON_S
        if self._sampling.stop > 0:
            half = self._reach
        half = min(half, self.task.sight.range_max) + self._outline.outer
        around = maps.make_situation(self.task, self._outline, CLEARANCE, half)
        states, count = self._plant.settled.shape
        many = self.samples
        x = np.ones(states + count + 1)
        rate = np.zeros(3 + states)
        return around, RollOuts(
            np.zeros((6, many)),
            np.repeat(x[:, None], many, 1),
            np.repeat(rate[:, None], many, 1),
            np.zeros((many, KNOTS, count)),
            np.zeros((KNOTS, count)),
            np.zeros(count),
            x,
            rate,
            np.zeros(3),
            np.zeros(3),
            np.zeros(many),
            np.zeros(many),
            np.zeros(many, np.int64),
        )

    @cached_property
    def _kinematics(self) -> TaylorModel:
        if self.model is not None:
            return self.model.kinematics
        return generate_textbook_model(self.task.robot).kinematics

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

    @property
    def _fastest(self) -> float:
        """Maximum speed [m/s]."""
        return math.hypot(*np.abs(self._top_twists)[:, :2].max(axis=0))

    @property
    def _reach(self) -> float:
        """Distance covered by a rollout at full speed and the following stop [m]."""
        return self._fastest * HORIZON_S + self._braking.distance(self._fastest)

    @cached_property
    def _braking(self) -> Braking:
        limits = self.task.command_limits
        return find_braking(self.task.robot, self._kinematics, *limits)

    @cached_property
    def _plant(self) -> Plant:
        model = self._kinematics
        period = self._period
        terms = make_terms(model)
        latency = float(model.delays.max(initial=0.0))
        if self.model is not None:
            latency += max(0.0, self.model.calibration.command_latency_s)
        # The shortest lag of a decaying state determines the step.
        decays = (terms.dof >= 3) & (terms.degree == 1)
        decays &= terms.factors[:, 0] == terms.dof - 3
        fastest = np.abs(terms.coefficient[decays]).max(initial=0.0)
        finest = round(period / model.dt)
        substeps = min(max(1, math.ceil(period * fastest / FINEST)), finest)
        # steady states of half of each command alone
        commands = np.diag(0.5 * self.task.robot.command_high)
        pose = np.zeros((len(commands), 3))
        state = np.zeros((len(commands), model.state_size))
        for _ in range(round(SETTLED_S / model.dt)):
            pose, state = model.step(pose, state, commands)
        return Plant(
            replace_coefficients(
                terms, np.repeat(terms.coefficient[:, None], self.samples, axis=1)
            ),
            terms,
            SERIES,
            period / substeps,
            substeps,
            latency,
            np.ascontiguousarray((state / commands.diagonal()[:, None]).T),
            *self.task.command_limits,
        )

    @cached_property
    def _sampling(self) -> Sampling:
        robot = self.task.robot
        offers, noise = np.empty((2, self.samples, KNOTS, len(robot.command)))
        low, high = self.task.command_limits
        draw(offers, noise, 2.0 * (still(robot) - low) / (high - low) - 1.0, self.seed)
        places = np.linspace(0.0, KNOTS - 1.0, round(HORIZON_S / self._period))
        between = np.maximum(0.0, 1.0 - np.abs(places[:, None] - np.arange(KNOTS)))
        holds = np.array([command.unit == "rad" for command in robot.command])
        stop = 0
        far = math.inf
        longest = float(np.max(self._braking.time_s(self._top_twists), initial=0.0))
        if longest > 0.5 * HORIZON_S:
            stop = math.ceil(longest / self._period)
            far = min(self._reach, self.task.sight.range_max, maps.MOST_M)
        return Sampling(offers, noise, between, holds, still(robot), stop, far)
