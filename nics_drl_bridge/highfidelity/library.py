"""The one place that imports MuJoCo."""

from __future__ import annotations

from typing import Any

from nics_drl_bridge.errors import ConfigError


def load_mujoco() -> Any:
    """The module `mujoco`.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        import mujoco
    except ImportError:
        raise ConfigError(
            "MuJoCo is not installed; run pip install 'nics_drl_bridge[mujoco]'."
        ) from None
    return mujoco
