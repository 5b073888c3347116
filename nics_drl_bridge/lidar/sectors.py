"""The canonical scan: sectors around the robot, independent of the lidar.

A policy learns on the sectors of one `ScanLayout`, into which any lidar's scan is resampled.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from pydantic import Field, model_validator

from nics_drl_bridge.config import Schema, validate
from nics_drl_bridge.errors import ConfigError, suggest
from nics_drl_bridge.geometry import wrap_angle
from nics_drl_bridge.lidar.arrays import Array, Singles
from nics_drl_bridge.lidar.sector_kernels import SectorPlan
from nics_drl_bridge.lidar.shapes import LARGEST, Place
from nics_drl_bridge.lidar.spec import (
    FULL_CIRCLE_TOLERANCE,
    LidarSpec,
    ScanHeader,
    check_angles,
)

Ranges = Singles
# Beams farther apart are rejected: at 1 m they miss objects 0.2 m wide
COARSEST_RAD = 0.21
# A beam this close to a border counts in both sectors, because headers have float32
# angles
BORDER_RAD = 1e-4
# fraction by which a lidar's range may be below the layout's, because of float32
RANGE_TOLERANCE = 1e-5


class ScanLayout(Schema):
    """The scan that a policy observes: the nearest return in each sector, from a viewpoint."""

    sectors: int = Field(ge=4, le=1440)  # S
    # start of the first sector in `base_link`; sectors follow counter-clockwise [rad]
    angle_min: float = -np.pi
    angle_max: float = np.pi  # end of the last sector [rad]
    range_max: float = Field(ge=1e-3, le=LARGEST)  # farther returns count as none [m]
    viewpoint: tuple[Place, Place] = (0.0, 0.0)  # x, y in `base_link` [m]

    @model_validator(mode="after")
    def _check_consistent(self) -> "ScanLayout":
        check_angles(self.angle_min, self.angle_max)
        return self

    @property
    def width(self) -> float:
        """Width of a sector [rad]."""
        return (self.angle_max - self.angle_min) / self.sectors

    @cached_property
    def angles(self) -> Array:
        """(S,) middle of each sector in `base_link` [rad]."""
        return np.asarray(self.angle_min + self.width * (np.arange(self.sectors) + 0.5))


LAYOUTS = {  # the full circle, and the 270 deg that most front-mounted lidars cover
    "around": ScanLayout(sectors=72, range_max=3.0),
    "front": ScanLayout(
        sectors=54, angle_min=-0.75 * np.pi, angle_max=0.75 * np.pi, range_max=3.0
    ),
}


def layout_of(setting: Any, lidar: LidarSpec) -> ScanLayout | None:
    """Return the layout for a user's setting. Raises ConfigError if it is invalid.

    It may be None, a ScanLayout or its fields, a name in `LAYOUTS`, or a number of
    sectors over the view.
    """
    if setting is None or isinstance(setting, ScanLayout):
        return setting
    option = f"task option scan={setting!r}"
    if isinstance(setting, str):
        if setting not in LAYOUTS:
            raise ConfigError(f"{option}: no such layout; {suggest(setting, LAYOUTS)}")
        return LAYOUTS[setting]
    if isinstance(setting, int | np.integer) and not isinstance(setting, bool):
        x, y, heading = lidar.mount
        middle = 0.5 * (lidar.angle_min + lidar.angle_max)
        begin = lidar.angle_min + float(wrap_angle(middle + heading)) - middle
        span = lidar.angle_max - lidar.angle_min
        fields = {
            "angle_min": begin,
            "angle_max": begin + span,
            "range_max": lidar.range_max,
        }
        setting = {"sectors": int(setting), "viewpoint": (x, y), **fields}
    if not isinstance(setting, Mapping):
        names = ", ".join(map(repr, LAYOUTS))
        raise ConfigError(
            f"{option}: must be a number of sectors, a mapping, or one of {names}."
        )
    return validate(dict(setting), ScanLayout, "task option scan")


def count_sectors(lidar: LidarSpec) -> int:
    """Number of sectors over a lidar's view, with the width of those in `LAYOUTS`."""
    return max(4, round((lidar.angle_max - lidar.angle_min) / LAYOUTS["around"].width))


