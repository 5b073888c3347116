"""`nics`, with a robot that believes to be at its goal, or a policy that stands still.

python -m measuring.deceived lying|standing evaluate ...
"""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from measuring.standing import Standing
from nics_drl_bridge.commands import episodes
from nics_drl_bridge.commands.cli import main
from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.interface import RobotView
from nics_drl_bridge.middleware.middleware import Middleware


def lie() -> None:
    """From now on every robot tells that it is at the goal of the episode."""
    goals: list[NDArray[np.float64]] = []
    reset = BridgeEnv.reset
    view = Middleware.view

    def remembering(self: BridgeEnv, **given: Any) -> Any:
        goals.clear()
        began = reset(self, **given)
        assert self.scene is not None
        goals.append(self.scene.goals[0])
        return began

    def lying(self: Middleware, now_ns: int) -> RobotView:
        seen = view(self, now_ns)
        return (
            replace(seen, pose=np.array([*goals[0], seen.pose[2]])) if goals else seen
        )

    BridgeEnv.reset = remembering  # type: ignore[method-assign]
    Middleware.view = lying  # type: ignore[method-assign]


def stand() -> None:
    """From now on every policy stands still."""
    opened = episodes.open_policy

    def standing(*given: Any) -> Any:
        _, task = opened(*given)
        return Standing(task), task

    episodes.open_policy = standing  # type: ignore[assignment]


if __name__ == "__main__":
    {"lying": lie, "standing": stand}[sys.argv.pop(1)]()
    main()
