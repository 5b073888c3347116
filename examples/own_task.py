"""A task of one's own: patrol between two places; `docs/tasks.md` explains each part."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from PIL import Image

from nics_drl_bridge import make
from nics_drl_bridge.env.task import Task, bearing, distance


@dataclass(frozen=True)
class Patrol(Task):
    radius: float = 0.3  # how near is there [m]
    rounds: int = 3  # so many arrivals are a success

    @cached_property
    def observation_space(self):  # the scan, then distance, cosine, sine of the target's bearing
        return self.box([0, -1, -1], [1000, 1, 1])

    def reset(self, episodes):
        goal, start = episodes.goals.copy(), episodes.starts[..., :2].copy()
        count = np.zeros(goal.shape[:-1], np.int64)
        return {"goal": goal, "start": start, "arrivals": count, "arrived": count > 0}

    def target(self, memory):  # the goal after an even number of arrivals, else the start
        return np.where(memory["arrivals"][..., None] % 2 == 0, memory["goal"], memory["start"])

    def update(self, before, after, memory):
        memory["arrived"][...] = distance(after.pose, self.target(memory)) < self.radius
        memory["arrivals"] += memory["arrived"]

    def observation(self, view, memory):
        parts = [self.free_share(view.ranges), bearing(view.pose, self.target(memory))]
        return np.concatenate(parts, axis=-1).astype(np.float32)

    def reward(self, before, after, memory):
        was, now = (distance(view.pose, self.target(memory)) for view in (before, after))
        progress = np.where(memory["arrived"], 0.0, was - now)
        return {"progress": progress, "arrival": 5.0 * memory["arrived"]}

    def end(self, view, memory):
        return self.touches(view.ranges) | (memory["arrivals"] >= self.rounds)

    def info(self, view, memory):  # what an evaluation reads
        arrivals, touches = memory["arrivals"].copy(), self.touches(view.ranges)
        return {"is_success": arrivals >= self.rounds, "collision": touches, "arrivals": arrivals}


def main():
    env = make(task=Patrol, model="differential", world="empty", render_mode="rgb_array")
    (observation, _), ended, frames = env.reset(seed=1), False, []
    while not ended:
        ahead, left = observation[-2:]
        action = max(ahead, 0.0) - 1.0, left if ahead > 0.0 else np.sign(left)
        observation, _, ended, _, info = env.step(np.array(action, np.float32))
        frames.append(env.render())
    print(f"{info['arrivals']} arrivals")
    picture = np.min(frames[::6], axis=0)  # of many moments, as in a long exposure
    Image.fromarray(picture).quantize(64).save("own_task.png")


if __name__ == "__main__":
    main()