def covers(lidar: LidarSpec, layout: str) -> bool:
    """True if a lidar can fill a layout of `LAYOUTS`."""
    try:
        make_sector_plan(lidar, LAYOUTS[layout])
    except ConfigError:
        return False
    return True


NO_PLAN = SectorPlan(  # for policies that observe the beams themselves
    np.zeros(0, np.int32),
    np.zeros(0, np.int32),
    np.zeros((0, 2)),
    np.zeros(2),
    angle_min=0.0,
    width=0.0,
    range_min=0.0,
    range_max=0.0,
    closed=False,
)


def make_sector_plan(lidar: LidarSpec, layout: ScanLayout) -> SectorPlan:
    """Return the plan for a lidar and a layout; ConfigError if the lidar can't fill it."""
    x, y, heading = lidar.mount
    angles = lidar.angles + heading
    _check(lidar, layout, angles)
    first, count = np.zeros((2, layout.sectors), np.int32)
    for s, middle in enumerate(layout.angles):
        away = wrap_angle(angles - middle)
        first[s], count[s] = _find_beams(away, 0.5 * layout.width)
    left_open = 2.0 * np.pi - (lidar.angles[-1] - lidar.angles[0])
    closed = left_open <= max(COARSEST_RAD, lidar.angle_increment)
    return SectorPlan(
        first,
        count,
        np.stack([np.cos(angles), np.sin(angles)], axis=1),
        np.array([x - layout.viewpoint[0], y - layout.viewpoint[1]]),
        float(layout.angle_min),
        float(layout.width),
        float(lidar.range_min),
        float(lidar.range_max),
        bool(closed),
    )


def _find_beams(away: Array, half_width: float) -> tuple[int, int]:
    """Return the first beam and the number of beams in a sector.

    `away` (B,) are their angles from its middle [rad]. If no beam is in it, those beside it count.
    """
    inside = np.abs(away) <= half_width + BORDER_RAD
    if inside.any():
        begins = np.flatnonzero(inside & ~np.roll(inside, 1))
        return int(begins[0]) if len(begins) > 0 else 0, int(inside.sum())
    below = int(np.argmax(np.where(away < 0.0, away, -np.inf)))
    above = int(np.argmin(np.where(away >= 0.0, away, np.inf)))
    beside = [b for b in (below, above) if abs(away[b]) <= COARSEST_RAD]
    return beside[0], len(beside)


def _check(lidar: LidarSpec, layout: ScanLayout, angles: Array) -> None:
    apart = lidar.angle_increment if lidar.beams > 1 else np.inf
    if apart > COARSEST_RAD:
        step, most = np.degrees([apart, COARSEST_RAD])
        seen = f"the beams of the lidar {lidar.name!r} are {step:.3g} deg apart"
        reason = f"{seen}, a scan layout needs at most {most:.3g}"
        raise ConfigError(f"{reason}; use a finer lidar.", reason=reason)
    if lidar.range_max < layout.range_max * (1.0 - RANGE_TOLERANCE):
        seen = f"range_max of the lidar {lidar.name!r} is {lidar.range_max:g} m"
        reason = f"{seen}, the scan layout needs {layout.range_max:g} m"
        raise ConfigError(f"{reason}; {_narrower(lidar, layout)}.", reason=reason)
    if _find_widest_gap(angles, layout, apart) > apart + BORDER_RAD:
        limits = np.degrees([angles[0], angles[-1], layout.angle_min, layout.angle_max])
        a, b, c, d = (f"{limit:.4g}" for limit in limits)
        seen = f"the lidar {lidar.name!r} looks from {a} to {b} deg in base_link"
        reason = f"{seen}, the scan layout needs {c} to {d}"
        raise ConfigError(f"{reason}; {_narrower(lidar, layout)}.", reason=reason)


