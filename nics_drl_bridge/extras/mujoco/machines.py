"""The machines of the three robots, built from the parameters of their RobotSpec.

A mecanum wheel with real rollers, as MJCF.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.extras.mujoco import machine
from nics_drl_bridge.extras.mujoco.machine import Machine, Motor, Physics
from nics_drl_bridge.robot.ackermann import track_and_radius
from nics_drl_bridge.robot.kinds import require_textbook
from nics_drl_bridge.robot.spec import RobotSpec

Array = NDArray[np.float64]
Parameters = dict[str, float]

STEERING_STIFFNESS = 1.0
"""Torque of a steering servo per error [N m/rad]."""
STEERING_TORQUE = 1.0
"""Torque limit of a steering servo [N m], that of a small hobby servo."""


def build_machine(spec: RobotSpec, physics: Physics | None = None) -> Machine:
    """Builds the machine of a robot.

    In addition to those of the textbook kinematics, the parameters `wheel_radius` and `track` of an
    Ackermann robot are used if the spec has them.

    Raises:
        ConfigError: the spec names no textbook kinematics or a kind without a machine, or lacks a
            parameter.
    """
    kind = require_textbook(spec)
    if kind not in _BUILDERS:
        raise ConfigError(
            f"robot {spec.name!r}: MuJoCo has no machine of the kind {kind!r}; take one of "
            f"{', '.join(_BUILDERS)}, or the fast simulator."
        )
    try:
        return _BUILDERS[kind](spec.parameters, greatest_step(spec), physics or Physics())
    except KeyError as error:
        raise ConfigError(
            f"robot {spec.name!r}: the {kind} machine needs the parameter {error}; add it under "
            "`parameters:`."
        ) from None


def greatest_step(spec: RobotSpec) -> float:
    """Maximum step of a speed that commands within their limits can request [m/s]."""
    return max(c.max - c.min for c in spec.command if not c.turns)


def ackermann(p: Parameters, step: float, physics: Physics) -> Machine:
    """Builds a car: rear axle with an open differential, front wheels steered by two servos.

    `base_link` is the centre of the rear axle. One motor turns both rear wheels through a
    tendon that averages their speeds, which shares its torque as a differential does.
    """
    wheelbase = p["wheelbase"]
    track, radius = track_and_radius(p)
    total = physics.mass + 4 * physics.wheel_mass
    engine = machine.motor(
        (total + 2 * physics.wheel_mass) * radius**2, p["speed_lag"], radius, step, physics
    )
    robot = machine.chassis(
        physics.mass, (0.45 * wheelbase, 0.0, 0.0), (1.3 * wheelbase, 0.7 * track, 0.04)
    ) + "".join(_car_wheels(wheelbase, track, radius, p["steering_lag"], physics))
    height = radius
    xml = machine.document("ackermann", physics, height, robot, _car_actuators(engine))

    half_ratio = 0.5 * track / wheelbase

    def controls(state: Array) -> Array:
        speed, steering = state
        return np.array([speed / radius, *ackermann_angles(steering, half_ratio)])

    def measured(position: Array, speed: Array) -> Array:
        each = np.tan(position[2:])
        middle = each / (1.0 + half_ratio * np.array([1.0, -1.0]) * each)
        steering = np.arctan(np.mean(middle))
        return np.array([0.5 * radius * (speed[0] + speed[1]), steering])

    joints = ("rear_left", "rear_right", "steer_left", "steer_right")
    return Machine(xml, height, joints, controls, measured)


def ackermann_angles(steering: float, half_ratio: float) -> tuple[float, float]:
    """Steering angles of the left and right front wheels about a common turning centre.

    Args:
        steering: angle of a virtual wheel in the middle [rad].
        half_ratio: half the track divided by the wheelbase.
    """
    t = np.tan(steering)
    return float(np.arctan(t / (1.0 - half_ratio * t))), float(
        np.arctan(t / (1.0 + half_ratio * t))
    )


def _car_wheels(
    wheelbase: float, track: float, radius: float, lag: float, physics: Physics
) -> list[str]:
    parts = []
    for side, y in (("left", 0.5 * track), ("right", -0.5 * track)):
        rear = machine.wheel(f"rear_{side}", radius, 0.4 * radius, physics)
        front = machine.wheel(f"front_{side}", radius, 0.4 * radius, physics, physics.bearing)
        parts.append(f"""
      <body pos="0 {y:.6g} 0">{rear}
      </body>
      <body pos="{wheelbase:.6g} {y:.6g} 0">
        <joint name="steer_{side}" axis="0 0 1" armature="1e-4"
               damping="{STEERING_STIFFNESS * lag:.6g}"/>
        <geom type="sphere" size="0.005" mass="0.02"/>
        <body>{front}
        </body>
      </body>""")
    return parts


def _car_actuators(engine: Motor) -> str:
    servos = "".join(
        f"""
    <position joint="steer_{side}" kp="{STEERING_STIFFNESS}"
              forcerange="{-STEERING_TORQUE} {STEERING_TORQUE}"/>"""
        for side in ("left", "right")
    )
    return f"""
  <tendon>
    <fixed name="axle"><joint joint="rear_left" coef="0.5"/><joint joint="rear_right" coef="0.5"/>
    </fixed>
  </tendon>
  <actuator>{engine.mjcf('tendon="axle"')}{servos}
  </actuator>"""


def differential(p: Parameters, step: float, physics: Physics) -> Machine:
    """Builds a robot of two driven wheels and a ball caster; `base_link` is the axle's centre."""
    radius, track = p["wheel_radius"], p["track"]
    behind, ball = -0.5 * track, 0.4 * radius
    total = physics.mass + 2 * physics.wheel_mass
    servo = machine.motor(
        0.5 * (total + physics.wheel_mass) * radius**2,
        p["wheel_lag"], radius, step, physics,
    )  # fmt: skip
    sides = (("left", 0.5 * track), ("right", -0.5 * track))
    wheels = "".join(
        f"""
      <body pos="0 {y:.6g} 0">{machine.wheel(side, radius, 0.4 * radius, physics)}
      </body>"""
        for side, y in sides
    )
    # Low and just behind the axle: braking must not tip the robot over its wheels, and a mass far
    # behind would push it further into every turn.
    centre, size = (-0.06 * track, 0.0, -0.55 * radius), (track, 0.7 * track, 0.03)
    robot = f"""{machine.chassis(physics.mass, centre, size)}
      <body pos="{behind:.6g} 0 {ball - radius:.6g}">
        <joint type="ball" damping="{physics.bearing}"/>
        <geom class="tread" type="sphere" size="{ball:.6g}" mass="0.03"/>
      </body>{wheels}"""
    xml = machine.document(
        "differential", physics, radius, robot, _motors(("left", "right"), servo)
    )
    return Machine(xml, radius, ("left", "right"), _same, lambda _, speed: speed)


