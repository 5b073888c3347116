"""Robots as MJCF for MuJoCo; tyres are ellipsoids, which neither jump nor scrub."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import polynomial

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.interface import Array
from nics_drl_bridge.robot.ackermann import track_and_radius
from nics_drl_bridge.robot.kinds import places_of_four, require_textbook
from nics_drl_bridge.robot.spec import RobotSpec

Parameters = dict[str, float]

# torque limit of a motor, relative to the torque of the maximum acceleration
TORQUE_RESERVE = 1.5
SERVO_LAG_S = 0.005  # lag of a motor behind its set point
# the same for a motor that keeps its speed although its tyres are dragged sideways
STIFF_SERVO_LAG_S = 0.001
ROTOR = 0.25  # inertia of a geared motor, relative to its share of the robot's inertia
# MuJoCo's `impratio`: stiffness of tyres against skidding relative to that against compression.
# At 1, MuJoCo's convex contacts lift sliding wheels so far that they hop off the floor.
SKIDDING = 0.01
STEERING_STIFFNESS = 1.0  # torque of a steering servo per error [N m/rad]
MISFIT = 0.01  # maximum error of a wheel's angle due to the tie rod [rad]
# torque limit of a steering servo, as of a small hobby servo [N m]
STEERING_TORQUE = 1.0
# maximum radius of a roller, relative to the radius of the wheel
MAX_ROLLER_RADIUS = 0.25
ROLLER_MASS = 0.005
ROLLED = 1.0, 0.9884, 1.0  # measured on rollers under load, in sideways drives


@dataclass(frozen=True)
class Physics:
    """Parameters of a machine that a RobotSpec does not have; defaults are for a small robot."""

    timestep: float = 0.001  # MuJoCo's time step [s]
    mass: float = 4.0  # chassis with load, without wheels [kg]
    wheel_mass: float = 0.15  # one wheel [kg]
    friction: float = 1.0  # between tyre and floor
    # acceleration of the robot after the maximum step of a command [m/s^2]
    acceleration: float = 5.0
    # time constant of a tyre pressed into the floor [s]
    softness: float = 0.005
    bearing: float = 1e-6  # viscous friction of free wheels and rollers [N m s/rad]
    rollers: int = 12  # per mecanum wheel


@dataclass(frozen=True)
class Machine:
    """A robot for MuJoCo."""

    xml: str  # the MJCF model; its body `base_link` has the only free joint
    joints: tuple[str, ...]  # names of the J joints with encoders
    # maps a wanted state (S,) to the actuators' inputs (U,)
    controls: Callable[[Array], Array]
    # maps joint positions [rad] and speeds [rad/s] (J,) to the state (S,)
    state: Callable[[Array, Array], Array]
    # actual twist relative to the wheels' twist
    calibrated: tuple[float, float, float] = (1.0, 1.0, 1.0)
    gyro: bool = False  # True: odometry gets the turn rate from a gyro, not from wheels


def _make_motor(
    transmission: str,
    inertia: float,
    lag: float,
    radius: float,
    step: float,
    physics: Physics,
    servo_lag: float = SERVO_LAG_S,
) -> str:
    # Torque = gain x (wanted - actual speed), up to a limit. The wanted speed follows the command
    # with a first-order lag [s], so that the servo is stiff and keeps its speed under load.
    # Spinning or locked wheels do not steer, so the lag is longer if the maximum step [m/s] would
    # accelerate the robot too much. The inertia [kg m^2] is at the shaft, with the robot's share.
    lag = max(lag, step / physics.acceleration) - servo_lag
    gain = inertia / servo_lag
    torque = inertia * TORQUE_RESERVE * physics.acceleration / radius
    return f"""
    <general {transmission} dyntype="filterexact" dynprm="{lag:.8g}" gainprm="{gain:.8g}"
             biastype="affine" biasprm="0 0 {-gain:.8g}"
             forcerange="{-torque:.8g} {torque:.8g}"/>"""


def _make_document(
    name: str,
    physics: Physics,
    height: float,
    robot: str,
    actuators: str,
    impratio: float = 1.0,
) -> str:
    return f"""
