"""The drives of others that are measured, by which mapping they go in, and their bars."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench import ROOT, at_least, at_most, missed_bars

EXAMPLES = ROOT / "examples" / "recordings"
SHIPPED = ROOT / "config" / "recordings"
RECORDINGS = ROOT.parent / "shared" / "recordings"
MOST_LINES = 25  # of a mapping, without comments
COVERAGE = (0.9, 0.99)  # of the 95 % band

LEAGUE = {
    "shuffled_ratio": at_least(
        1.2, "times the textbook's error under shuffled commands"
    )
}


@dataclass(frozen=True)
class Bars:
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
    bars: Bars = field(default_factory=Bars)


def camera(number: str) -> RealDrive:
    """Returns a drive of the robot with ticks."""
    source = f"differential_ticks/Camera_Odo_Data_{number}.txt"
    bars = Bars(share=0.05, of_yardstick=None)
    return RealDrive(source, EXAMPLES / "differential_ticks.yaml", bars)


DRIVES = {
    "xtark_random_drive_45s": RealDrive(
        "xtark_ackermann/random_drive_45s",
        SHIPPED / "xtark_folder.yaml",
        Bars(error_m=0.0215),
    ),
    "jetracer_free_driving_104s": RealDrive(
        "jetracer_dart/free_driving_104s.csv",
        EXAMPLES / "jetracer_csv.yaml",
        Bars(0.14, 0.8),
    ),
    "jetracer_random_driving_slow_63s": RealDrive(
        "jetracer_dart/random_driving_slow_63s.bag",
        EXAMPLES / "jetracer_bag.yaml",
        Bars(of_yardstick=0.8),
    ),
    "f110_ds1": RealDrive(
        "f110_frictionmaps/DS1",
        EXAMPLES / "f110_folder.yaml",
        Bars(of_yardstick=None, may_refuse=True),
    ),
    "f110_ds3": RealDrive("f110_frictionmaps/DS3", EXAMPLES / "f110_folder.yaml"),
    "f110_ds4": RealDrive("f110_frictionmaps/DS4", EXAMPLES / "f110_folder.yaml"),
    "ticks_01": camera("01"),
    "ticks_02": camera("02"),
}
SEGMENTED, SEGMENT_S, SEGMENT_ERROR_M = "xtark_random_drive_45s", 11.0, 0.026
"""Of one drive each segment is left out in turn; bar of the mean error on them."""
OWN = Bars(share=0.03, of_yardstick=None)
OWN_BARS = {"tricycle": Bars(share=0.02, of_yardstick=None)}  # by the automatic order


def judge_drives(result: Mapping[str, Any]) -> list[str]:
    """Returns a sentence for each bar that is missed."""
    missed = []
    for name, told in result["drives"].items():
        missed += judge_drive(name, told, DRIVES[name].bars)
        lines = {"lines_of_mapping": at_most(MOST_LINES)}
        missed += missed_bars(told, lines, f"{name}: ")
    for name, told in result["left_out"].items():
        left_out = {"error_m": at_most(SEGMENT_ERROR_M)}
        missed += missed_bars(told, left_out, f"{name}, segments left out: ")
    for name, told in result["own_robots"].items():
        missed += judge_drive(name, told, OWN_BARS.get(name, OWN))
    return missed


def judge_drive(name: str, told: Mapping[str, Any], limits: Bars) -> list[str]:
    """Returns a sentence for each bar that one drive misses."""
    if "crashed" in told:
        return [f"{name}: crashed: {told['crashed']}"]
    if "refused" in told:
        return [] if limits.may_refuse else [f"{name}: was refused: {told['refused']}"]
    shares = [told["constant_twist_share"]]
    if limits.share is not None:
        shares.append(limits.share)
    if limits.of_yardstick is not None:
        shares.append(limits.of_yardstick * told["yardstick_share"])
    bars = {"share_of_path": at_most(min(shares))}
    if limits.error_m is not None:
        bars["error_m"] = at_most(limits.error_m)
    missed = missed_bars(told, bars, f"{name}: ")
    if "league" in told:
        missed += missed_bars(told["league"], LEAGUE, f"{name}: ")
    low, high = COVERAGE
    if not low <= told["coverage_95"] <= high:
        missed.append(
            f"{name}: the 95 % band holds {told['coverage_95']:.1%} of the ends, "
            f"bar {low:.0%} to {high:.0%}"
        )
    return missed
