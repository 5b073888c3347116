"""A task of one's own, in one file: patrol between two places, again and again.

    gymnasium.make("NicsBridge/Task-v0", task="examples/own_task.py:Patrol")

`docs/tasks.md` explains each part. Run as a program, this file drives an episode of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import gymnasium
import numpy as np

import nics_drl_bridge  # noqa: F401 - makes the environments known
from nics_drl_bridge.env.task import Task, bearing, distance, limited


@dataclass(frozen=True)
class Patrol(Task):
    """Drive back and forth between the start and the goal that the world drew.

    Attributes:
        radius: how near is there [m].
        rounds: so many arrivals are a success.
    """

    radius: float = 0.3
    rounds: int = 3

    @cached_property
    def observation_space(self):
        """The scan, distance and bearing of the present target, and the twist."""
        return self.box([0, -1, -1, *[-1000] * 3], [1000, 1, 1, *[1000] * 3])

    def reset(self, episodes):
        """Both places, how many arrivals there were, and whether the last step was one."""
        places = np.stack([episodes.goals, episodes.starts[..., :2]], axis=-2)  # (n, M, 2, 2)
        count = np.zeros(places.shape[:-2], np.int64)  # (n, M)
        return {"places": places, "arrivals": count, "arrived": count > 0}

    def target(self, memory):
        """(..., 2) the goal after an even number of arrivals, the start after an odd one."""
        even = (memory["arrivals"] % 2 == 0)[..., None]
        return np.where(even, memory["places"][..., 0, :], memory["places"][..., 1, :])

    def update(self, before, after, memory):
        """Counts arrivals, before anything is judged."""
        memory["arrived"][...] = distance(after.pose, self.target(memory)) < self.radius
        memory["arrivals"] += memory["arrived"]

    def observation(self, view, memory):
        """What the robot sees."""
        parts = [
            self.free_share(view.ranges),
            bearing(view.pose, self.target(memory)),
            limited(view.twist),
        ]
        return np.concatenate(parts, axis=-1).astype(np.float32)

    def reward(self, before, after, memory):
        """An arrival pays 5, a metre of approach 1, a touch costs 10."""
        target = self.target(memory)
        approach = distance(before.pose, target) - distance(after.pose, target)
        return {
            "progress": np.where(memory["arrived"], 0.0, approach),
            "arrival": 5.0 * memory["arrived"],
            "collision": -10.0 * self.touches(after.ranges),
        }

    def end(self, view, memory):
        """At a touch, and after the last round."""
        return self.touches(view.ranges) | (memory["arrivals"] >= self.rounds)

    def info(self, view, memory):
        """What an evaluation reads."""
        return {
            "is_success": memory["arrivals"] >= self.rounds,
            "collision": self.touches(view.ranges),
            "arrivals": memory["arrivals"].copy(),
        }


if __name__ == "__main__":
    env = gymnasium.make("NicsBridge/Task-v0", task=Patrol, model="differential", world="empty")
    observation, info = env.reset(seed=1)
    total, ended = 0.0, False
    while not ended:
        ahead, left = observation[-5:-3]  # cosine and sine of the target's bearing
        turn = left if ahead > 0.0 else np.sign(left)
        action = np.array([max(ahead, 0.0) - 1.0, turn], np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        total, ended = total + reward, terminated or truncated
    print(f"{info['arrivals']} arrivals, reward {total:.2f}: {info['reward_terms']}")

    envs = gymnasium.make_vec(
        "NicsBridge/Task-v0", num_envs=64, task=Patrol, model="differential", world="empty"
    )
    envs.reset(seed=1)
    for _ in range(100):
        _, rewards, *_ = envs.step(envs.action_space.sample())
    print(f"64 worlds of the same task, mean reward of the last step {rewards.mean():.3f}")
