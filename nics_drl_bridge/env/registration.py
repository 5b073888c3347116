"""Makes the environments known to `gymnasium.make`."""

from __future__ import annotations

import gymnasium

NAVIGATION = "NicsBridge/Navigation-v0"
MAX_EPISODE_STEPS = 300


def register_envs() -> None:
    """Registers every environment; importing this module does it too."""
    if NAVIGATION not in gymnasium.registry:
        gymnasium.register(
            NAVIGATION,
            entry_point="nics_drl_bridge.env.bridge_env:BridgeEnv",
            vector_entry_point="nics_drl_bridge.env.vector_env:NavigationVectorEnv",
            max_episode_steps=MAX_EPISODE_STEPS,
        )


register_envs()