def mecanum(p: Parameters, step: float, physics: Physics) -> Machine:
    """Builds a robot of four wheels with real rollers, which carry it in turn.

    Friction that differs by direction would be simpler, but MuJoCo aligns it with the world or
    with a geom, not with the roller at the bottom of a turning wheel; free rollers are robust,
    and reproduce the slight vibration of real ones.
    """
    radius = p["wheel_radius"]
    total = physics.mass + 4 * physics.wheel_mass
    servo = machine.motor(
        (0.25 * total + 0.5 * physics.wheel_mass) * radius**2,
        p["wheel_lag"], radius, step, physics,
    )  # fmt: skip
    x, y = p["half_length"], p["half_width"]
    names = tuple(f"{place}_{side}" for place in ("front", "rear") for side in ("left", "right"))
    places = ((x, y, -1), (x, -y, 1), (-x, y, 1), (-x, -y, -1))
    wheels = "".join(
        roller_wheel(name, (px, py), lean, radius, physics)
        for name, (px, py, lean) in zip(names, places, strict=True)
    )
    body = machine.chassis(physics.mass, (0, 0, 0), (2.2 * x, 1.4 * y, 0.04))
    xml = machine.document("mecanum", physics, radius, body + wheels, _motors(names, servo))
    return Machine(xml, radius, names, _same, lambda _, speed: speed)


def _motors(names: tuple[str, ...], servo: Motor) -> str:
    rows = "".join(servo.mjcf(f'joint="{name}"') for name in names)
    return f"""
  <actuator>{rows}
  </actuator>"""


def _same(state: Array) -> Array:
    return state


_BUILDERS: dict[str, Callable[[Parameters, float, Physics], Machine]] = {
    "ackermann": ackermann,
    "differential": differential,
    "mecanum": mecanum,
}


THICKNESS = 0.25
"""Radius of a roller at its middle, relative to the radius of the wheel."""
ROLLER_MASS = 0.005


def roller_size(radius: float, rollers: int) -> tuple[float, float]:
    """Semi-axes [m] of ellipsoidal rollers whose outline best approximates a circle.

    Seen from the side, an ellipsoid at angle q from the bottom reaches
    `(R - a) cos q + sqrt(a^2 + (b^2 - a^2) sin^2 q / 2)` below the axle. Its length b makes this R
    at q = 0 and where the next roller takes over, at half the angle between two.

    Args:
        radius: R, of the wheel [m].
        rollers: number of rollers.

    Returns:
        Thickness a and length b, as semi-axes.
    """
    a, q = THICKNESS * radius, np.pi / rollers
    reach = radius - (radius - a) * np.cos(q)
    b = np.sqrt(a**2 + 2.0 * (reach**2 - a**2) / np.sin(q) ** 2)
    return float(a), float(b)


def roller_wheel(
    name: str, place: tuple[float, float], lean: int, radius: float, physics: Physics
) -> str:
    """MJCF of a wheel's body: a driven hub, and free rollers at 45 degrees to its axle.

    Args:
        name: of the wheel's joint.
        place: (x, y) of the wheel in `base_link` [m].
        lean: +1 if the axle of the roller on the floor points forward and left, -1 if it points
            forward and right.
        radius: of the wheel [m].
        physics: gives masses and bearings.
    """
    a, b = roller_size(radius, physics.rollers)
    hub = physics.wheel_mass - physics.rollers * ROLLER_MASS
    rows = []
    for angle in 2.0 * np.pi * np.arange(physics.rollers) / physics.rollers:
        s, c = np.sin(angle), np.cos(angle)
        x, z = -(radius - a) * s, -(radius - a) * c
        rows.append(f"""
        <body pos="{x:.8g} 0 {z:.8g}" zaxis="{c:.8g} {lean} {-s:.8g}">
          <joint axis="0 0 1" damping="{physics.bearing}" armature="2e-7"/>
          <geom class="tread" type="ellipsoid" mass="{ROLLER_MASS}" size="{a:.8g} {a:.8g} {b:.8g}"/>
        </body>""")
    return f"""
      <body pos="{place[0]:.6g} {place[1]:.6g} 0">
        <joint name="{name}" axis="0 1 0"/>
        <geom type="cylinder" mass="{hub:.6g}" size="{0.7 * radius:.6g} {0.3 * radius:.6g}"
              zaxis="0 1 0"/>{"".join(rows)}
      </body>"""
