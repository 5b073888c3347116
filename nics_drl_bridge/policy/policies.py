"""Policies by name: baselines that any trained policy must beat, planners, and policy files."""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.config import read_text
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.errors import ConfigError, PolicyError, suggest
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.policy.file.contract import MAPPINGS, SUFFIX, shipped
from nics_drl_bridge.policy.file.stateful import Policy, Stateful
from nics_drl_bridge.policy.planners import dynamic_window_kernels as kernels
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
from nics_drl_bridge.policy.planners.mppi import Mppi
from nics_drl_bridge.robot.braking import Braking, find_braking
from nics_drl_bridge.robot.kinds import (
    compute_steady_twist,
    find_command,
    has_textbook,
    reach,
)
from nics_drl_bridge.robot.spec import RobotSpec

if TYPE_CHECKING:
    from nics_drl_bridge.policy.file.policy_file import PolicyFile


# The margin is wider than in `Mppi`, because the dynamic window chooses from few twists.
CLEARANCE = Clearance(margin=0.1, soft=0.4)
FULL_TURN_RAD = 0.8  # bearing of the goal above which a robot turns at full rate
SETTLED_S = 5.0  # time to the steady twist of a held command
# minimum of a twist component that counts as controllable [m/s, rad/s]
LEAST_REACH = 1e-3
# fraction of the speed if the goal is behind a robot that can't turn in place
CREEP = 0.3


def _grid(robot: RobotSpec) -> Array:
    """Returns a grid of commands (K, C) over the full range of each, including rest."""
    counts = {1: (15,), 2: (7, 15), 3: (7, 7, 5)}.get(len(robot.command))
    axes = [
        np.unique(
            np.append(
                np.linspace(command.min, command.max, count),
                np.clip(0, command.min, command.max),
            )
        )
        for command, count in zip(
            robot.command, counts or [3] * len(robot.command), strict=True
        )
    ]
    return np.array(list(itertools.product(*axes)))


def _settled(task: Navigation, commands: Array, model: SimulatorModel | None) -> Array:
    """Returns the steady body twists (K, 3) of held commands (K, C).

    Uses the model if the robot does not take `cmd_vel`, whose kind is only approximate, or if its
    motors distort commands, which no kind describes.
    """
    if model is None or (task.robot.takes_cmd_vel and model.kinematics.is_plain):
        return compute_steady_twist(task.robot, commands)
    kinematics = model.kinematics
    start = np.zeros((len(commands), 3))
    state = np.zeros((len(commands), kinematics.state_size))
    moved = start
    low = kinematics.low[: state.shape[1]]
    high = kinematics.high[: state.shape[1]]
    for _ in range(round(SETTLED_S / kinematics.dt)):
        moved, state = kinematics.step(start, state, commands)
        state = np.clip(state, low, high)
    return geometry.log(moved) / kinematics.dt


def _find_slowest_lag(robot: RobotSpec) -> float:
    """Returns the slowest lag that a robot's kind states [s]; 0 without any."""
    lags = [value for name, value in robot.parameters.items() if name.endswith("_lag")]
    return max(lags, default=0.0)


def actions_of(task: Navigation, commands: Array) -> NDArray[np.float32]:
    """Returns the continuous actions (..., C) for commands (..., C), clamped to [-1, 1]."""
    low, high = task.command_limits
    return np.clip(2.0 * (commands - low) / (high - low) - 1.0, -1.0, 1.0).astype(
        np.float32
    )


