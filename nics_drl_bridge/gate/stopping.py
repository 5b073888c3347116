"""Stopping behaviour of a robot, and a check for settings that would prevent any motion."""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nics_drl_bridge.config import find_config, load_yaml, validate
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.gate.limits import (
    HARDEST,
    SPEED,
    TURN,
    Limits,
    LimitsFile,
    Stopping,
)
from nics_drl_bridge.gate.state import GateConfig, ShieldConfig
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.robot.braking import Braking, TurnBraking, find_braking
from nics_drl_bridge.robot.spec import RobotSpec

ANGLE = "rad"
UNKNOWN_LAG_S = 0.5  # lag of a robot whose model shows none [s]
UNKNOWN_DECELERATION = 0.5  # deceleration of a robot whose limits are not known [m/s^2]
MIN_SHIELD_BEAMS = 2  # minimum number of beams that show the width of an obstacle
# minimum number of data within the settling time for a rate to be known
MIN_DATA = 2


def make_gate_config(
    model: SimulatorModel,
    limits: Limits | None,
    shield: ShieldConfig | None,
    **rules: Any,
) -> GateConfig:
    """Returns the configuration of a robot's gate; `rules` are its other fields."""
    lidar = model.lidar
    robot = model.robot
    if "odom_rate" not in rules:
        rules["odom_rate"] = 1.0 / model.control_period
        rules.setdefault("odom_rate_declared", False)
    return GateConfig(
        fields=robot.cmd_vel_places,
        bicycle=robot.bicycle if robot.takes_turn_rate else None,
        limits=limits,
        beam_angles=lidar.angles,
        mount=lidar.mount,
        range_min=lidar.range_min,
        range_max=lidar.range_max,
        scan_rate=lidar.rate,
        sensors=tuple(sensor.name for sensor in model.sensors),
        odom_std=model.noise.odometry,
        range_noise=_get_range_noise(lidar),
        shield=shield,
        **rules,
    )


def _get_range_noise(lidar: LidarSpec) -> tuple[float, float]:
    """Returns the standard deviation of ranges, in metres and as a fraction of the range."""
    return lidar.noise_std, lidar.faults.noise_proportional


def shield_config(
    model: SimulatorModel,
    limits: Limits | None,
    file: str | Path = "",
    overrides: Mapping[str, float] | None = None,
) -> tuple[ShieldConfig, str]:
    """Returns a robot's shield, and a sentence on its values; ConfigError for invalid values.

    Values are from `shield` in the file of limits, or else derived from model and
    limits; `overrides` take precedence.
    """
    if model.lidar.beams < MIN_SHIELD_BEAMS:
        raise ConfigError(
            f"robot {model.robot.name!r}: the shield needs a lidar of {MIN_SHIELD_BEAMS} beams or "
            f"more, and this one has {model.lidar.beams}; use another one, or drive without a "
            "shield by `shield: false`."
        )
    path = find_config(file, "limits") if file else None
    measured = load_yaml(path, LimitsFile).shield if path else None
    overrides = overrides or {}
    try:
        braking = derive_braking(model, limits)
    except ConfigError as error:
        if measured is None and not overrides.keys() >= {"latency", "deceleration"}:
            advice = "The file of limits may give it: `shield: {latency: .., deceleration: ..}`."
            raise ConfigError(f"{error} {advice}") from None
        braking = Braking(0.0, math.inf)
    stopping = {
        "latency": braking.reaction_s,
        "deceleration": min(braking.deceleration, HARDEST),
    }
    if measured is not None:
        stopping = measured.model_dump()
    values = validate({**stopping, **overrides}, Stopping, "the shield's parameters")
    config = ShieldConfig(
        latency_s=values.latency,
        deceleration=values.deceleration,
        margin=values.margin,
        hold_s=GateConfig.gap_s,
        footprint_radius=model.robot.footprint_radius,
        wheelbase=get_wheelbase(model.robot),
        obstacle_speed=values.obstacle_speed,
        range_max=model.lidar.range_max,
        range_noise=_get_range_noise(model.lidar),
        outline=model.robot.footprint or (),
        lever=braking.lever_m,
        order=braking.order,
        drift=braking.drift,
        turn=_adapt_turn(braking, values),
    )
    source = f"by {path}" if measured is not None else "derived from model and limits"
    if overrides:
        source += f", but {', '.join(sorted(overrides))} by parameter"
    listed = ", ".join(
        f"{name} {value:g}" for name, value in values.model_dump().items()
    )
    return config, f"the shield is on: {listed} ({source})"


