"""An additional lidar of a robot, as a `Sensor`."""

import array
from typing import Any, Literal
from zlib import crc32

import numpy as np

from nics_drl_bridge.lidar import fault_kernels, scan_kernels
from nics_drl_bridge.lidar.arrays import Array, Integers
from nics_drl_bridge.lidar.scanner import make_scanner
from nics_drl_bridge.lidar.sensor import Readings, Render, SensedWorlds, Sensor
from nics_drl_bridge.lidar.spec import LidarSpec, from_device, to_device

# maximum deviation of the last beam from the declared angle [rad]
ANGLE_TOLERANCE = 1e-3


class FurtherLidar(Sensor):
    """A planar lidar, read at the end of a control period: a scan (B,) [m], REP-117."""

    message = "sensor_msgs/msg/LaserScan"

    kind: Literal["lidar"] = "lidar"
    lidar: LidarSpec

    @property
    def size(self) -> int:
        """B."""
        return self.lidar.beams

    @property
    def frame(self) -> str:
        """Id of the lidar's own frame."""
        return self.lidar.frame

    @property
    def mount(self) -> tuple[float, float, float]:
        """X [m], y [m], heading [rad] in `base_link`."""
        return self.lidar.mount

    def renderer(self, around: SensedWorlds) -> Render:
        """Return a renderer of bodies, walls and map, with the faults of this lidar."""
        scanner = make_scanner(self.lidar, around.shapes, around.renderer)
        state = around.state
        lidar = scanner.arguments
        salt = crc32(self.name.encode())
        limits = self.lidar.range_min, self.lidar.range_max
        faults = self.lidar.fault_parameters

        def render(out: Readings, worlds: Integers) -> None:
            scratch = scan_kernels.scan_scratch(self.size)
            scan_kernels.scan_worlds(
                out,
                state.pose,
                worlds,
                state.bodies,
                np.arange(state.bodies.shape[1], dtype=np.int32),
                around.first,
                around.fixtures,
                lidar,
                scratch,
            )
            seeds = state.seeds ^ salt
            fault_kernels.distort_worlds(
                out, worlds, limits, faults, seeds, state.steps
            )

        return render

    def write(self, message: Any, reading: Readings) -> None:
        """Fill a LaserScan as the device would."""
        for field, value in self.lidar.header._asdict().items():
            setattr(message, field, value)
        message.ranges = array.array("f", to_device(reading, self.lidar).tobytes())

    def read(self, message: Any) -> Readings:
        """Return the scan (B,) of a LaserScan."""
        header = self.lidar.header
        beams = self.lidar.beams
        off = abs(message.angle_min - header.angle_min)
        off += abs(message.angle_increment - header.angle_increment) * (beams - 1)
        if len(message.ranges) != beams or not off <= ANGLE_TOLERANCE:
            raise ValueError(f"is from another lidar, with {len(message.ranges)} beams")
        return from_device(message.ranges, self.lidar)

    def shares(self, readings: Readings) -> Readings:
        """Ranges as fractions of the maximum: 1 free, 0 too close or unknown."""
        ranges = np.nan_to_num(readings, nan=0.0, posinf=np.inf, neginf=0.0)
        shares: Readings = np.clip(ranges / np.float32(self.lidar.range_max), 0.0, 1.0)
        return shares.astype(np.float32)

    def points(self, reading: Readings) -> Array:
        """Ends (Q, 2) of the beams that hit something; too close counts as range_min."""
        x, y, heading = self.mount
        near = np.where(
            np.isneginf(reading), self.lidar.range_min, reading.astype(np.float64)
        )
        hit = np.isfinite(near)
        angles = self.lidar.angles[hit] + heading
        ranges = near[hit]
        return np.stack(
            [x + ranges * np.cos(angles), y + ranges * np.sin(angles)], axis=1
        )