@dataclass(frozen=True)
class StraightToGoal:
    """Turns to the goal and drives there, ignoring obstacles."""

    task: Navigation
    # provides the twists of a robot whose kind does not define them
    model: SimulatorModel | None = None

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Chooses the action; see `Policy`."""
        robot = self.task.robot
        first = self.task.scan_parts + 1
        cosine, sine = np.moveaxis(
            observation[..., first : first + 2].astype(float), -1, 0
        )
        turn = np.clip(np.arctan2(sine, cosine) / FULL_TURN_RAD, -1.0, 1.0)
        ahead = np.maximum(cosine, 0.0 if self._turns_in_place else CREEP)
        shares = np.stack([ahead, np.zeros_like(ahead), turn], axis=-1)
        if robot.takes_cmd_vel:
            wanted = robot.from_fields(shares) * robot.command_high
        else:
            wanted = self._command(shares)
        return actions_of(self.task, wanted)

    def _command(self, shares: Array) -> Array:
        """Returns commands (..., C) for fractions (..., 3) of the maximum twist."""
        robot = self.task.robot
        if has_textbook(robot):
            return find_command(robot, shares * self._reach)
        commands, twists = self._known
        apart = twists / self._reach - shares[..., None, :]
        return np.asarray(commands[(apart**2).sum(axis=-1).argmin(axis=-1)])

    @cached_property
    def _known(self) -> tuple[Array, Array]:
        commands = _grid(self.task.robot)
        return commands, _settled(self.task, commands, self.model)

    @cached_property
    def _reach(self) -> Array:
        if has_textbook(self.task.robot):
            return reach(self.task.robot)
        return np.asarray(np.maximum(np.abs(self._known[1]).max(axis=0), LEAST_REACH))

    @cached_property
    def _turns_in_place(self) -> bool:
        if self.task.robot.takes_cmd_vel:
            return not self.task.robot.steers
        return bool(self._command(np.array([0.0, 0.0, 1.0])).any())


@dataclass(frozen=True)
class RandomActions:
    """Draws each action at random, ignoring the observation."""

    task: Navigation
    seed: int = 0

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Draws the action; see `Policy`."""
        shape = (*observation.shape[:-1], len(self.task.robot.command))
        return self._rng.uniform(-1.0, 1.0, shape).astype(np.float32)

    @cached_property
    def _rng(self) -> np.random.Generator:
        return np.random.default_rng(self.seed)


