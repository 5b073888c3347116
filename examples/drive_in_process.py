"""A hand-written policy drives one episode in the fast simulator."""

import gymnasium

import nics_drl_bridge  # noqa: F401 - makes the environments known
from nics_drl_bridge.policy.policies import make_policy

env = gymnasium.make("NicsBridge/Navigation-v0", backend="sim", model="ackermann", world="arena")
policy = make_policy("dynamic_window", env.unwrapped.task)

observation, info = env.reset(seed=0)
ended = False
while not ended:
    observation, reward, terminated, truncated, info = env.step(policy.act(observation))
    ended = terminated or truncated

print("reached the goal" if info["is_success"] else "did not reach the goal")
env.close()