<mujoco model="{name}">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{physics.timestep}" integrator="implicitfast" cone="elliptic"
          jacobian="sparse" impratio="{impratio:g}"/>
  <default>
    <geom contype="0" conaffinity="0" condim="3" friction="{physics.friction}"/>
    <default class="tread">
      <geom contype="1" priority="1" solref="{physics.softness} 1"/>
    </default>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1" conaffinity="1"/>
    <body name="base_link" pos="0 0 {height}">
      <freejoint/>{robot}
    </body>
  </worldbody>
{actuators}
</mujoco>
"""


def _make_chassis(
    mass: float, centre: tuple[float, float, float], size: tuple[float, ...]
) -> str:
    half = " ".join(f"{0.5 * s:.6g}" for s in size)
    x, y, z = centre
    return f"""
      <geom name="chassis" type="box" mass="{mass}" pos="{x:.6g} {y:.6g} {z:.6g}" size="{half}"/>"""


def _make_wheel(
    name: str,
    radius: float,
    width: float,
    physics: Physics,
    damping: float = 0.0,
    rotor: float = 0.0,
) -> str:
    return f"""
        <joint name="{name}" axis="0 1 0" damping="{damping}" armature="{rotor:.8g}"/>
        <geom type="cylinder" mass="{physics.wheel_mass}" size="{radius:.6g} {0.5 * width:.6g}"
              zaxis="0 1 0"/>
        <geom class="tread" type="ellipsoid" mass="0" zaxis="0 1 0"
              size="{radius:.6g} {radius:.6g} {0.5 * width:.6g}"/>"""


def load_mujoco() -> Any:
    """Returns the module `mujoco`. Raises ConfigError if it is not installed."""
    try:
        import mujoco
    except ImportError:
        fix = "run pip install 'nics_drl_bridge[mujoco]'."
        raise ConfigError(f"MuJoCo is not installed; {fix}") from None
    return mujoco


def build_machine(spec: RobotSpec, physics: Physics | None = None) -> Machine:
    """Builds a robot's machine. Raises ConfigError for an unknown kind or a missing parameter."""
    kind = require_textbook(spec)
    if kind not in _BUILDERS:
        fix = f"take one of {', '.join(_BUILDERS)}, or the fast simulator."
        raise ConfigError(
            f"robot {spec.name!r}: MuJoCo has no machine of the kind {kind!r}; {fix}"
        )
    if any(v.twist is not None for v in spec.state):
        fault = "MuJoCo's machines measure actuators, not a twist"
        raise ConfigError(f"robot {spec.name!r}: {fault}; correct `state:`.")
    try:
        step = max(c.max - c.min for c in spec.command if not c.turns)
        steepest = max(
            (max(-v.min, v.max) for v in spec.state if v.unit == "rad"), default=0.0
        )
        arguments = (
            {**spec.parameters, "steepest": steepest},
            step,
            physics or Physics(),
        )
        return _BUILDERS[kind](*arguments)
    except KeyError as error:
        reason = f"the {kind} machine needs the parameter {error}; add it under `parameters:`."
        raise ConfigError(f"robot {spec.name!r}: {reason}") from None


def _make_ackermann(p: Parameters, step: float, physics: Physics) -> Machine:
    # One motor turns both rear wheels through a tendon that averages their speeds, which splits
    # its torque like a differential.
    wheelbase = p["wheelbase"]
    track, radius = track_and_radius(p)
    total = physics.mass + 4 * physics.wheel_mass
    rotor = ROTOR * 0.5 * physics.mass * radius**2
    inertia = (total + 2 * physics.wheel_mass) * radius**2 + 2 * rotor
    engine = _make_motor(
        'tendon="axle"', inertia, p["speed_lag"], radius, step, physics
    )
    centre = (0.45 * wheelbase, 0.0, 0.0)
    size = (1.3 * wheelbase, 0.7 * track, 0.04)
    wheels = _make_car_wheels(
        wheelbase, track, radius, p["steering_lag"], physics, rotor
    )
    robot = _make_chassis(physics.mass, centre, size) + wheels
    half_ratio = 0.5 * track / wheelbase
    actuators = _make_car_actuators(engine) + _make_tie_rod(half_ratio, p["steepest"])
    xml = _make_document("ackermann", physics, radius, robot, actuators)

    def controls(state: Array) -> Array:
        speed, steering = state
        # `steering` is the angle of a virtual middle wheel; all wheels turn about one centre.
        t = np.tan(steering)
        left = t / (1.0 - half_ratio * t)
        right = t / (1.0 + half_ratio * t)
        return np.array([speed / radius, np.arctan(left), np.arctan(right)])

    def measured(position: Array, speed: Array) -> Array:
        tangents = np.tan(position[2:])
        middle = tangents / (1.0 + half_ratio * np.array([1.0, -1.0]) * tangents)
        return np.array(
            [0.5 * radius * (speed[0] + speed[1]), np.arctan(np.mean(middle))]
        )

    joints = ("rear_left", "rear_right", "steer_left", "steer_right")
    return Machine(xml, joints, controls, measured)


