"""What the doctor expects of a robot, and what it finds that does not fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.kinematics.spec import RobotSpec
from nics_drl_bridge.lidar.canonical import ScanLayout, plan_of, reader_of
from nics_drl_bridge.lidar.spec import LidarSpec, ScanHeader
from nics_drl_bridge.policy.contract import Contract
from nics_drl_bridge.report.doctor_facts import Facts, Layout


@dataclass(frozen=True)
class Finding:
    """Something that does not fit.

    Attributes:
        severity: an `error` makes a policy misbehave; a `warning` may.
        check: what was looked at.
        where: the topic.
        what: what does not fit, with numbers.
        fix: what to do.
    """

    severity: Literal["error", "warning"]
    check: str
    where: str
    what: str
    fix: str


@dataclass(frozen=True)
class Expected:
    """What is expected of a robot, by whatever it was made for.

    Attributes:
        robot: units and limits of state and command.
        lidar: beams, limits, rate, frame and range convention.
        period_s: between commands [s].
        scan: the sectors that any lidar may fill; None: the beams of exactly this one.
    """

    robot: RobotSpec
    lidar: LidarSpec
    period_s: float
    scan: ScanLayout | None = None


def expected_of_model(model: SimulatorModel) -> Expected:
    """What a SimulatorModel expects."""
    return Expected(model.robot, model.lidar, model.control_period)


def expected_of_policy(contract: Contract) -> Expected:
    """What a policy file expects: its robot, and its lidar or one that fills its sectors."""
    return Expected(contract.robot, contract.lidar, contract.control_period, contract.scan)


def seen(facts: Facts, expected: Expected) -> Expected:
    """Expects the lidar that is there, where sectors are wanted and it fills them."""
    if expected.scan is None or not facts.layouts:
        return expected
    try:
        lidar = filling(facts.layouts[0], expected.lidar, expected.scan)
    except ConfigError:
        return expected
    return replace(expected, lidar=lidar)


def filling(have: Layout, like: LidarSpec, scan: ScanLayout) -> LidarSpec:
    """The lidar of a header, mounted like another one.

    Raises:
        ConfigError: it does not fill the sectors.
    """
    header = ScanHeader(
        have.angle_min, have.angle_max, have.angle_increment, 0.0, 0.0, have.range_min,
        have.range_max,
    )  # fmt: skip
    lidar = reader_of(header, have.beams, like).lidar
    plan_of(lidar, scan)
    return lidar
