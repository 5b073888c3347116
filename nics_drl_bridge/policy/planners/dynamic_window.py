"""The dynamic-window planner (Fox, Burgard, Thrun 1997)."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.generator import CONTROL_PERIOD_S, SimulatorModel
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.lidar.arrays import Singles
from nics_drl_bridge.policy.planners import local_map as maps
from nics_drl_bridge.policy.planners.dynamic_window_kernels import (
    LookAhead,
    choose_twists,
)
from nics_drl_bridge.policy.planners.local_map_kernels import Clearance, Situation
from nics_drl_bridge.policy.planners.twists import (
    find_steady_twists,
    list_commands,
    scale_to_actions,
)
from nics_drl_bridge.robot.braking import Braking, find_braking

# The margin is wider than in `Mppi`, because the dynamic window chooses from few twists.
CLEARANCE = Clearance(margin=0.1, soft=0.4)
STEPS = 10  # minimum steps of the look-ahead, each `STEP` periods long
STEP = 1.5


@dataclass(frozen=True)
class DynamicWindow:
    """The dynamic-window approach (Fox, Burgard, Thrun 1997).

    Path lengths to the goal are measured around visible obstacles (Brock, Khatib 1999).
    Raises ConfigError if the robot's twists are unknown, see `compute_steady_twist`.
    """

    task: Navigation
    model: SimulatorModel | None = None  # provides twists without `cmd_vel`

    def __post_init__(self) -> None:
        _ = self.ahead

    def act(self, observation: Singles) -> Singles:
        """Chooses the action; see `Policy`."""
        parts = maps.split_observation(self.task, observation)
        chosen = np.empty(len(parts[0]), np.int64)
        choose_twists(chosen, *parts, self.twists, self.ahead, self._situation)
        actions = scale_to_actions(self.task, self.commands)
        return actions[chosen[0] if observation.ndim == 1 else chosen]

    @cached_property
    def commands(self) -> Array:
        """(K, C) candidate commands."""
        return list_commands(self.task.robot)

    @cached_property
    def twists(self) -> Array:
        """(K, 3) steady twists of the candidates."""
        return find_steady_twists(self.task, self.commands, self.model)

    @property
    def _fastest(self) -> float:
        return float(np.hypot(self.twists[:, 0], self.twists[:, 1]).max())

    @cached_property
    def ahead(self) -> LookAhead:
        """Parameters of the look-ahead and of braking."""
        period = CONTROL_PERIOD_S
        latency = 0.0
        if self.model is not None:
            period = self.model.control_period
            latency = max(0.0, self.model.calibration.command_latency_s)
        braking = self._find_braking()
        # A twist is held for a period and judged a period later; then the robot reacts. The
        # reaction time is known only to within a step of the robot's model, so it is rounded.
        held = 2.0 * period + latency
        reaction = held + round(braking.reaction_s, 2)
        turn_reaction = 0.0
        turn_slowness = 0.0
        if braking.turn is not None:
            turn_reaction = held + round(braking.turn.reaction_s, 2)
            turn_slowness = 1.0 / braking.turn.deceleration
        # Look ahead for as long as the robot needs to stop, but only within the
        # observed area.
        step = STEP * period
        slowest = float(braking.mean_time_s(self.twists).max()) - braking.reaction_s
        count = max(STEPS, math.ceil((reaction + slowest) / step))
        far = math.inf
        if count > STEPS:
            seen = min(self.task.sight.range_max, maps.MOST_M)
            far = min(self._fastest * step * count, seen)
        return LookAhead(
            self._find_reach(period),
            step,
            count,
            reaction,
            1.0 / braking.deceleration,
            braking.lever_m,
            turn_reaction,
            turn_slowness,
            far,
        )

    def _find_braking(self) -> Braking:
        """Returns how the model brakes; without one, at once after the robot's lag."""
        if self.model is None:
            return Braking(self._lag, math.inf)
        limits = self.task.command_limits
        return find_braking(self.task.robot, self.model.kinematics, *limits)

    @property
    def _lag(self) -> float:
        """Longest lag of the robot [s]."""
        known = self.task.robot.parameters
        return max(
            (known[name] for name in known if name.endswith("_lag")), default=0.0
        )

    def _find_reach(self, period: float) -> Array:
        """Returns how far each part of the twist (3,) may change within a period [s]."""
        lag = self._lag
        fraction = 1.0 - math.exp(-period / lag) if lag > 0.0 else 1.0
        # The window includes at least one step of the grid.
        steps = [
            np.diff(np.unique(speeds.round(6))).max(initial=0.0)
            for speeds in self.twists.T
        ]
        within_lag = fraction * np.ptp(self.twists, axis=0)
        return np.asarray(np.maximum(within_lag, steps) + 1e-6)

    @cached_property
    def _situation(self) -> Situation:
        outline = maps.fill_outline(self.task.robot)
        far = self._fastest * self.ahead.period * self.ahead.steps
        half = min(far, self.task.sight.range_max) + outline.outer
        return maps.make_situation(self.task, outline, CLEARANCE, half)
