"""LidarSpec: the single definition of a lidar's beams, limits and header fields.

Within the package, ranges follow REP-117: `inf` is no return, `-inf` is too close, NaN
is an invalid measurement, and all other values are within the limits. Devices differ:
`LidarSpec.no_return` names their convention, which only this module handles. Limits are
compared in float32, as in the message: a limit of 0.16 m becomes slightly less, and a
return at 0.16 m still counts.
"""

from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from nics_drl_bridge.config import Mount, Schema, find_config, load_yaml
from nics_drl_bridge.lidar.arrays import Array, Singles
from nics_drl_bridge.lidar.faults import SKEW, LidarFaults
from nics_drl_bridge.lidar.shapes import LARGEST

FULL_CIRCLE_TOLERANCE = 1e-6
NoReturn = Literal["inf", "zero", "nan", "range_max"]


class ScanHeader(NamedTuple):
    """The fields of a LaserScan that follow from the lidar, with their names in the message."""

    angle_min: float  # of the first beam [rad]
    angle_max: float  # of the last beam, also for a full circle [rad]
    angle_increment: float  # between neighbouring beams [rad]
    time_increment: float  # [s]; 0 if all are measured at once, negative if clockwise
    scan_time: float  # between scans [s]
    range_min: float  # nearest return [m]
    range_max: float  # farthest return [m]


def check_angles(angle_min: float, angle_max: float) -> None:
    """Raise ValueError unless the limits span at most a full circle within two turns."""
    if not 0.0 < angle_max - angle_min <= 2.0 * np.pi + FULL_CIRCLE_TOLERANCE:
        raise ValueError(
            "angle_max must exceed angle_min by at most a full circle, in radians"
        )
    if max(-angle_min, angle_max) > 2.0 * np.pi + FULL_CIRCLE_TOLERANCE:
        raise ValueError("angle_min and angle_max must lie within -2 pi and 2 pi")


class WithoutSensorModel(Schema):
    """A schema that accepts an empty `sensor_model`, which an earlier version wrote."""

    @model_validator(mode="before")
    @classmethod
    def _drop_sensor_model(cls, data: Any) -> Any:
        if not isinstance(data, dict) or "sensor_model" not in data:
            return data
        if data["sensor_model"]:
            raise ValueError(
                "sensor models are no longer supported; remove the key sensor_model"
            )
        return {key: value for key, value in data.items() if key != "sensor_model"}


class LidarSpec(WithoutSensorModel):
    """A planar lidar. Beam 0 points at `angle_min`, the others follow counter-clockwise.

    If the limits span a full circle, the last beam is one increment short of it.
    """

    name: str = "lidar"  # used in messages and reports
    beams: int = Field(ge=1, le=100_000)  # B
    angle_min: float  # angle of the first beam, in the frame of the lidar [rad]
    angle_max: float  # angle of the last beam, or of the end of the circle [rad]
    range_min: float = Field(ge=0.0)  # nearer returns are reported as `-inf` [m]
    # farther returns are reported as `inf` [m]
    range_max: float = Field(ge=1e-3, le=LARGEST)
    rate: float = Field(ge=1e-3, le=1e5)  # scans per second [Hz]
    mount: Mount = (0.0, 0.0, 0.0)  # pose of `laser` in `base_link`
    noise_std: float = Field(default=0.0, ge=0.0, le=LARGEST)  # noise of a range [m]
    frame: str = Field(default="laser", min_length=1)  # id of the lidar's own frame
    no_return: NoReturn = (
        "inf"  # the device's value for no return; the package uses `inf`
    )
    faults: LidarFaults = LidarFaults()  # other faults of the device's ranges

    @model_validator(mode="after")
    def _check_consistent(self) -> "LidarSpec":
        if not self.range_min < self.range_max:
            raise ValueError("range_min must be less than range_max")
        check_angles(self.angle_min, self.angle_max)
        if self.faults.quantisation > self.range_max - self.range_min:
            raise ValueError(
                "faults.quantisation must be less than range_max - range_min"
            )
        if self.no_return == "zero" and self.range_min == 0.0:
            raise ValueError("range_min must be greater than 0 if no_return is zero")
        return self

    @property
    def full_circle(self) -> bool:
        """True if the beams cover a full circle."""
        return self.angle_max - self.angle_min > 2.0 * np.pi - FULL_CIRCLE_TOLERANCE

    @property
    def angle_increment(self) -> float:
        """Angle between neighbouring beams [rad]."""
        gaps = self.beams
        if not self.full_circle:
            gaps = max(self.beams - 1, 1)
        return (self.angle_max - self.angle_min) / gaps

    @cached_property
    def angles(self) -> Array:
        """(B,) direction of each beam in the frame of the lidar [rad]."""
        return np.asarray(self.angle_min + self.angle_increment * np.arange(self.beams))

    @cached_property
    def directions(self) -> Array:
        """(B, 2) cosine and sine of each beam's direction."""
        return np.stack([np.cos(self.angles), np.sin(self.angles)], axis=1)

    @property
    def scan_time(self) -> float:
        """Time from one scan to the next [s]."""
        return 1.0 / self.rate

    @property
    def beam_time(self) -> float:
        """Time between neighbouring beams of a device that turns once per scan [s]."""
        return self.scan_time * self.angle_increment / (2.0 * np.pi)

    @property
    def sweep_time(self) -> float:
        """Duration of all beams of a device that turns once per scan [s]."""
        return self.beam_time * self.beams

    @cached_property
    def header(self) -> ScanHeader:
        """The fields of a LaserScan except stamp, frame and ranges."""
        return ScanHeader(
            angle_min=float(self.angles[0]),
            angle_max=float(self.angles[-1]),
            angle_increment=self.angle_increment,
            scan_time=self.scan_time,
            time_increment=self.beam_time * SKEW[self.faults.skew],
            range_min=self.range_min,
            range_max=self.range_max,
        )

    @property
    def fault_parameters(self) -> Array:
        """The faults of this lidar as the kernels' row (P,)."""
        return self.faults.parameters(self.noise_std)


def load_lidar(name: str | Path) -> LidarSpec:
    """Load a shipped lidar by name (`paper`), or any other by the path of its YAML file."""
    return load_yaml(find_config(name, "lidars"), LidarSpec)


Ranges = Singles


def to_device(ranges: ArrayLike, spec: LidarSpec) -> Ranges:
    """Convert ranges (..., B) to the device's convention; only `inf` is replaced."""
    out = np.array(ranges, np.float32)
    if spec.no_return != "inf":
        out[out == np.inf] = _get_no_return(spec)
    return out


def from_device(values: ArrayLike, spec: LidarSpec) -> Ranges:
    """Convert ranges (..., B) of a device to those of the package.

    A finite value below range_min means too close, unless it is the value for no
    return.
    """
    out = np.array(values, np.float32)
    if spec.no_return != "inf":
        no_return = _get_no_return(spec)
        if np.isnan(no_return):
            out[np.isnan(out)] = np.inf
        else:
            out[out == no_return] = np.inf
    out[out > np.float32(spec.range_max)] = np.inf
    out[out < np.float32(spec.range_min)] = -np.inf
    return out


def _get_no_return(spec: LidarSpec) -> np.float32:
    return np.float32(
        {"zero": 0.0, "nan": np.nan, "range_max": spec.range_max}[spec.no_return]
    )
