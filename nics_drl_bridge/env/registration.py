"""Makes the environments known to `gymnasium.make` and `gymnasium.make_vec`."""

from __future__ import annotations

import gymnasium

NAVIGATION = "NicsBridge/Navigation-v0"
COOPERATIVE_REACHING = "NicsBridge/CooperativeReaching-v0"
PURSUIT_EVASION = "NicsBridge/PursuitEvasion-v0"
TASK = "NicsBridge/Task-v0"
ENVIRONMENTS = {
    NAVIGATION: {"task": "navigation"},
    COOPERATIVE_REACHING: {"task": "cooperative_reaching"},
    PURSUIT_EVASION: {"task": "pursuit_evasion"},
    TASK: {},
}
"""Id -> arguments that make it what it is."""
MAX_EPISODE_STEPS = 300


def register_envs() -> None:
    """Registers every environment; importing this module does it too."""
    for name, arguments in ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="nics_drl_bridge.env.bridge_env:BridgeEnv",
                vector_entry_point="nics_drl_bridge.env.vector_env:BridgeVectorEnv",
                max_episode_steps=MAX_EPISODE_STEPS,
                kwargs=dict(arguments),
            )


register_envs()