def _find_widest_gap(angles: Array, layout: ScanLayout, apart: float) -> float:
    """Return how far the nearest beam is away from any direction in a layout [rad]."""
    steps = int(np.ceil((layout.angle_max - layout.angle_min) / apart))
    count = max(layout.sectors, steps) + 1
    wanted = np.linspace(layout.angle_min, layout.angle_max, count) % (2.0 * np.pi)
    ordered = np.sort(angles % (2.0 * np.pi))
    ordered = np.concatenate(
        [ordered[-1:] - 2.0 * np.pi, ordered, ordered[:1] + 2.0 * np.pi]
    )
    after = np.searchsorted(ordered, wanted).clip(1, len(ordered) - 1)
    gaps = np.minimum(wanted - ordered[after - 1], ordered[after] - wanted)
    return float(gaps.max())


def _narrower(lidar: LidarSpec, layout: ScanLayout) -> str:
    if layout.model_dump() == LAYOUTS["around"].model_dump() and covers(lidar, "front"):
        return "say `scan: front`, its 270 deg"
    return f"use a lidar that sees farther or wider, or train with `scan: {count_sectors(lidar)}`"


@dataclass(frozen=True)
class Reader:
    """Converts the ranges of a device to the beam order of a LidarSpec."""

    lidar: LidarSpec  # the device
    backwards: bool  # True if its beams are in clockwise order

    def ordered(self, values: Ranges) -> Ranges:
        """Return ranges (..., B) in counter-clockwise order."""
        if self.backwards:
            return values[..., ::-1]
        return values


def make_reader(
    header: ScanHeader, beams: int, like: LidarSpec, upside_down: bool = False
) -> Reader:
    """Return the reader for scans of B beams with the header of a LaserScan.

    A negative `angle_increment` means clockwise beams, and so does `upside_down`.
    Mount, frame and value for no return are those of `like`. Raises ConfigError if the
    header describes no lidar.
    """
    begin = header.angle_min
    step = header.angle_increment
    if upside_down:
        begin = -begin
        step = -step
    if not (np.isfinite([begin, step]).all() and step != 0.0 and beams > 1):
        angles = f"angle_min {header.angle_min:g}, angle_increment {header.angle_increment:g}"
        raise ConfigError(
            f"LaserScan of {beams} beams, {angles}: describes no valid lidar; fix the "
            "driver's parameters."
        )
    backwards = step < 0.0
    if backwards:
        begin += step * (beams - 1)
        step = -step
    turn = 2.0 * np.pi
    if begin < -turn or begin + step * (beams - 1) > turn:
        begin = -(-begin % turn)
    span = step * (beams - 1)
    if abs(span + step - turn) < 0.1 * step:
        span = turn  # the beam after the last would be the first again
    elif turn - FULL_CIRCLE_TOLERANCE < span < turn + 0.1 * step:
        span = turn - 2.0 * FULL_CIRCLE_TOLERANCE  # first and last beam coincide
    fields = like.model_dump() | {
        "name": "scan",
        "beams": beams,
        "angle_min": begin,
        "angle_max": begin + span,
        "range_min": header.range_min,
        "range_max": header.range_max,
    }
    return Reader(validate(fields, LidarSpec, "LaserScan"), backwards)


def match_reader(
    header: ScanHeader, beams: int, like: LidarSpec, upside_down: bool = False
) -> Reader:
    """Like `make_reader`, but returns exactly the expected lidar if the header agrees with it."""
    reader = make_reader(header, beams, like, upside_down)
    limits = np.array([reader.lidar.range_min, reader.lidar.range_max])
    near = np.allclose(limits, [like.range_min, like.range_max], rtol=1e-4, atol=1e-4)
    same = near and reader.lidar.beams == like.beams
    if not same:
        return reader
    turned = reader.lidar.angles - like.angles
    # the beams may be the same, shifted by full turns
    whole = 2.0 * np.pi * np.round(turned[0] / (2.0 * np.pi))
    if np.abs(turned - whole).max() < 0.1 * like.angle_increment:
        return Reader(like, reader.backwards)
    return reader