@dataclass(frozen=True)
class DynamicWindow:
    """The dynamic-window approach (Fox, Burgard, Thrun 1997).

    Path lengths to the goal lead around visible obstacles (Brock, Khatib 1999). Raises ConfigError
    if the robot's twists are unknown, see `compute_steady_twist`.
    """

    task: Navigation
    clearance: Clearance = CLEARANCE
    period: float = 0.1  # time between commands [s]
    steps: int = 10  # steps of the look-ahead, each 1.5 periods long
    # see `TwistWeights`
    weights: tuple[float, float, float, float] = (
        1.0,
        0.6,
        0.3,
        1.5,
    )
    model: SimulatorModel | None = None  # provides twists without `cmd_vel`

    def __post_init__(self) -> None:
        _ = self._search

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Chooses the action; see `Policy`."""
        parts = split_observation(self.task, observation)
        chosen = np.empty(len(parts[0]), np.int64)
        kernels.choose_all(chosen, *parts, *self._search, self._sense)
        return self._scaled[chosen[0] if observation.ndim == 1 else chosen]

    @cached_property
    def _search(self) -> tuple[Array, kernels.LookAhead, kernels.TwistWeights]:
        twists = _settled(self.task, self._commands, self.model)
        lag = _find_slowest_lag(self.task.robot)
        share = 1.0 - math.exp(-self.period / lag) if lag > 0.0 else 1.0
        if self.model is None:
            braking = Braking(lag, math.inf)
        else:
            limits = self.task.command_limits
            braking = find_braking(self.task.robot, self.model.kinematics, *limits)
        steps = [
            np.diff(np.unique(speeds.round(6))).max(initial=0.0) for speeds in twists.T
        ]
        # The window includes at least one step of the grid.
        reach = np.maximum(share * np.ptp(twists, axis=0), steps) + 1e-6
        if self.model is None:
            late = 0.0
        else:
            late = max(0.0, self.model.calibration.command_latency_s)
        # A twist is held for a period and judged a period later; then the robot reacts. The
        # reaction time is known only to within a step of the robot's model, so it is rounded.
        held = 2.0 * self.period + late
        reaction = held + round(braking.reaction_s, 2)
        turn_reaction = 0.0
        turn_slowness = 0.0
        if braking.turn is not None:
            turn_reaction = held + round(braking.turn.reaction_s, 2)
            turn_slowness = 1.0 / braking.turn.deceleration
        step = 1.5 * self.period
        slowest = float(braking.mean_time_s(twists).max()) - braking.reaction_s
        needed = math.ceil((reaction + slowest) / step)
        far = math.inf
        count = self.steps
        # Look ahead for as long as the robot needs to stop, but only over ground that it sees.
        if needed > count:
            count = needed
            fastest = float(np.hypot(twists[:, 0], twists[:, 1]).max())
            far = min(fastest * step * count, self.task.sight.range_max, MOST_M)
        ahead = kernels.LookAhead(
            reach,
            step,
            count,
            reaction,
            1.0 / braking.deceleration,
            braking.lever_m,
            turn_reaction,
            turn_slowness,
            far,
        )
        return twists, ahead, kernels.TwistWeights(*self.weights)

    @cached_property
    def _sense(self) -> tuple[ScanRays, FootprintDiscs, Clearance, MapScratch]:
        outline, (twists, ahead, _) = outline_of(self.task.robot), self._search
        far = (
            float(np.hypot(twists[:, 0], twists[:, 1]).max())
            * ahead.period
            * ahead.steps
        )
        half = min(far, self.task.sight.range_max) + outline.outer
        scratch = scratch_of(self.task.scan_parts, outline, self.clearance, half)
        return rays_of(self.task), outline, self.clearance, scratch

    @cached_property
    def _commands(self) -> Array:
        return _grid(self.task.robot)

    @cached_property
    def _scaled(self) -> NDArray[np.float32]:
        return actions_of(self.task, self._commands)


POLICIES: dict[str, Callable[[Navigation, SimulatorModel | None], Policy]] = {
    "dynamic_window": lambda task, model: DynamicWindow(
        task, period=0.1 if model is None else model.control_period, model=model
    ),
    "mppi": Mppi,
    "random": lambda task, _: RandomActions(task),
    "straight": StraightToGoal,
}


def shipped_policies() -> list[str]:
    """Returns the names of the shipped policy files."""
    return sorted(file.stem for file in shipped().glob(f"*{SUFFIX}"))


def is_policy_file(name: str) -> bool:
    """Returns True for a policy file, the name of a shipped one, or a foreign policy's mapping.

    Returns False for a baseline or planner. Raises ConfigError for an unknown name.
    """
    files = shipped_policies()
    if (
        name not in POLICIES
        and not name.endswith((SUFFIX, *MAPPINGS))
        and name not in files
    ):
        raise ConfigError(
            f"unknown policy {name!r}; {suggest(name, (*POLICIES, *files))}"
        )
    return name not in POLICIES


def check_policy_file(name: str) -> None:
    """Raises PolicyError or ConfigError unless a policy file can be read, for whatever robot."""
    from nics_drl_bridge.policy.file.policy_file import load_policy

    if name.endswith(MAPPINGS):
        read_text(name)
    else:
        load_policy(name)


def make_policy(
    name: str, task: Navigation, model: SimulatorModel | None = None
) -> Policy:
    """Makes a policy from a name or the path of a file. Raises ConfigError, PolicyError."""
    if not is_policy_file(name):
        return POLICIES[name](task, model)
    # Only policy files need onnxruntime.
    from nics_drl_bridge.policy.file.policy_file import load_policy

    policy = load_policy(name, model)
    policy.check_fits(model, task)
    return _acting(policy)


def open_policy(
    name: str, model: SimulatorModel, kind: str | None = None
) -> tuple[Policy, Navigation]:
    """Opens a policy and its task: navigation, or the task class `kind`.

    `kind` is path/to/file.py:ClassName. Raises ConfigError, and PolicyError for another task.
    """
    if not is_policy_file(name):
        if kind is not None:
            reason = "only drives the task 'navigation'; use another policy, or leave out --task"
            raise ConfigError(f"policy {name!r} {reason}.")
        task = Navigation(model.robot, model.lidar)
        return POLICIES[name](task, model), task
    from nics_drl_bridge.policy.file.policy_file import load_policy

    policy = load_policy(name, model)
    opened: Any = policy.make_task(model, kind)  # any task, if `kind` names its class
    if kind is None and not isinstance(opened, Navigation):
        reason = f"is {policy.contract.task.name!r}; only policies of 'navigation' can be driven."
        raise PolicyError(name, "task.name", reason)
    return _acting(policy), opened


def _acting(policy: "PolicyFile") -> Policy:
    """Returns the policy of a file, wrapped to keep its state if it has one."""
    kept = policy.contract.state
    if kept is None:
        return policy
    return Stateful(policy.step, kept.size, kept.start, kept.longest_gap)