def _make_car_wheels(
    wheelbase: float,
    track: float,
    radius: float,
    lag: float,
    physics: Physics,
    rotor: float,
) -> str:
    parts = ""
    for side, y in (("left", 0.5 * track), ("right", -0.5 * track)):
        rear = _make_wheel(f"rear_{side}", radius, 0.4 * radius, physics, rotor=rotor)
        front = _make_wheel(
            f"front_{side}", radius, 0.4 * radius, physics, physics.bearing
        )
        parts += f"""
      <body pos="0 {y:.6g} 0">{rear}
      </body>
      <body pos="{wheelbase:.6g} {y:.6g} 0">
        <joint name="steer_{side}" axis="0 0 1" armature="1e-4"
               damping="{STEERING_STIFFNESS * lag:.6g}"/>
        <geom type="sphere" size="0.005" mass="0.02"/>
        <body>{front}
        </body>
      </body>"""
    return parts


def _make_tie_rod(half_ratio: float, steepest: float) -> str:
    # Without a tie rod, the servos pass through angles at which the wheels scrub.
    middle = np.tan(np.linspace(-steepest, steepest, 101))
    left, right = (
        np.arctan2(middle, 1.0 + side * half_ratio * middle) for side in (-1.0, 1.0)
    )
    row = polynomial.polyfit(left, right, [1, 2, 3, 4])
    if np.abs(polynomial.polyval(left, row) - right).max() > MISFIT:
        return ""
    terms = " ".join(f"{factor:.8g}" for factor in row)
    return f"""
  <equality><joint joint1="steer_right" joint2="steer_left" polycoef="{terms}"/></equality>"""