def _adapt_turn(braking: Braking, stopping: Stopping) -> TurnBraking | None:
    """Returns the turn's braking, scaled by how much `stopping` is worse than the speed's."""
    turn = braking.turn
    if turn is None:
        return None
    delay = max(0.0, stopping.latency - braking.reaction_s)
    weakening = min(1.0, stopping.deceleration / min(braking.deceleration, HARDEST))
    deceleration = min(turn.deceleration * weakening, HARDEST)
    return replace(turn, reaction_s=turn.reaction_s + delay, deceleration=deceleration)


def derive_braking(model: SimulatorModel, limits: Limits | None) -> Braking:
    """Returns how a robot stops on a command of its gate, according to its model.

    Its base reads one command per period, and brakes no harder than its limits allow. Raises
    ConfigError for a model that does not come to rest.
    """
    robot = model.robot
    linear = np.array([variable.unit == SPEED for variable in robot.command])
    if limits is None:
        low = robot.command_low
        high = robot.command_high
        rates = np.full(len(linear), UNKNOWN_DECELERATION)
    else:
        low = limits.low
        high = limits.high
        rates = limits.rate
    ramp = np.where(linear, rates, np.inf)
    braking = find_braking(robot, model.kinematics, low, high, ramp)
    reaction = braking.reaction_s
    if not model.kinematics.state_size or braking == Braking(0.0, math.inf):
        reaction += UNKNOWN_LAG_S  # it shows no lag, and every robot has one
    late = max(0.0, model.calibration.command_latency_s) + model.control_period
    turn = braking.turn
    if turn is not None:
        turn = replace(turn, reaction_s=round(turn.reaction_s + late, 9))
    return replace(braking, reaction_s=round(reaction + late, 9), turn=turn)


def get_wheelbase(robot: RobotSpec) -> float:
    """Returns the wheelbase [m] of a car, else 0; ConfigError without it or for unknown units."""
    for variable in robot.command:
        if variable.unit not in (SPEED, TURN, ANGLE):
            fault = f"{variable.name!r} is in {variable.unit!r}; without it, set `shield: false`"
            accepted = "the shield knows commands in m/s, rad/s and rad"
            raise ConfigError(f"robot {robot.name!r}: {accepted}, and {fault}.")
    if not robot.steers:
        return 0.0
    if not robot.knows_wheelbase:
        fault = (
            f"robot {robot.name!r}: the shield needs the parameter 'wheelbase' of a car"
        )
        advice = "add it under `parameters:` of the robot"
        raise ConfigError(
            f"{fault}; {advice}, or drive without a shield by `shield: false`."
        )
    return robot.parameters["wheelbase"]


def require_possible(config: GateConfig) -> None:
    """Raises ConfigError, naming the parameter, for settings that prevent arming."""
    for topic, rate, age in (
        ("scan", config.scan_rate, config.scan_age_s),
        ("odom", config.odom_rate, config.odom_age_s),
    ):
        declared = f"{topic} comes every {1.0 / rate:.3g} s ({rate:g} Hz are declared)"
        if age <= 1.0 / rate:
            fault = f"{age:g} s: {declared}, so the robot could never move"
            raise ConfigError(
                f"parameter '{topic}_age': {fault}; give more than {1.0 / rate:.3g}."
            )
        if rate * config.settle_s < MIN_DATA:
            fault = f"{declared}, too rarely to be judged within {config.settle_s:g} s"
            needed = f"the gate needs {MIN_DATA / config.settle_s:g} Hz or more"
            raise ConfigError(f"{fault}, so the robot could never move; {needed}.")


def warn_of_age_limit(config: GateConfig, control_period_s: float) -> str:
    """Returns a warning about an age limit that only suits a policy with a shorter period [s]."""
    if config.command_age_s > control_period_s:
        return ""
    age = f"parameter 'command_age': {config.command_age_s:g} s"
    period = f"{control_period_s:g}"
    pace = f"a policy commands every {period} s unless it is configured otherwise"
    advice = f"the robot would stop between any two commands; give more than {period}."
    return f"{age}: {pace}, and {advice}"
