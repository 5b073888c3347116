"""Units that recordings come in, and what each is in SI."""

import math
from typing import NamedTuple

from nics_drl_bridge.errors import nearest

TURN = 2.0 * math.pi


class UnitOfData(NamedTuple):
    """A unit: SI value = factor x value; `ticks` become radians once a turn's ticks are known."""

    si: str  # unit in SI; 1 for shares and counts
    factor: float


def _each(si: str, **factors: float) -> dict[str, UnitOfData]:
    return {name.replace("_per_", "/"): UnitOfData(si, factor) for name, factor in factors.items()}


UNITS = {
    **_each("m", m=1.0, cm=1e-2, mm=1e-3, um=1e-6, km=1e3, ft=0.3048),
    "in": UnitOfData("m", 0.0254),
    **_each("rad", rad=1.0, mrad=1e-3, deg=TURN / 360.0, rev=TURN),
    **_each("s", s=1.0, ms=1e-3, us=1e-6, ns=1e-9, min=60.0),
    **_each("m/s", m_per_s=1.0, cm_per_s=1e-2, mm_per_s=1e-3, mph=0.44704, knots=1852.0 / 3600.0),
    **_each("m/s", km_per_h=1.0 / 3.6, kmh=1.0 / 3.6, kph=1.0 / 3.6, ft_per_s=0.3048),
    **_each("rad/s", rad_per_s=1.0, deg_per_s=TURN / 360.0, rpm=TURN / 60.0, rev_per_s=TURN),
    **_each("rad/s", mrad_per_s=1e-3),
    "m/s^2": UnitOfData("m/s^2", 1.0),
    "cm/s^2": UnitOfData("m/s^2", 1e-2),
    "mm/s^2": UnitOfData("m/s^2", 1e-3),
    "g": UnitOfData("m/s^2", 9.80665),
    "mg": UnitOfData("m/s^2", 9.80665e-3),
    **_each("V", V=1.0, mV=1e-3),
    **_each("A", A=1.0, mA=1e-3),
    **_each("N", N=1.0),
    "N*m": UnitOfData("N*m", 1.0),
    "1": UnitOfData("1", 1.0),
    "share": UnitOfData("1", 1.0),
    "%": UnitOfData("1", 1e-2),
    "ticks": UnitOfData("ticks", 1.0),
    "ticks/s": UnitOfData("ticks/s", 1.0),
}
SHARES = ("share", "%", "1")
TICKS = {"ticks": "rad", "ticks/s": "rad/s"}
RATES = {"m": "m/s", "rad": "rad/s", "ticks": "ticks/s", "m/s": "m/s^2", "rad/s": "rad/s^2"}


def known_unit(name: str) -> str:
    """Returns the name of a unit; ValueError tells the nearest known one."""
    if name not in UNITS:
        raise ValueError(f"is no known unit ({nearest(name, UNITS)})")
    return name


def to_si(unit: str, ticks_per_turn: float | None = None) -> UnitOfData:
    """Returns the SI unit and the factor of a unit; ticks are angles if their count is known."""
    found = UNITS[unit]
    if found.si in TICKS and ticks_per_turn:
        return UnitOfData(TICKS[found.si], TURN / ticks_per_turn)
    return found
