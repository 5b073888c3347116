"""The drives of others that are measured, by which mapping they go in, and their bars."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench import ROOT, Bar, Bars, Silence, at_least, at_most

from nics_drl_bridge.identify.hypotheses import BANDS_S

EXAMPLES = ROOT / "examples" / "recordings"
SHIPPED = ROOT / "config" / "recordings"
RECORDINGS = ROOT.parent / "shared" / "recordings"
COVERAGE = Bar(0.9, 0.99, "share of the ends in the 95 % band")

LEAGUE = {
    "shuffled_ratio": at_least(
        1.2, "times the textbook's error under shuffled commands"
    )
}


@dataclass(frozen=True)
class Limits:
    """Greatest errors after 5 s; None where there is no bar."""

    share: float | None = None  # of the path
    of_yardstick: float | None = 1.0  # share of the fitted textbook's error
    error_m: float | None = None
    may_refuse: bool = False  # in one sentence


@dataclass(frozen=True)
class RealDrive:
    """A drive, relative to the folder of the recordings."""

    source: str
    mapping: Path
    limits: Limits = field(default_factory=Limits)


def camera(number: str) -> RealDrive:
    """Returns a drive of the robot with ticks."""
    source = f"differential_ticks/Camera_Odo_Data_{number}.txt"
    limits = Limits(share=0.05, of_yardstick=None)
    return RealDrive(source, EXAMPLES / "differential_ticks.yaml", limits)


DRIVES = {
    "xtark_random_drive_45s": RealDrive(
        "xtark_ackermann/random_drive_45s",
        SHIPPED / "xtark_folder.yaml",
        Limits(error_m=0.0215),
    ),
    "jetracer_free_driving_104s": RealDrive(
        "jetracer_dart/free_driving_104s.csv",
        EXAMPLES / "jetracer_csv.yaml",
        Limits(0.14, 0.8),
    ),
    "jetracer_random_driving_slow_63s": RealDrive(
        "jetracer_dart/random_driving_slow_63s.bag",
        EXAMPLES / "jetracer_bag.yaml",
        Limits(of_yardstick=0.8),
    ),
    "f110_ds1": RealDrive(
        "f110_frictionmaps/DS1",
        EXAMPLES / "f110_folder.yaml",
        Limits(of_yardstick=None, may_refuse=True),
    ),
    "f110_ds3": RealDrive("f110_frictionmaps/DS3", EXAMPLES / "f110_folder.yaml"),
    "f110_ds4": RealDrive("f110_frictionmaps/DS4", EXAMPLES / "f110_folder.yaml"),
    "ticks_01": camera("01"),
    "ticks_02": camera("02"),
}
SEGMENTED, SEGMENT_S, SEGMENT_ERROR_M = "xtark_random_drive_45s", 11.0, 0.026
"""Of one drive each segment is left out in turn; bar of the mean error on them."""
OWN_SHARES = {
    "skid_steer": 0.01,
    "throttle_car": 0.01,
    "tricycle": 0.015,
    "slewed_tricycle": 0.015,
    "omni": 0.005,
    "ticks": 0.002,
}
"""Greatest errors of own robots, as shares of the path."""


def set_drive_bars(result: Mapping[str, Any]) -> Bars:
    """Returns the bars of all drives."""
    real = {
        name: set_bars(told, DRIVES[name].limits)
        for name, told in result["drives"].items()
    }
    own = {
        name: set_bars(told, Limits(OWN_SHARES[name]))
        for name, told in result["own_robots"].items()
    }
    left_out = {"error_m": at_most(SEGMENT_ERROR_M)}
    return {
        "drives": real,
        "left_out": dict.fromkeys(result["left_out"], left_out),
        "own_robots": own,
        # the windows of one drive overlap, so that its coverage says little
        "together": {f"coverage_{horizon:g}": COVERAGE for horizon in BANDS_S},
    }


def set_bars(told: Mapping[str, Any], limits: Limits) -> dict[str, Any]:
    """Returns the bars of one drive."""
    for end in ("crashed", "refused"):
        if end in told:
            may_end_so = end == "refused" and limits.may_refuse
            return {} if may_end_so else {end: Silence()}
    shares = [told["constant_twist_share"]]
    if limits.share is not None:
        shares.append(limits.share)
    if limits.of_yardstick is not None:
        shares.append(limits.of_yardstick * told["yardstick_share"])
    bars: dict[str, Any] = {"share_of_path": at_most(min(shares))}
    if limits.error_m is not None:
        bars["error_m"] = at_most(limits.error_m)
    if "league" in told:
        bars["league"] = LEAGUE
    return bars
