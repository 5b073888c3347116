"""A robot's noise, which the simulator draws and the estimator expects, and its latency."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from nics_drl_bridge.config import Schema
from nics_drl_bridge.robot.spec import RobotSpec

MEASURED: Literal["measured"] = "measured"
# Drift of an unmeasured state within a second, as a fraction of its range
ASSUMED_STATE_DRIFT = 0.1


class Level(Schema):
    """One standard deviation: measured in the recording, with its uncertainty, or assumed."""

    std: float = Field(ge=0.0)
    unit: str
    source: Literal["measured", "assumed"] = "assumed"
    uncertainty: float | None = Field(default=None, ge=0.0)

    @property
    def measured(self) -> bool:
        """True if the level was measured in the recording."""
        return self.source == MEASURED


def assume_level(std: float, unit: str) -> Level:
    """Returns an assumed level."""
    return Level(std=std, unit=unit)


class Noise(Schema):
    """Noise of a robot's odometry and pose sensor, and drift of its pose and of each state.

    Drift is motion that the model does not explain; it grows with the square root of time. The
    simulator draws odometry noise and measured drift; assumed drift is only a margin for the
    estimator. The estimator takes R from the noise of odometry and pose, and Q from the drift.
    """

    odom_linear: Level = assume_level(0.01, "m/s")
    odom_angular: Level = assume_level(0.01, "rad/s")
    pose_position: Level = assume_level(0.01, "m")
    pose_heading: Level = assume_level(0.01, "rad")
    position_drift: Level = assume_level(0.02, "m/sqrt(s)")
    heading_drift: Level = assume_level(0.02, "rad/sqrt(s)")
    state_drift: dict[str, Level] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check_units(self) -> "Noise":
        for name, field in type(self).model_fields.items():
            level = getattr(self, name)
            if isinstance(level, Level) and level.unit != field.default.unit:
                raise ValueError(f"{name} must be in {field.default.unit}")
        return self

    @property
    def odometry(self) -> tuple[float, float]:
        """Standard deviations of a measured twist: linear [m/s], angular [rad/s]."""
        return self.odom_linear.std, self.odom_angular.std

    @property
    def pose(self) -> tuple[float, float, float]:
        """Standard deviations of a measured pose: x, y [m], heading [rad]."""
        return self.pose_position.std, self.pose_position.std, self.pose_heading.std

    def drift(self, spec: RobotSpec) -> NDArray[np.float64]:
        """Returns the drift (3 + S,) of pose and state in a second that the estimator expects."""
        return np.array([level.std for level in self._list_drift(spec)])

    def simulated_drift(self, spec: RobotSpec) -> NDArray[np.float64]:
        """Returns the drift (3 + S,) that the simulator draws: measured levels, else zero."""
        levels = self._list_drift(spec)
        return np.array([level.std if level.measured else 0.0 for level in levels])

    def _list_drift(self, spec: RobotSpec) -> list[Level]:
        levels = [self.position_drift, self.position_drift, self.heading_drift]
        for v in spec.state:
            std = ASSUMED_STATE_DRIFT * (v.max - v.min)
            assumed = assume_level(std, f"{v.unit}/sqrt(s)")
            levels.append(self.state_drift.get(v.name, assumed))
        return levels

    def sentences(self) -> list[str]:
        """Returns one human-readable line per level."""
        lines = []
        for name in type(self).model_fields:
            level = getattr(self, name)
            if isinstance(level, Level):
                lines.append(_describe_level(name, level))
        for name, level in self.state_drift.items():
            lines.append(_describe_level(f"state_drift of {name}", level))
        return lines


def _describe_level(name: str, level: Level) -> str:
    line = f"{name.replace('_', ' '):<28} {level.std:.3g} {level.unit}"
    if level.uncertainty is not None:
        line += f" (+- {level.uncertainty:.1g})"
    if not level.measured:
        line += ", assumed"
    return line


class Delay(Schema):
    """A uniform distribution of delays, from `least` to `least + jitter` [s]."""

    least: float = Field(ge=0.0)
    jitter: float = Field(ge=0.0)


class Latency(Schema):
    """Delays until receipt: of a scan after its last beam, of odometry after its stamp."""

    scan: Delay | None = None
    odom: Delay | None = None

    @property
    def measured(self) -> dict[str, Delay]:
        """Known delays, by topic."""
        named = {"scan": self.scan, "odom": self.odom}
        return {topic: delay for topic, delay in named.items() if delay is not None}

    def sentences(self) -> list[str]:
        """Returns one human-readable line per topic."""
        lines = []
        for topic, delay in self.measured.items():
            lines.append(
                f"{topic} arrives {1e3 * delay.least:.1f} to "
                f"{1e3 * (delay.least + delay.jitter):.1f} ms after it was measured"
            )
        return lines