def _make_car_actuators(engine: str) -> str:
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
  <actuator>{engine}{servos}
  </actuator>"""


def _make_differential(p: Parameters, step: float, physics: Physics) -> Machine:
    radius = p["wheel_radius"]
    track = p["track"]
    behind = -0.5 * track
    ball = 0.4 * radius
    total = physics.mass + 2 * physics.wheel_mass
    rotor = ROTOR * 0.5 * physics.mass * radius**2
    inertia = 0.5 * (total + physics.wheel_mass) * radius**2 + rotor
    wheels = "".join(
        f"""
      <body pos="0 {y:.6g} 0">{_make_wheel(side, radius, 0.4 * radius, physics, rotor=rotor)}
      </body>"""
        for side, y in (("left", 0.5 * track), ("right", -0.5 * track))
    )
    # The centre of mass is low and just behind the axle: braking must not tip the robot over, and
    # a mass far behind would push it further into every turn.
    centre = (-0.06 * track, 0.0, -0.55 * radius)
    size = (track, 0.7 * track, 0.03)
    robot = f"""{_make_chassis(physics.mass, centre, size)}
      <body pos="{behind:.6g} 0 {ball - radius:.6g}">
        <joint type="ball" damping="{physics.bearing}"/>
        <geom class="tread" type="sphere" size="{ball:.6g}" mass="0.03"/>
      </body>{wheels}"""
    names = ("left", "right")
    motors = _make_motors(names, inertia, p["wheel_lag"], radius, step, physics)
    xml = _make_document("differential", physics, radius, robot, motors)
    return Machine(xml, names, lambda state: state, lambda _, speed: speed)


def _make_mecanum(p: Parameters, step: float, physics: Physics) -> Machine:
    # MuJoCo can't align anisotropic friction with the roller at the bottom of a turning wheel. Free
    # rollers are robust, and reproduce the slight vibration of real wheels.
    radius = p["wheel_radius"]
    total = physics.mass + 4 * physics.wheel_mass
    rotor = ROTOR * 0.25 * physics.mass * radius**2
    inertia = (0.25 * total + 0.5 * physics.wheel_mass) * radius**2 + rotor
    x = p["half_length"]
    y = p["half_width"]
    names = ("front_left", "front_right", "rear_left", "rear_right")
    places = ((x, y, -1), (x, -y, 1), (-x, y, 1), (-x, -y, -1))
    body = _make_chassis(physics.mass, (0, 0, 0), (2.2 * x, 1.4 * y, 0.04))
    for name, (px, py, lean) in zip(names, places, strict=True):
        body += _make_roller_wheel(name, (px, py), lean, radius, physics, rotor)
    motors = _make_motors(names, inertia, p["wheel_lag"], radius, step, physics)
    xml = _make_document("mecanum", physics, radius, body, motors)
    # In diagonal drives two wheels stand still, each on a roller touching the floor anywhere along
    # its length. They turn the robot by up to 0.03 rad/s, which only a gyro measures.
    return Machine(
        xml, names, lambda state: state, lambda _, speed: speed, ROLLED, gyro=True
    )


def _make_skid_steer(p: Parameters, step: float, physics: Physics) -> Machine:
    # Each wheel has one contact point, so the skidding in a turn follows from the wheels' places.
    radius = p["wheel_radius"]
    places = places_of_four(p)
    x, y = places["front_left"]
    rotor = ROTOR * 0.25 * physics.mass * radius**2
    inertia = (0.25 * physics.mass + 1.5 * physics.wheel_mass) * radius**2 + rotor
    body = _make_chassis(
        physics.mass, (0.0, 0.0, 0.0), (2.0 * x + radius, 1.4 * y, 0.1)
    )
    for name, (px, py) in places.items():
        wheel = _make_wheel(name, radius, 0.4 * radius, physics, rotor=rotor)
        body += f"""
      <body pos="{px:.6g} {py:.6g} 0">{wheel}
      </body>"""
    names = tuple(places)
    motors = _make_motors(
        names, inertia, p["wheel_lag"], radius, step, physics, STIFF_SERVO_LAG_S
    )
    xml = _make_document("skid_steer", physics, radius, body, motors, SKIDDING)
    measure_sides = lambda _, speed: 0.5 * (speed[:2] + speed[2:])  # noqa: E731
    # Skidding varies with speed and curvature, so such robots take the turn rate from a gyro.
    return Machine(
        xml, names, lambda state: np.tile(state, 2), measure_sides, gyro=True
    )


def _make_motors(names: tuple[str, ...], *servo: Any) -> str:
    rows = "".join(_make_motor(f'joint="{name}"', *servo) for name in names)
    return f"""
  <actuator>{rows}
  </actuator>"""


_BUILDERS: dict[str, Callable[[Parameters, float, Physics], Machine]] = {
    "ackermann": _make_ackermann,
    "differential": _make_differential,
    "mecanum": _make_mecanum,
    "skid_steer": _make_skid_steer,
}


def fit_roller(radius: float, rollers: int) -> tuple[float, float]:
    """Returns semi-axes [m], across and along, of ellipsoidal rollers that best form a circle."""
    a = MAX_ROLLER_RADIUS * radius
    q = np.pi / rollers
    reach = radius - (radius - a) * np.cos(q)
    return float(a), float(np.sqrt(a**2 + 2.0 * (reach**2 - a**2) / np.sin(q) ** 2))


def _make_roller_wheel(
    name: str,
    place: tuple[float, float],
    lean: int,
    radius: float,
    physics: Physics,
    rotor: float,
) -> str:
    # `lean` is 1 if the axle of the roller on the floor points forward and left, else -1.
    a, b = fit_roller(radius, physics.rollers)
    hub = physics.wheel_mass - physics.rollers * ROLLER_MASS
    rows = ""
    for angle in 2.0 * np.pi * np.arange(physics.rollers) / physics.rollers:
        s = np.sin(angle)
        c = np.cos(angle)
        x = -(radius - a) * s
        z = -(radius - a) * c
        rows += f"""
        <body pos="{x:.8g} 0 {z:.8g}" zaxis="{c:.8g} {lean} {-s:.8g}">
          <joint axis="0 0 1" damping="{physics.bearing}" armature="2e-7"/>
          <geom class="tread" type="ellipsoid" mass="{ROLLER_MASS}" size="{a:.8g} {a:.8g} {b:.8g}"/>
        </body>"""
    return f"""
      <body pos="{place[0]:.6g} {place[1]:.6g} 0">
        <joint name="{name}" axis="0 1 0" armature="{rotor:.8g}"/>
        <geom type="cylinder" mass="{hub:.6g}" size="{0.7 * radius:.6g} {0.3 * radius:.6g}"
              zaxis="0 1 0"/>{rows}
      </body>"""
