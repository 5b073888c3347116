"""The drives of others that are measured, their mappings and bars, and what is true of robots."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from bench import at_most, missed_bars

from nics_drl_bridge import geometry
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.identify import Identified
from nics_drl_bridge.robot.kernels import SERIES, make_terms, simulate_rollouts
from nics_drl_bridge.robot.taylor import TaylorModel

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples" / "recordings"
SHIPPED = ROOT / "config" / "recordings"
RECORDINGS = ROOT.parent / "shared" / "recordings"
MOST_LINES = 25  # of a mapping, without comments
COVERAGE = (0.9, 0.99)  # of the 95 % band
STANDARD_ERRORS = 3.0  # by how many a mounting may be off
# absolute; shares of the true value
LATENCY_S = 0.005
DEAD_ZONE = 0.1
WHEEL = 0.02
SETTLED_S = 8.0  # until a model has settled
SLOW = 2.0  # a wheel speed [rad/s]


@dataclass(frozen=True)
class Truth:
    """What is known of a robot apart from its recording; None is not known or not defined."""

    latency_s: float | None = None  # from a command's stamp to its effect
    mounting: dict[str, float] = field(
        default_factory=dict
    )  # by names of the uncertainties
    dead_zone: float | None = None  # greatest throttle at which it stands
    wheels: dict[str, tuple[float, float]] = field(default_factory=dict)  # ranges [m]


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
    truth: Truth = field(default_factory=Truth)


# The calibrations that were published with the four drives of that robot: from least to greatest.
WHEELS = {
    "left_m": (0.1632, 0.1734),
    "right_m": (0.1624, 0.1732),
    "base_m": (0.5625, 0.5949),
}


def camera(number: str) -> RealDrive:
    """Returns a drive of the robot with ticks."""
    source = f"differential_ticks/Camera_Odo_Data_{number}.txt"
    bars = Bars(share=0.05, of_yardstick=None)
    return RealDrive(
        source, EXAMPLES / "differential_ticks.yaml", bars, Truth(wheels=WHEELS)
    )


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
    low, high = COVERAGE
    if not low <= told["coverage_95"] <= high:
        missed.append(
            f"{name}: the 95 % band holds {told['coverage_95']:.1%} of the ends, "
            f"bar {low:.0%} to {high:.0%}"
        )
    for key, row in told["truths"].items():
        if not row["near"]:
            sigma = f" +- {row['sigma']:.4f}" if "sigma" in row else ""
            missed.append(
                f"{name}: {key} {row['found']:.4f}{sigma}, true {row['true']}"
            )
    return missed


def compared(found: Identified, truth: Truth) -> dict[str, dict[str, Any]]:
    """Returns each true value with the one found, and whether it is near enough."""
    rows = {}
    calibration = found.calibration
    values = {
        "rotation_rad": calibration.rotation_rad,
        "lever_arm_x_m": calibration.lever_arm_m[0],
        "lever_arm_y_m": calibration.lever_arm_m[1],
    }
    for name, true in truth.mounting.items():
        sigma = calibration.uncertainty.get(name, float("nan"))
        told = not np.isnan(sigma)
        near = (
            abs(values[name] - true) <= STANDARD_ERRORS * sigma
            if told
            else values[name] == 0.0
        )
        rows[name] = {
            "true": true,
            "found": values[name],
            "sigma": sigma,
            "near": bool(near),
        }
    if truth.latency_s is not None and "command_latency_s" in calibration.uncertainty:
        rows["latency_s"] = _row(
            truth.latency_s, calibration.command_latency_s, LATENCY_S
        )
    if truth.dead_zone is not None:
        width = DEAD_ZONE * truth.dead_zone
        rows["dead_zone"] = _row(truth.dead_zone, dead_zone_of(found), width)
    sizes = wheels_of(found.model) if truth.wheels else {}
    for name, (low, high) in truth.wheels.items():
        near = (1.0 - WHEEL) * low <= sizes[name] <= (1.0 + WHEEL) * high
        rows[name] = {"true": [low, high], "found": sizes[name], "near": bool(near)}
    return rows


def _row(true: float, value: float, width: float) -> dict[str, Any]:
    return {"true": true, "found": value, "near": abs(value - true) <= width}


def dead_zone_of(found: Identified) -> float:
    """Returns the dead zone of the first command, NaN as long as there is none in the model."""
    # The seam to `identify`: the input curve of a command.
    return float(getattr(found, "dead_zone", float("nan")))


def wheels_of(model: TaylorModel) -> dict[str, float]:
    """Returns radii and base [m] by which a model of two wheel speeds moves its robot."""
    left, right = (_per_command(model, wheel) for wheel in range(2))
    with np.errstate(divide="ignore", invalid="ignore"):
        base = -left[0] / left[2] + right[0] / right[2]
    return {"left_m": -left[2] * base, "right_m": right[2] * base, "base_m": base}


def _per_command(model: TaylorModel, place: int) -> Array:
    """Returns the change (3,) of the settled body twist per change of one command."""
    size = model.state_size
    steps = round(SETTLED_S / model.dt)
    command = np.zeros((2, steps, len(model.variables) - size))
    command[0, :, place] = SLOW
    command[1, :, place] = -SLOW
    poses = np.zeros((2, steps + 1, 3))
    states = np.zeros((2, steps + 1, size))
    simulate_rollouts(poses, states, command, make_terms(model), SERIES, model.dt)
    twist = geometry.log(geometry.between(poses[:, -2], poses[:, -1])) / model.dt
    return np.asarray((twist[0] - twist[1]) / (2.0 * SLOW))
