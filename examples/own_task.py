"""A custom task: patrol between two places; `docs/tasks.md` explains each part."""

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from nics_drl_bridge import load_robot, load_world, make
from nics_drl_bridge.env.task import Task, bearing, distance
from nics_drl_bridge.policy.evaluation import drive
from nics_drl_bridge.report.pictures import draw_trajectories


@dataclass(frozen=True)
class Patrol(Task):
    radius: float = 0.3  # distance at which a place counts as reached [m]
    rounds: int = 3  # number of arrivals for success

    @property
    def observation_space(self):
        # the scan, then distance, cosine and sine of the goal's bearing
        return self.box([0, -1, -1], [1000, 1, 1])

    def reset(self, episodes):
        goal = episodes.goals.copy()
        back = episodes.starts[..., :2].copy()
        count = np.zeros(goal.shape[:-1], np.int64)
        return {"goal": goal, "back": back, "arrivals": count, "arrived": count > 0}

    def update(self, before, after, memory):  # a robot that has arrived turns back
        memory["arrived"][...] = there = (
            distance(after.pose, memory["goal"]) < self.radius
        )
        memory["arrivals"] += there
        memory["goal"][there], memory["back"][there] = (
            memory["back"][there],
            memory["goal"][there],
        )

    def observation(self, view, memory):
        seen = [self.free_share(view.ranges), bearing(view.pose, memory["goal"])]
        return np.concatenate(seen, axis=-1).astype(np.float32)

    def reward(self, before, after, memory):
        was, now = (distance(view.pose, memory["goal"]) for view in (before, after))
        return {"progress": was - now, "arrival": 5.0 * memory["arrived"]}

    def end(self, view, memory):
        return self.touches(view.ranges) | (memory["arrivals"] >= self.rounds)

    def info(self, view, memory):  # read by evaluations
        arrivals = memory["arrivals"].copy()
        touches = self.touches(view.ranges)
        return {
            "is_success": arrivals >= self.rounds,
            "collision": touches,
            "arrivals": arrivals,
        }


def main():  # the policy turns to the goal and drives once it is ahead
    robot = load_robot("differential")
    world = load_world("empty")
    policy = SimpleNamespace(
        act=lambda seen: np.float32([max(seen[-2], 0) - 1, seen[-1]])
    )
    run = drive(make(task=Patrol, model="differential", world=world), policy, seed=1)
    print(f"{run.result} after {run.steps} steps")
    Path("own_task.png").write_bytes(
        draw_trajectories({"path": [run]}, world, robot.footprint_radius)
    )


if __name__ == "__main__":
    main()
