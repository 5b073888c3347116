"""Drive three robots in one world, each to its own goal."""

import gymnasium
import numpy as np
from PIL import Image

import nics_drl_bridge  # noqa: F401 - registers the environments

ROBOTS = 3
SEED = 2


def to_the_goal(cosine: np.ndarray, sine: np.ndarray) -> np.ndarray:
    """Return actions (M, 2) in [-1, 1], forward speed and turn rate, from the goal's bearing."""
    ahead = np.where(cosine > 0.7, 0.6 * cosine, 0.0)
    return np.stack([ahead, np.where(cosine > 0.0, sine, np.sign(sine))], axis=-1)


def main() -> None:
    env = gymnasium.make(
        "NicsBridge/CooperativeReaching-v0",
        model="differential",
        world="empty",
        task_options={"robots": ROBOTS},
        render_mode="rgb_array",
    )
    observation, info = env.reset(seed=SEED)
    own = np.arange(ROBOTS)
    ended = False
    pictures = []
    while not ended:
        seen = observation.reshape(ROBOTS, -1)
        goals = seen[:, -3 - 3 * (ROBOTS - 1) - 4 * ROBOTS :][:, : 4 * ROBOTS]
        cosine, sine = goals.reshape(ROBOTS, ROBOTS, 4)[own, own, 1:3].T
        action = to_the_goal(cosine, sine).astype(np.float32)
        pictures.append(env.render())
        observation, _, terminated, truncated, info = env.step(action.ravel())
        ended = terminated or truncated
    print(f"{len(pictures)} steps, reached: {bool(np.all(info['is_success']))}")
    shown = [pictures[k] for k in (0, len(pictures) // 2, -1)]
    Image.fromarray(np.concatenate(shown, axis=1)).quantize(64).save(
        "several_robots.png"
    )


if __name__ == "__main__":
    main()
