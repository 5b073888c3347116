"""Early stop: ends a training when held-out success passes the threshold twice in a row.

Each evaluation has its own episodes, so luck in one does not carry over to the next: a true
success rate of 95 % appears as 97 % of 200 episodes in about one of eight evaluations, but in both
of two consecutive ones only about once in sixty. The weights of the second one are kept.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.policy.evaluation import Act, drive_worlds
from nics_drl_bridge.policy.train.settings import StopSettings

# first seed of these episodes, beyond the seeds of training and of the protocol
HELD_OUT_SEED = 2**41
IN_A_ROW = 2


@dataclass
class Stop:
    """Decides when a training ends early; without settings, it never does."""

    settings: StopSettings | None
    # by world name, each with one world per episode of an evaluation
    envs: Mapping[str, BridgeVectorEnv]
    due: int = 0  # number of the latest evaluation
    reached: int = 0  # consecutive evaluations that passed
    # success rate by world in the latest evaluation
    shares: dict[str, float] = field(default_factory=dict)

    @property
    def over(self) -> bool:
        """True if the training should end."""
        return self.reached >= IN_A_ROW

    @property
    def least(self) -> float:
        """Minimum success over the worlds in the latest evaluation; NaN before the first."""
        return min(self.shares.values(), default=float("nan"))

    def judge(self, steps: int, act: Act) -> bool:
        """Evaluates the policy `act` if due after `steps`; returns True if it did."""
        settings = self.settings
        if settings is None or steps // settings.every <= self.due:
            return False
        self.due = steps // settings.every
        first = HELD_OUT_SEED + self.due * settings.episodes
        seeds = range(first, first + settings.episodes)
        driven = {
            world: drive_worlds(env, act, seeds) for world, env in self.envs.items()
        }
        self.shares = {
            world: float(outcomes.success.mean()) for world, outcomes in driven.items()
        }
        self.reached = self.reached + 1 if self.least >= settings.success else 0
        return True

    def state(self) -> dict[str, Any]:
        """Returns everything that changes, for a checkpoint."""
        return {
            "stop": {"due": self.due, "reached": self.reached, "shares": self.shares}
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continues from a saved state; starts afresh if the checkpoint has none."""
        saved = state.get("stop")
        if saved:
            self.due = saved["due"]
            self.reached = saved["reached"]
            self.shares = dict(saved["shares"])
