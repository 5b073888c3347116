"""Settings with which the robot could never move: to be said at the start, not in the field."""

from __future__ import annotations

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.safety.state import GateConfig

LEAST_DATA = 2
"""So many data have to come while the gate settles, for their rate to be known."""


def require_possible(config: GateConfig) -> None:
    """Looks for settings with which the gate could never be armed.

    Raises:
        ConfigError: there is one, with the parameter, its value and what it needs.
    """
    for topic, rate, age in (
        ("scan", config.scan_rate, config.scan_age_s),
        ("odom", config.odom_rate, config.odom_age_s),
    ):
        declared = f"{topic} comes every {1.0 / rate:.3g} s ({rate:g} Hz are declared)"
        if age <= 1.0 / rate:
            raise ConfigError(
                f"parameter '{topic}_age': {age:g} s: {declared}, so the robot could never move; "
                f"give more than {1.0 / rate:.3g}."
            )
        if rate * config.settle_s < LEAST_DATA:
            raise ConfigError(
                f"{declared}, too seldom to be judged within {config.settle_s:g} s, so the robot "
                f"could never move; the gate needs {LEAST_DATA / config.settle_s:g} Hz or more."
            )


def doubtful(config: GateConfig, control_period_s: float) -> str:
    """A sentence about a setting with which only an unusual policy moves the robot, or nothing.

    Args:
        config: of the gate.
        control_period_s: of the model, at which a policy commands unless it is told otherwise [s].
    """
    if config.command_age_s > control_period_s:
        return ""
    return (
        f"parameter 'command_age': {config.command_age_s:g} s: a policy commands every "
        f"{control_period_s:g} s unless it is told otherwise, and the robot would stop between any "
        f"two commands; give more than {control_period_s:g}."
    )
