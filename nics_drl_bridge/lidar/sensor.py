"""Sensor: base class of sensors besides the lidar. A kind of sensor is one class in one file.

The simulator renders its readings, the nodes publish and read its messages, the
middleware caches them by name, views contain them in `sensed`, tasks observe `shares`,
and the gate avoids `points`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field, PlainSerializer, PlainValidator

from nics_drl_bridge import extensions
from nics_drl_bridge.config import Schema, parse_yaml, read_text, validate
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.arrays import Array, Integers, Singles
from nics_drl_bridge.lidar.map_kernels import Fixtures
from nics_drl_bridge.lidar.scanner import Renderer
from nics_drl_bridge.lidar.shapes import Shape

Readings = Singles
# Topics of a robot that sensors may not use.
TAKEN = ("scan", "odom", "pose", "imu", "joint_states", "ground_truth", "cmd_vel")


@dataclass(frozen=True)
class SensedWorlds:
    """Everything that a sensor can see in N worlds of M robots and K other bodies.

    `state` is updated in place. It has the true `pose` (N, M, 3) of `base_link` in
    `map`, the `bodies` (N, K + M, 7) as in `lidar.exact_kernels`, robots last, and
    `seeds` and `steps` (N,) of the episodes.
    """

    state: Any
    shapes: tuple[Shape, ...]  # shapes of the bodies, indexed by their column `SHAPE`
    first: int  # K, the body of robot 0
    fixtures: Fixtures  # walls and static map of each world
    renderer: Renderer  # of the lidar


# Writes the readings (N, M, S) of all robots of some worlds (n,) in place.
Render = Callable[[Readings, Integers], None]


class Sensor(Schema, ABC):
    """A sensor of a robot in addition to its lidar.

    A subclass is found by its `kind`: the name of an entry point in
    `nics_drl_bridge.sensors`, or of a class imported by `add_sensor_kind`. A reading is
    S float32 numbers; NaN means unknown.
    """

    # message type, such as sensor_msgs/msg/LaserScan; it must have a header
    message: ClassVar[str]

    kind: str
    # also the name of its topic in the robot's namespace
    name: str = Field(pattern="^[a-z][a-z0-9_]*$")

    @property
    @abstractmethod
    def size(self) -> int:
        """S, the number of values of a reading."""

    @property
    def parts(self) -> int:
        """P, the number of `shares`."""
        return self.size

    @property
    def frame(self) -> str:
        """Id of the sensor's own frame."""
        return self.name

    @property
    @abstractmethod
    def mount(self) -> tuple[float, float, float]:
        """X [m], y [m], heading [rad] of the sensor in `base_link`."""

    @abstractmethod
    def renderer(self, around: SensedWorlds) -> Render:
        """Return a renderer; equal seeds and steps must give equal bits in any batch."""

    @abstractmethod
    def write(self, message: Any, reading: Readings) -> None:
        """Fill a message with a reading (S,); its header is already set."""

    @abstractmethod
    def read(self, message: Any) -> Readings:
        """Return the reading (S,) of a message. Raises ValueError for another sensor's."""

    @abstractmethod
    def shares(self, readings: Readings) -> Readings:
        """Convert readings (..., S) to parts of an observation (..., P), in [0, 1]."""

    def points(self, reading: Readings) -> Array:
        """Return points (Q, 2) in `base_link` that a reading (S,) shows [m]; by default none."""
        return np.zeros((0, 2))


CODE_IN_DATA = (
    "names a file of code, which a data file must not do; import it with "
    "`nics --sensor-kind path/to/file.py:ClassName ...` or `add_sensor_kind` in Python, and write "
    "`kind: ClassName` instead."
)


def add_sensor_kind(place: str) -> type[Sensor]:
    """Import a kind of sensor from `path/to/file.py:ClassName`; files then name it `ClassName`.

    This runs the file. Pass only your own paths, never a path from a data file.
    """
    return extensions.import_class("sensors", place, Sensor)


def sensor_of_data(entries: Sensor | Mapping[str, Any]) -> Sensor:
    """Return a sensor from a file's entries, which name a known kind and never code.

    Raises ConfigError if they describe no sensor.
    """
    if isinstance(entries, Sensor):
        return entries
    if not isinstance(entries, Mapping) or "kind" not in entries:
        raise ConfigError("a sensor needs a 'kind' and a 'name'.")
    kind = str(entries["kind"])
    if ":" in kind:
        raise ConfigError(f"sensor kind {kind!r}: {CODE_IN_DATA}")
    sensor_class = extensions.load("sensors", kind)
    if not (isinstance(sensor_class, type) and issubclass(sensor_class, Sensor)):
        raise ConfigError(
            f"sensor kind {kind!r}: is not a subclass of lidar.sensor.Sensor."
        )
    return validate(dict(entries), sensor_class, f"sensor {entries.get('name')!r}")


def load_sensor(file: Path) -> Sensor:
    """Read a sensor from a YAML file. Raises ConfigError if it is wrong."""
    content = parse_yaml(read_text(file), str(file))  # its errors name the file
    try:
        return sensor_of_data(content)
    except ConfigError as error:
        raise ConfigError(f"{file}: {error}") from None


def unread(sensors: Sequence[Sensor], *lead: int) -> dict[str, Readings]:
    """Return unknown readings (*lead, S) by the sensors' names."""
    return {
        sensor.name: np.full((*lead, sensor.size), np.nan, np.float32)
        for sensor in sensors
    }


def check_sensors(sensors: tuple[Sensor, ...], frames: tuple[str, ...]) -> None:
    """Raise ConfigError if sensors collide with each other or the robot's topics or frames."""
    names = list(TAKEN)
    used = list(frames)
    for sensor in sensors:
        if sensor.name in names or sensor.frame in used:
            raise ConfigError(
                f"sensor {sensor.name!r} with frame {sensor.frame!r}: the name or "
                "frame is already in use; choose another."
            )
        names.append(sensor.name)
        used.append(sensor.frame)


def _validate(entries: Any) -> Sensor:
    try:
        return sensor_of_data(entries)
    except ConfigError as error:
        raise ValueError(str(error)) from None


_dumped = PlainSerializer(
    lambda sensor: sensor.model_dump(mode="json"), return_type=dict
)
# a field of a schema
AnySensor = Annotated[Sensor, PlainValidator(_validate), _dumped]
