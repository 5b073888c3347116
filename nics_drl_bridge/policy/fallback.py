"""A planner behind a policy: it acts where the policy asks for what can't be stopped in time."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.env.task import Task
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.policy.local_map_kernels import Clearance
from nics_drl_bridge.policy.mppi import Mppi
from nics_drl_bridge.policy.stateful import Policy, begin, resume

KEPT = Clearance(margin=0.05, soft=0.1)  # by the policy's actions; the shield's margin
READ = ("observation", "observation_space", "_see")
"""What makes the observations of a navigation task."""


class Fallback:
    """Acts as a policy where that is admissible, and as a planner elsewhere.

    An action is admissible if the robot, by its model, can follow it for a period and then stop
    without a touch of its outline with anything that the observation shows (`Mppi.can_stop`). The
    policy is asked each time, so that its state goes on while the planner acts; nothing else is
    remembered.
    """

    def __init__(
        self,
        policy: Policy,
        planner: Policy,
        task: Navigation,
        model: SimulatorModel | None,
    ) -> None:
        self._policy = policy
        self._planner = planner
        self._task = task
        self._judge = Mppi(task, model, samples=1, clearance=KEPT)
        self.acted = 0  # actions of the planner
        # So that all is compiled now, not when it is needed.
        planner.act(np.zeros(task.observation_space.shape, np.float32))

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """See `Policy`."""
        action = self._policy.act(observation)
        risky = ~self._judge.can_stop(observation, self._task.command(action))
        if not risky.any():
            return action
        self.acted += int(risky.sum())
        action = np.array(action)
        action[risky] = self._planner.act(observation[risky])
        return action

    def reset(self, *worlds: Any) -> None:
        """Begins an episode of the policy; see `Stateful.reset`."""
        begin(self._policy, *worlds)

    def resume(self, time_s: float) -> str:
        """See `stateful.resume`."""
        return resume(self._policy, time_s)


def acted(policy: Any) -> int | None:
    """Actions of the planner behind a policy, or whose method `act` this is; None without one."""
    return getattr(getattr(policy, "__self__", policy), "acted", None)


def check_readable(task: Navigation, planner: str) -> None:
    """Raises ConfigError for observations that no planner reads, and actions that none gives."""
    kind = type(task)
    named = f"fallback {planner!r}"
    own = any(getattr(kind, one, None) is not getattr(Navigation, one) for one in READ)
    if own or getattr(kind, "step_into", None) not in (
        Navigation.step_into,
        Task.step_into,
    ):
        reason = (
            f"reads what 'navigation' observes, and {kind.__name__} observes otherwise"
        )
        raise ConfigError(f"{named} {reason}; leave it out.")
    if task.actions == "discrete":
        reason = "gives continuous actions, and those of the policy are discrete"
        raise ConfigError(f"{named} {reason}; leave it out.")
